"""The folder of a sweep: one sweep at a time, and what a killed one has left there.

A lock on a file in the folder says that a sweep works there. The system frees it when the process ends,
however it ends, and also on network file systems; one without locks lets two sweeps in, with a warning.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import OutputError, warn
from mrt_mitsuba.files.replacing import temporary_folder, unfinished

LOCK = ".mrt-sweep.lock"
_SCRATCH = ".mrt-sweep-"  # how the names of folders begin that a sweep removes at its end

Facts = dict[str, Any]  # of a picture, for its row of the table


@contextlib.contextmanager
def reserved(folder: str) -> Iterator[tuple[str, dict[str, Facts]]]:
    """Keep other sweeps out of a folder within the block.

    Yields a new folder inside, for files that are not complete, and the facts that a killed sweep noted of
    its pictures, by the name of the file. Raises ``OutputError`` where another sweep works, or nothing can
    be written.
    """
    with contextlib.ExitStack() as stack:
        try:
            alone = stack.enter_context(_locked(folder))
            notes = dict[str, Facts]()
            for left in Path(folder).iterdir() if alone else ():  # of killed sweeps
                if left.is_symlink() or not re.fullmatch(f"{re.escape(_SCRATCH)}[a-z0-9_]{{8}}", left.name):
                    continue
                for note in left.glob("*.json"):
                    noted = read_note(note)
                    if "file" in noted:
                        notes[noted["file"]] = noted
                shutil.rmtree(left, ignore_errors=True)
            scratch = stack.enter_context(temporary_folder(folder, _SCRATCH))
        except OSError as error:
            raise OutputError(f"cannot write to the folder {folder}: {error.strerror or error}") from error
        yield scratch, notes


@contextlib.contextmanager
def _locked(folder: str) -> Iterator[bool]:
    """Hold the lock of a folder within the block; yields False where its file system has no locks.

    Raises ``OutputError`` where another process has the lock.
    """
    path = os.path.join(folder, LOCK)
    alone = True
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            os.close(file)
            reason = "another sweep works there; wait for it, or choose another folder"
            raise OutputError(f"cannot write to the folder {folder}: {reason}") from None
        except OSError:
            alone = False
        if os.path.exists(path) and os.path.samestat(os.stat(path), os.fstat(file)):
            break
        os.close(file)  # the sweep before has just removed it
    unfinished.add(path)
    try:
        if not alone:
            warn(f"the file system of {folder} has no locks: see to it that no other sweep writes there")
        yield alone
    finally:
        with contextlib.suppress(OSError):
            os.unlink(path)  # while it is locked: who waits for it sees that it is no longer in its place
        unfinished.discard(path)
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)  # also for a child process that has the file open
        os.close(file)


def read_note(path: str | Path) -> Facts:
    """The facts in a note; none where it is missing, cut short or damaged."""
    with contextlib.suppress(OSError, ValueError), open(path, "rb") as file:
        noted = json.load(file)
        if isinstance(noted, dict):
            return noted
    return {}


def write_note(path: str, facts: Facts) -> None:
    """Write a note, whole or not at all."""
    with open(f"{path}.new", "w") as file:
        json.dump(facts, file)
    os.replace(f"{path}.new", path)
