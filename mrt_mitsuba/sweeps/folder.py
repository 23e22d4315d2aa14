"""The folder of a sweep, in which one sweep works at a time.

The system frees the lock when the process ends, however it ends, and also on network file systems; one
without locks lets two sweeps in, with a warning.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from mrt_mitsuba.errors import OutputError, warn

LOCK = ".mrt-sweep.lock"


@contextlib.contextmanager
def reserved(folder: str) -> Iterator[None]:
    """Keep other sweeps out of a folder within the block, by a lock on a file in it.

    Raises ``OutputError`` if another process has the lock, or nothing can be written.
    """
    path = os.path.join(folder, LOCK)
    try:
        file = _locked(path)
    except (BlockingIOError, PermissionError) as error:
        reason = "another sweep works there; wait for it, or choose another folder"
        if not os.path.exists(path):
            reason = error.strerror or str(error)
        raise OutputError(f"cannot write to the folder {folder}: {reason}") from None
    except OSError as error:
        raise OutputError(f"cannot write to the folder {folder}: {error.strerror or error}") from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.unlink(path)  # while it is locked: who waits for it sees that it is no longer in its place
        os.close(file)


def _locked(path: str) -> int:
    """Return the descriptor of a new lock; raises ``BlockingIOError`` if another process has it."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            import fcntl  # which Windows has not

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            os.close(file)
            raise
        except (ImportError, OSError):
            warn(f"{os.path.dirname(path)} has no file locks: do not run a second sweep there")
        if os.path.exists(path) and os.path.samestat(os.stat(path), os.fstat(file)):
            return file
        os.close(file)  # the sweep before has just removed it
