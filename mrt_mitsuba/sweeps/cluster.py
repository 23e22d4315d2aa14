"""Workers: processes of this machine, or of a cluster that somebody else has started; and jobs on them.

Needs Dask, which only a sweep does.
"""

from __future__ import annotations

import logging
import os
import subprocess
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from distributed import Client, Future, KilledWorker, Scheduler, SpecCluster, as_completed
from distributed.client import ClosedClientError
from distributed.deploy.subprocess import SubprocessWorker
from distributed.system import MEMORY_LIMIT

from mrt_mitsuba.errors import MrtError, OutputError, one_line
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.sweeps import worker
from mrt_mitsuba.sweeps.folder import Facts
from mrt_mitsuba.sweeps.jobs import Job

CONNECTING = 10  # seconds to reach a scheduler, and for its first worker to be there
STARTING = 120  # seconds for worker processes of this machine; a busy one takes its time
DIED = "every worker that rendered it died, perhaps for want of memory: give each more"
MOST_DEATHS = 10  # of workers that had been given a job which they did not begin


class ClusterError(MrtError):
    """Workers cannot be reached, cannot be used, or are gone."""


@contextmanager
def connected(
    cluster: Any, jobs: int, workers: int | None, dashboard: int | None, variant: str
) -> Iterator[Client]:
    """Give a client whose workers are there; see ``sweep``.

    Workers of this machine, as many as there are jobs at most, end with the block. Raises ``ClusterError``
    where no scheduler answers or has a worker, and where it goes away in the block.
    """
    with ExitStack() as stack:
        # Whoever asked for connections that break says so once
        for name in ("distributed", "distributed.client", "tornado.application"):
            logger = logging.getLogger(name)
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        count = 1
        patience = CONNECTING
        if cluster is None:
            devices = gpus() if variant.startswith("cuda") else []
            count = workers or min(len(devices) or usable_cores(), jobs)
            patience = STARTING
            cluster = stack.enter_context(_local(count, dashboard, devices))
        try:
            client = cluster
            if not isinstance(cluster, Client):
                client = Client.__new__(Client)
                stack.callback(_close, client)
                Client.__init__(client, cluster, timeout=CONNECTING, set_as_default=False)
            client.wait_for_workers(count, timeout=patience)
        except Exception as error:  # whatever the engine makes of an address, or of a client that is closed
            raise ClusterError(
                f"no scheduler with workers answers at {cluster}: start 'dask scheduler' and then "
                "'dask worker ADDRESS --nthreads 1' with its address, such as tcp://host:8786"
            ) from error
        try:
            yield client
        except (CancelledError, ClosedClientError, OSError) as error:
            raise ClusterError(
                "the scheduler is gone: start it and its workers, then run the same sweep again; it continues"
            ) from error


def _close(client: Client) -> None:
    """Close a client, also one that could not connect: if the garbage collector does while Dask holds a lock,
    it waits for ever."""
    with suppress(Exception):
        client.close()


def _local(count: int, dashboard: int | None, devices: list[str]) -> Any:
    """A scheduler in this process, and workers in processes of their own with one thread for jobs.
    They do not import the caller's script, so it needs no ``if __name__ == "__main__"``."""
    options = {
        "nthreads": 1,
        "memory_limit": MEMORY_LIMIT // count,
        "dashboard": False,
        "silence_logs": logging.CRITICAL,
        "config": {"distributed.worker.profile.enabled": False},  # it stops a job 100 times a second
    }
    kernels = {"DRJIT_CACHE_DIR": os.environ.get("DRJIT_CACHE_DIR", os.path.expanduser("~/.drjit"))}
    environs = [kernels | {"CUDA_VISIBLE_DEVICES": device} for device in devices] or [kernels]
    workers = {}
    for number in range(count):
        own = options | {"env": environs[number % len(environs)]}
        workers[number] = {"cls": SubprocessWorker, "options": {"worker_kwargs": own}}
    scheduler = {
        "allowed_failures": 0,  # ``outcomes`` hands over again a job that lost its worker
        "host": "127.0.0.1",
        "dashboard": dashboard is not None,
        "dashboard_address": f":{dashboard or 0}",
    }
    return SpecCluster(workers=workers, scheduler={"cls": Scheduler, "options": scheduler})


def gpus() -> list[str]:
    """The GPUs this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is None:
        with suppress(OSError, subprocess.SubprocessError):
            listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, timeout=30, check=True)
            return list(map(str, range(listed.stdout.count(b"\n"))))
    return [name for name in (named or "").split(",") if name]


def inspect(client: Client, scratch: str, here: str) -> dict[str, int]:
    """The number of workers that share each set of cores, see ``render_job``.

    Raises ``ClusterError`` or ``OutputError`` where one has other versions than those ``here`` or cannot be
    used.
    """
    try:
        workers = client.run(worker.describe, scratch)
    except Exception as error:  # whatever another Python or another version makes of it
        raise ClusterError(
            f"the workers cannot run this mrt-mitsuba ({type(error).__name__}: {error}): install {here} there"
        ) from error
    for name, facts in workers.items():
        if not facts["sees"]:
            raise OutputError(f"the worker {name} cannot write to {scratch}: choose a folder that all share")
        if facts["versions"] != here:
            raise ClusterError(
                f"the worker {name} has {facts['versions']} and this process {here}: install the same "
                "everywhere"
            )
    return dict(Counter(facts["cores"] for facts in workers.values()))


def outcomes(
    client: Client, jobs: Sequence[Job], retries: int, scratch: str, **setting: Any
) -> Generator[tuple[Job, Facts], None, None]:
    """Let workers render jobs, and yield each as it ends, with its facts or its "error".

    One that lost its worker, or failed by accident, is handed over again. ``setting``: of ``render_job``.
    """
    calls: dict[Future, Job] = {}
    handed: Counter[str] = Counter()
    coming = as_completed(loop=client.loop)

    def hand_over(job: Job) -> None:
        handed[job.name] += 1
        key = f"{os.path.basename(scratch)} {job.name} {handed[job.name]}"
        future = client.submit(worker.render_job, job, scratch=scratch, **setting, key=key, pure=False)
        calls[future] = job
        coming.add(future)

    try:
        for job in jobs:
            hand_over(job)
        for future in coming:
            job = calls.pop(future)
            if future.status == "cancelled":  # as all are where the scheduler goes; "lost": with its worker
                raise CancelledError
            facts = worker.outcome(job, scratch)
            ended = "error" in facts or "file" in facts
            # The engine holds a worker's death against all jobs that the worker had been given
            if facts.pop("again", not ended) and (
                facts["attempts"] <= retries and handed[job.name] < retries + MOST_DEATHS
            ):
                hand_over(job)
                continue
            if not ended:
                error = future.exception() if future.status == "error" else None
                died = error is None or isinstance(error, KilledWorker)
                facts["error"] = DIED if died else one_line(f"{type(error).__name__}: {error}")
            future.release()  # what no one needs is not computed again when its worker goes
            yield job, facts
    finally:
        if client.status == "running":
            client.cancel(list(calls))
