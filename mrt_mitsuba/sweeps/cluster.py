"""Workers: processes of this machine, or of a cluster that somebody else has started."""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.cores import usable_cores
from mrt_mitsuba.errors import MrtError, OutputError, UsageError
from mrt_mitsuba.sweeps import worker

if TYPE_CHECKING:
    from distributed import Client

CONNECTING = 10  # seconds to reach a scheduler, and for its first worker to be there
STARTING = 120  # seconds for worker processes of this machine; a busy one takes its time


class ClusterError(MrtError):
    """Workers cannot be reached, cannot be used, or are gone."""


def check_engine(cluster: Any, **numbers: Any) -> None:
    """Raise ``UsageError`` where the engine is not installed or is asked for what it cannot be."""
    if importlib.util.find_spec("distributed") is None:
        raise UsageError("a sweep needs Dask: pip install 'mrt-mitsuba[cluster]'")
    for name, number in numbers.items():
        least = 1 if name == "workers" else 0
        if number is not None and (type(number) is not int or number < least):
            raise UsageError(f"{name}={number!r}: must be a whole number, {least} or more")
    if numbers["workers"] is not None and cluster is not None:
        raise UsageError("workers are for this machine, and a cluster brings its own: give one of them")
    if numbers["dashboard"] is not None and importlib.util.find_spec("bokeh") is None:
        raise UsageError("the dashboard needs Bokeh: pip install bokeh, or leave dashboard out")


@contextmanager
def connected(
    cluster: Any, jobs: int, workers: int | None, dashboard: int | None, variant: str
) -> Iterator[Client]:
    """Give a client whose workers are there; see ``sweep``.

    Workers of this machine, as many as there are jobs at most, end with the block. Raises ``ClusterError``
    where no scheduler answers, or it has no worker.
    """
    from distributed import Client

    with ExitStack() as stack:
        # Whoever asked for connections that break says so once
        for name in ("distributed", "distributed.client", "tornado.application"):
            logger = logging.getLogger(name)
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        count, patience = 1, CONNECTING
        if cluster is None:
            devices = gpus() if variant.startswith("cuda") else []
            count, patience = workers or min(len(devices) or usable_cores(), jobs), STARTING
            cluster = stack.enter_context(_local(count, dashboard, devices))
        try:
            client = cluster
            if not isinstance(cluster, Client):
                client = stack.enter_context(Client(cluster, timeout=CONNECTING, set_as_default=False))
            client.wait_for_workers(count, timeout=patience)
        except Exception as error:  # whatever the engine makes of an address, or of a client that is closed
            raise ClusterError(
                f"no scheduler with workers answers at {cluster}: start 'dask scheduler' and then "
                "'dask worker ADDRESS --nthreads 1' with its address, such as tcp://host:8786"
            ) from error
        yield client


def _local(count: int, dashboard: int | None, devices: list[str]) -> Any:
    """Return a scheduler in this process, and workers in processes of their own with one thread for jobs.

    They are started anew, not forked, nor do they import the caller's script: it needs no
    ``if __name__ == "__main__"``.
    """
    from distributed import Scheduler, SpecCluster
    from distributed.deploy.subprocess import SubprocessWorker
    from distributed.system import MEMORY_LIMIT

    options = {
        "nthreads": 1,
        "memory_limit": MEMORY_LIMIT // count,
        "dashboard": False,
        "silence_logs": logging.CRITICAL,
        "config": {"distributed.worker.profile.enabled": False},  # it stops a job 100 times a second
    }
    kernels = {"DRJIT_CACHE_DIR": os.environ.get("DRJIT_CACHE_DIR", os.path.expanduser("~/.drjit"))}
    workers = {}
    for number in range(count):
        pinned = {"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]} if devices else {}
        settings = {"worker_kwargs": options | {"env": kernels | pinned}}
        workers[number] = {"cls": SubprocessWorker, "options": settings}
    scheduler = {
        "allowed_failures": 0,  # a job that lost its worker is handed over again by ``sweep``
        "host": "127.0.0.1",
        "dashboard": dashboard is not None,
        "dashboard_address": f":{dashboard or 0}",
    }
    return SpecCluster(workers=workers, scheduler={"cls": Scheduler, "options": scheduler})


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


def inspect(client: Client, scratch: str) -> dict[str, int]:
    """Check all workers; return how many share cores.

    Raises ``ClusterError`` or ``OutputError`` if they cannot be used.
    """
    here = worker.software()
    try:
        found = client.run(worker.describe, scratch)
    except Exception as error:  # whatever another Python or another version makes of it
        raise ClusterError(
            f"the workers cannot run this mrt-mitsuba ({type(error).__name__}: {error}): install {here} there"
        ) from error
    for name, facts in found.items():
        if not facts["sees"]:
            raise OutputError(f"the worker {name} cannot write to {scratch}: choose a folder that all share")
        if facts["software"] != here:
            raise ClusterError(
                f"the worker {name} has {facts['software']} and this process {here}: install the same "
                "everywhere"
            )
    return dict(Counter(facts["cores"] for facts in found.values()))
