"""Code in processes that have made the slow imports when they start."""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path

PROCESSES = multiprocessing.get_context("forkserver")
# Before anything chooses a variant of Mitsuba, so that no thread is lost with the fork
PROCESSES.set_forkserver_preload(["pytest", "mrt_mitsuba.validation.work_precision", "forked"])


def run(code: str, path: Path) -> None:
    """Run Python code in a process and the current folder of its own, with ``path`` as its first of modules.

    The folder is that which ``path`` is in. The code must end without an error.
    """
    log = path.parent / "log"
    process = PROCESSES.Process(target=_run, args=(code, path, log))
    process.start()
    process.join(300)
    process.kill()
    process.join()
    assert process.exitcode == 0, log.read_text()


def _run(code: str, path: Path, log: Path) -> None:
    with open(log, "w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.chdir(path.parent)
    sys.path.insert(0, str(path))
    exec(compile(code, "page", "exec"), {"__name__": "__main__"})
