"""Workers, on this machine or of a cluster that somebody else has started, and jobs on them.

Needs Dask, which only a sweep does.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import cryptography  # noqa: F401 - which Dask imports when it makes a key
from distributed import Client, Future, KilledWorker, Scheduler, SpecCluster, as_completed
from distributed.client import ClosedClientError
from distributed.deploy.subprocess import SubprocessWorker
from distributed.security import Security
from distributed.system import MEMORY_LIMIT

from mrt_mitsuba.errors import MrtError, OutputError, one_line
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.sweeps import worker
from mrt_mitsuba.sweeps.jobs import Facts, Job, encode

CONNECTING = 10  # seconds to reach a scheduler, and for its first worker to be there
STARTING = 120  # seconds for worker processes of this machine; a busy one takes its time
DIED = "every worker that rendered it died, perhaps for lack of memory: give each more"
LOOPBACK = "127.0.0.1"


class ClusterError(MrtError):
    """Workers cannot be reached, cannot be used, or are gone."""


@contextmanager
def connected(cluster: Any, jobs: int, workers: int | None) -> Iterator[Client]:
    """Give a client whose workers are there; see ``sweep``.

    Workers of this machine, at most as many as jobs, end with the block. Raises ``ClusterError`` if no
    scheduler with a worker answers, or if it goes away in the block.
    """
    with ExitStack() as stack:
        # Dask logs each broken connection; the caller gets one error
        for name in ("distributed", "distributed.client", "tornado.application"):
            logger = logging.getLogger(name)
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        count = 1
        patience = CONNECTING
        security = None
        if cluster is None:
            count = workers or min(usable_cores(), jobs)
            patience = STARTING
            security = Security.temporary()
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="mrt-sweep-"))
            cluster = stack.enter_context(_local(count, security, folder))
        try:
            client = cluster
            if not isinstance(cluster, Client):
                client = Client.__new__(Client)
                stack.callback(_close, client)
                Client.__init__(client, cluster, timeout=CONNECTING, set_as_default=False, security=security)
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
    """Close a client, also one that could not connect: closed by the garbage collector while Dask holds a
    lock, it deadlocks."""
    with suppress(Exception):
        client.close()


class LocalWorker(SubprocessWorker):
    """A worker process of this machine.

    It does not import the caller's script, which needs no ``if __name__ == "__main__"``. ``python -m dask``
    puts its working folder first in ``sys.path``, so it starts in a private one, ``folder``.
    """

    def __init__(self, *args: Any, folder: str, environ: dict[str, str], **options: Any) -> None:
        super().__init__(*args, **options)
        self.folder = folder
        self.environ = environ

    async def _start(self) -> None:
        spec = json.dumps({"cls": self.worker_class, "opts": self.worker_kwargs})
        command = [sys.executable, "-m", "dask", "spec", self.scheduler, "--spec", spec]
        environ = os.environ | self.environ
        self.process = await asyncio.create_subprocess_exec(*command, cwd=self.folder, env=environ)


def _local(count: int, security: Any, folder: str) -> SpecCluster:
    """Return a scheduler in this process, and workers in processes of their own with one thread for jobs.

    All listen on the loopback only, and talk TLS with a key made for this sweep, as other users of this
    machine can reach the loopback, too. The environment hands workers the key: other users see their command
    lines, but not that.
    """
    options = {
        "nthreads": 1,
        "memory_limit": MEMORY_LIMIT // count,
        "host": LOOPBACK,
        "dashboard": False,
        "dashboard_address": f"{LOOPBACK}:0",
        "local_directory": folder,
        "silence_logs": logging.CRITICAL,
        "config": {"distributed.worker.profile.enabled": False},  # it stops a job 100 times a second
    }
    tls = {"CA_FILE": security.tls_ca_file}
    tls |= {"WORKER__KEY": security.tls_worker_key, "WORKER__CERT": security.tls_worker_cert}
    environ = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": value for name, value in tls.items()}
    environ["DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION"] = "True"
    own = {"worker_kwargs": options, "folder": folder, "environ": environ}
    workers = {number: {"cls": LocalWorker, "options": own} for number in range(count)}
    scheduler = {
        "allowed_failures": 0,  # ``outcomes`` submits a job again that lost its worker
        "host": LOOPBACK,
        "protocol": "tls",
        "security": security,
        "dashboard": False,
        "dashboard_address": f"{LOOPBACK}:0",
    }
    return SpecCluster(workers=workers, scheduler={"cls": Scheduler, "options": scheduler}, security=security)


def inspect(client: Client, folder: str, here: str) -> dict[str, int]:
    """Return the number of workers that share each set of cores, see ``render_job``.

    Raises ``ClusterError`` or ``OutputError`` if a worker has other versions than those ``here`` or cannot
    write to the folder.
    """
    try:
        workers = client.run(worker.describe, folder)
    except Exception as error:  # whatever another Python or another version makes of it
        raise ClusterError(
            f"the workers cannot run this mrt-mitsuba ({type(error).__name__}: {error}): install {here} there"
        ) from error
    for name, facts in workers.items():
        if not facts["sees"]:
            raise OutputError(f"the worker {name} cannot write to {folder}: choose a folder that all share")
        if facts["versions"] != here:
            raise ClusterError(
                f"the worker {name} has {facts['versions']} and this process {here}: install the same "
                "everywhere"
            )
    return dict(Counter(facts["cores"] for facts in workers.values()))


def outcomes(
    client: Client, jobs: Sequence[Job], retries: int, **setting: Any
) -> Generator[tuple[Job, Facts], None, None]:
    """Let workers render jobs, and yield each as it ends, with its facts or its "error".

    A job that lost its worker or failed unexpectedly is submitted again, ``retries`` times at most.
    ``setting``: arguments of ``render_job``.
    """
    waiting = deque(jobs)
    submitted: dict[Future, Job] = {}
    attempts: Counter[str] = Counter()
    coming = as_completed(loop=client.loop)

    def submit() -> None:  # no more than run at once: a worker that dies takes along what it was given
        while waiting and len(submitted) < max(1, sum(client.nthreads().values())):
            job = waiting.popleft()
            attempts[job.name] += 1
            future = client.submit(worker.render_job, encode(job), **setting, pure=False)
            submitted[future] = job
            coming.add(future)

    try:
        submit()
        for future in coming:
            job = submitted.pop(future)
            if future.status == "cancelled":  # as all are where the scheduler goes
                raise CancelledError
            facts: Facts = {"attempts": attempts[job.name]}
            try:
                facts |= future.result()
            except CancelledError:
                raise
            except Exception as error:  # of the job, or its worker died
                died = isinstance(error, KilledWorker)
                facts["error"] = DIED if died else one_line(f"{type(error).__name__}: {error}")
                if attempts[job.name] <= retries:
                    waiting.append(job)
                    facts = {}
            submit()
            if facts:
                yield job, facts
    finally:
        if client.status == "running":
            client.cancel(list(submitted))
