"""Clusters of Dask for tests: a scheduler and workers in processes of their own."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

distributed = pytest.importorskip("distributed")

PATIENCE = 120  # seconds for anything that processes do; a busy machine is no failure


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Return what a condition gives as soon as it is true."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"waited in vain for {what}")


class Cluster:
    """A scheduler and workers, started by hand; ``preload``: Python code that each worker runs first."""

    def __init__(self, folder: Path, preload: str = "", *words: str, count: int = 2) -> None:
        self.folder = folder
        self.count = count
        self.words = words
        self.workers = []
        (folder / "preload.py").write_text(preload)
        self.start_scheduler()
        self.start_workers()

    def start_scheduler(self, port: str = "0") -> None:
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        self.scheduler = self._start("scheduler", "--port", port)

        def ready() -> bool:
            if self.scheduler.poll() is not None:  # its port was taken, for a moment
                self.scheduler = self._start("scheduler", "--port", port)
            return file.exists() and file.read_text().endswith("}")

        wait_for(ready, "a scheduler")
        self.address = json.loads(file.read_text())["address"]

    def start_workers(self) -> None:
        own = ["--nthreads", "1", "--local-directory", str(self.folder), "--preload", "preload.py"]
        self.workers += [self._start("worker", *own, *self.words) for _ in range(self.count)]
        with distributed.Client(self.address, timeout=PATIENCE, set_as_default=False) as client:
            client.wait_for_workers(self.count, timeout=PATIENCE)

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        environ = os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
        common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", "scheduler.json"]
        with open(self.folder / "log", "ab") as log:
            options: dict[str, Any] = {"env": environ, "stdout": log, "stderr": log}
            command = [sys.executable, "-m", "dask", *words, *common]
            return subprocess.Popen(command, cwd=self.folder, start_new_session=True, **options)

    def stop(self) -> None:
        """End all processes, also those that the workers have started."""
        for process in (*self.workers, self.scheduler):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
