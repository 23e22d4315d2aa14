"""Workers: processes of this machine, or of a cluster that somebody else has started."""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
from collections import Counter
from collections.abc import Iterator
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


class ClusterError(MrtError):
    """Workers cannot be reached, cannot be used, or are gone."""


def require() -> None:
    """Raise ``UsageError`` where the engine is not installed."""
    if importlib.util.find_spec("distributed") is None:
        raise UsageError("a sweep needs Dask: pip install 'mrt-mitsuba[cluster]'")


@dataclass(frozen=True)
class Local:
    """Workers of this machine. ``retries``: times a job may lose its worker; ``gpus``: pin each to one."""

    workers: int
    retries: int
    gpus: bool
    dashboard: int | None

    def cluster(self) -> Any:
        """A scheduler in this process and workers in processes of their own, with one thread for jobs each.

        They are started anew, not forked, nor do they import the caller's script: it needs no
        ``if __name__ == "__main__"``.
        """
        from distributed import Scheduler, SpecCluster
        from distributed.deploy.subprocess import SubprocessWorker
        from distributed.system import MEMORY_LIMIT

        if self.dashboard is not None and importlib.util.find_spec("bokeh") is None:
            raise UsageError("the dashboard needs Bokeh: pip install bokeh, or leave dashboard out")
        devices = gpus() if self.gpus else []
        workers = {}
        for number in range(self.workers):
            pinned = {"env": {"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]}} if devices else {}
            options = {
                "nthreads": 1,
                "memory_limit": MEMORY_LIMIT // self.workers,
                "dashboard": False,
                "silence_logs": logging.CRITICAL,
            }
            workers[number] = {"cls": SubprocessWorker, "options": {"worker_kwargs": options | pinned}}
        scheduler = {
            "allowed_failures": self.retries,
            "host": "127.0.0.1",
            "dashboard": self.dashboard is not None,
            "dashboard_address": f":{self.dashboard or 0}",
        }
        return SpecCluster(workers=workers, scheduler={"cls": Scheduler, "options": scheduler})


def default_workers(variant: str | None) -> int:
    """Return how many workers suit this machine: one for each GPU or core."""
    return (len(gpus()) if (variant or "").startswith("cuda") else 0) or usable_cores()


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


@contextmanager
def connected(cluster: Any, local: Local) -> Iterator[Client]:
    """Give a client of a cluster: an address, a client, or None for ``local``, which ends with the block."""
    from distributed import Client

    if isinstance(cluster, Client):
        yield cluster
        return
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        what = cluster if cluster is not None else stack.enter_context(local.cluster())
        try:
            client = stack.enter_context(Client(what, timeout=CONNECTING, set_as_default=False))
        except (OSError, ValueError, TypeError) as error:
            raise ClusterError(
                f"no scheduler answers at {cluster}: start one with 'dask scheduler' and give its address, "
                "such as tcp://host:8786"
            ) from error
        yield client


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
