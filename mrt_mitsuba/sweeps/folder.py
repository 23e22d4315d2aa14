"""The folder of a sweep, in which one sweep works at a time.

The system frees the lock when the process ends, however it ends, and also on network file systems.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.files.replacing import TEMPORARY

LOCK = ".mrt-sweep.lock"


@contextlib.contextmanager
def reserved(folder: str) -> Iterator[None]:
    """Keep other sweeps out of a folder within the block, by a lock on a file in it.

    Raises ``OutputError`` if another process has the lock, or nothing can be written.
    """
    import fcntl

    path = os.path.join(folder, LOCK)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open(path, "w"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            reason = error.strerror
            if isinstance(error, BlockingIOError):
                reason = "another sweep works there; wait for it, or choose another folder"
            raise OutputError(f"cannot write to the folder {folder}: {reason}") from None
        try:
            yield
        finally:
            Path(path).unlink(missing_ok=True)
            for left in Path(folder).glob(TEMPORARY.format("*")):  # by workers that were killed
                left.unlink(missing_ok=True)
