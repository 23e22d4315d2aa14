"""Workers: processes of this machine, or of a cluster that somebody else has started."""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.cores import usable_cores
from mrt_mitsuba.errors import MrtError, OutputError, UsageError
from mrt_mitsuba.runtime import versions
from mrt_mitsuba.sweeps import worker

if TYPE_CHECKING:
    from distributed import Client

CONNECTING = 10  # seconds to reach a scheduler, and for its first worker to be there
STARTING = 120  # seconds for worker processes of this machine; a busy one takes its time
# For workers of this machine: the engine's profiler stops a job a hundred times a second
LOCAL = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False", "OMP_NUM_THREADS": "1"}


class ClusterError(MrtError):
    """Workers cannot be reached, cannot be used, or are gone."""


def require() -> None:
    """Raise ``UsageError`` where the engine is not installed."""
    if importlib.util.find_spec("distributed") is None:
        raise UsageError("a sweep needs Dask: pip install 'mrt-mitsuba[cluster]'")


@dataclass(frozen=True)
class Engine:
    """Where to render, and how the engine is to deal with jobs; see ``sweep``.

    Raises ``UsageError`` for numbers out of range, or both workers here and a cluster.
    """

    cluster: Any
    workers: int | None
    retries: int
    renew: int
    dashboard: int | None
    variant: str

    def __post_init__(self) -> None:
        for name, least in (("workers", 1), ("retries", 0), ("renew", 1), ("dashboard", 0)):
            number = getattr(self, name)
            if number is not None and (type(number) is not int or number < least):
                raise UsageError(f"{name}={number!r}: must be a whole number, {least} or more")
        if self.workers is not None and self.cluster is not None:
            raise UsageError("workers are for this machine, and a cluster brings its own: give one of them")
        if self.dashboard is not None and importlib.util.find_spec("bokeh") is None:
            raise UsageError("the dashboard needs Bokeh: pip install bokeh, or leave dashboard out")

    @contextmanager
    def connected(self, folder: str, jobs: int) -> Iterator[tuple[Client, Callable[[], worker.House]]]:
        """Give a client, and what waits for its workers and returns what they are to know.

        Workers of this machine, as many as there are jobs at most, end with the block. Both raise
        ``ClusterError`` or ``OutputError`` if workers cannot be used, such as those that do not see a folder.
        """
        from distributed import Client

        with ExitStack() as stack:
            client, expected = self.cluster, 1
            if not isinstance(client, Client):
                stack.enter_context(_quiet())
                if self.cluster is None:
                    expected = self.workers or min(_suitable(self.variant), jobs)
                    client = stack.enter_context(_client(stack.enter_context(self._local(expected))))
                else:
                    client = stack.enter_context(_client(self.cluster))

            def ready() -> worker.House:
                sharing = inspect(client, folder, expected)
                return worker.House(sharing, self.renew, self.cluster is None, versions())

            yield client, ready

    def _local(self, count: int) -> Any:
        """Return a scheduler in this process, and workers in processes of their own with one thread for jobs.

        They are started anew, not forked, nor do they import the caller's script: it needs no
        ``if __name__ == "__main__"``.
        """
        from distributed import Scheduler, SpecCluster
        from distributed.system import MEMORY_LIMIT

        from mrt_mitsuba.sweeps.process import WorkerProcess

        devices = gpus() if self.variant.startswith("cuda") else []
        options = {
            "nthreads": 1,
            "memory_limit": MEMORY_LIMIT // count,
            "dashboard": False,
            "silence_logs": logging.CRITICAL,
        }
        workers = {}
        for number in range(count):
            pinned = {"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]} if devices else {}
            settings = {"options": options, "environment": LOCAL | pinned}
            workers[number] = {"cls": WorkerProcess, "options": settings}
        scheduler = {
            "allowed_failures": self.retries,
            "host": "127.0.0.1",
            "dashboard": self.dashboard is not None,
            "dashboard_address": f":{self.dashboard or 0}",
        }
        return SpecCluster(workers=workers, scheduler={"cls": Scheduler, "options": scheduler})


def _suitable(variant: str) -> int:
    """Return how many workers suit this machine: one for each GPU or core."""
    return (len(gpus()) if variant.startswith("cuda") else 0) or usable_cores()


def gpus() -> list[str]:
    """Return the GPUs this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [name for name in named.split(",") if name]
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return [str(number) for number, _ in enumerate(listed.stdout.splitlines())]


def _client(cluster: Any) -> Client:
    from distributed import Client

    try:
        return Client(cluster, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ClusterError(
            f"no scheduler answers at {cluster}: start one with 'dask scheduler' and give its address, "
            "such as tcp://host:8786"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the engine about connections that break: whoever asked for them says it once."""
    names = ("distributed", "distributed.client", "tornado.application")
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def inspect(client: Client, folder: str, count: int) -> dict[str, int]:
    """Wait for so many workers and check them; return how many share cores, by ``worker.cores_of``.

    Raises ``ClusterError`` or ``OutputError`` if they cannot be used.
    """
    address = client.scheduler.address
    try:
        client.wait_for_workers(count, timeout=STARTING if count > 1 else CONNECTING)
    except TimeoutError as error:
        raise ClusterError(
            f"the scheduler at {address} has no worker: start some with 'dask worker {address} --nthreads 1'"
        ) from error
    try:
        found = client.run(worker.facts, folder)
    except (ImportError, AttributeError) as error:
        raise ClusterError(f"the workers lack this mrt-mitsuba ({error}): install it there") from error
    for name, facts in found.items():
        if not facts["sees"]:
            raise OutputError(f"the worker {name} cannot write to {folder}: choose a folder that all share")
        if facts["versions"] != versions():
            raise ClusterError(
                f"the worker {name} has {worker.named(facts['versions'])} and this process "
                f"{worker.named(versions())}: install the same everywhere"
            )
    return dict(Counter(facts["cores"] for facts in found.values()))
