"""The folder of a sweep, in which one sweep works at a time, and which of its pictures are up to date."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import OpenEXR

from mrt_mitsuba.errors import OutputError, reason
from mrt_mitsuba.files.images import silenced
from mrt_mitsuba.files.replacing import TEMPORARY
from mrt_mitsuba.sweeps.jobs import Job

MADE_WITH = "mrt:sweep"  # in the header of each picture: its job's ``made_with``
LOCK = ".mrt-sweep.lock"


@contextlib.contextmanager
def reserved(folder: str) -> Iterator[None]:
    """Keep other sweeps out of a folder within the block, by a lock on a file in it.

    The system frees it when the process ends, however it ends, and also on network file systems.
    Raises ``OutputError`` if another process has the lock, or nothing can be written.
    """
    import fcntl

    path = os.path.join(folder, LOCK)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open(path, "w"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            why = reason(error)
            if isinstance(error, BlockingIOError):
                why = "another sweep works there; wait for it, or choose another folder"
            raise OutputError(f"cannot write to the folder {folder}: {why}") from None
        try:
            yield
        finally:
            Path(path).unlink(missing_ok=True)
            for left in Path(folder).glob(TEMPORARY.format("*")):  # by workers that were killed
                left.unlink(missing_ok=True)


def is_fresh(job: Job, folder: str, recorded: bool) -> bool:
    """True if a job's picture is whole and was made by the same scene, settings and versions.

    ``recorded``: the folder's table has the picture. Raises ``OutputError`` for a file of the user's own
    under its name: a picture that no sweep made, or something unreadable that the table does not have.
    """
    path = os.path.join(folder, job.file)
    if not os.path.lexists(path):
        return False
    found = _fingerprint_in(path)
    if found == "" or (found is None and not (recorded and os.path.isfile(path))):
        raise OutputError(
            f"{path} was not made by a sweep, which would replace it: move it away, or choose another folder"
        )
    return found == job.made_with


def _fingerprint_in(path: str) -> str | None:
    """Return the ``made_with`` in a picture that a sweep made: "" in any other, None in a damaged file."""
    if not os.path.isfile(path):  # a pipe has no end to wait for
        return None
    try:
        with silenced():
            return str(OpenEXR.File(path).header().get(MADE_WITH, ""))
    except Exception:  # whatever the library raises for damaged files
        return None
