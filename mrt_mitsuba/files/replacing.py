"""Atomic replacement of files: all of one result or none, and never an input of the result.

New files are written next to the old ones under temporary names. Once all are complete and on the disk, they
replace the old; after any earlier error, they are deleted.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable, Iterator
from typing import IO

from mrt_mitsuba.errors import OutputError, reason
from mrt_mitsuba.interrupts import defer_signals
from mrt_mitsuba.options import StrPath

TEMPORARY = ".mrt-{}.tmp"


def check_target(path: StrPath, inputs: Iterable[StrPath] = ()) -> None:
    """Raise ``OutputError`` if ``path`` cannot be written; for use before the work. Leaves no trace.

    ``inputs``: files that the work reads; none of them is written, by whatever path or link.
    """
    with _explained(path), _temporary(os.path.dirname(_target(path, inputs))):
        pass


@contextlib.contextmanager
def replacing(*paths: StrPath, inputs: Iterable[StrPath] = ()) -> Iterator[list[IO[bytes]]]:
    """Give binary files to write to, which replace ``paths``, all of them, once all has gone well.

    A symbolic link stays and its target is replaced. Whatever is raised inside, the old files stay as they
    were and no temporary file remains; an ``OSError`` becomes an ``OutputError``. ``inputs``: as in
    ``check_target``.
    """
    with contextlib.ExitStack() as stack:
        targets: dict[IO[bytes], str] = {}  # by the new file
        for path in paths:
            with _explained(path):
                target = _target(path, inputs)
                targets[stack.enter_context(_temporary(os.path.dirname(target)))] = target
        with _explained(*paths):
            yield [*targets]
            for file, target in targets.items():
                file.flush()
                os.fsync(file.fileno())
                if os.path.exists(target):
                    os.chmod(file.name, stat.S_IMODE(os.stat(target).st_mode))
            with defer_signals():  # an interrupt in between is raised afterwards
                for file, target in targets.items():
                    os.replace(file.name, target)


@contextlib.contextmanager
def _explained(*paths: StrPath) -> Iterator[None]:
    try:
        yield
    except (OSError, UnicodeEncodeError) as error:  # a lone surrogate in a name
        names = " and ".join(os.fspath(path) for path in paths)
        raise OutputError(f"cannot write {names}: {reason(error)}") from error


def _target(path: StrPath, inputs: Iterable[StrPath]) -> str:
    """The real path to write; ``OutputError`` where replacing a file would be wrong."""
    name = os.fspath(path)
    if "\0" in name or os.path.basename(name) in ("", ".", ".."):
        raise OutputError(f"cannot write {name!r}: it names no file")
    target = os.path.realpath(name)
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        problem = "is a file, not a folder; choose another folder"
        problem = problem if os.path.exists(folder) else "does not exist; create it first"
        raise OutputError(f"cannot write {name}: {folder} {problem}")
    try:
        old = os.lstat(target)
    except FileNotFoundError:
        return target
    problem = ""
    if stat.S_ISLNK(old.st_mode):
        problem = "its symbolic links lead in a circle"
    elif stat.S_ISDIR(old.st_mode):
        problem = "it is a folder; choose another name"
    elif not stat.S_ISREG(old.st_mode):
        problem = "it is not a regular file"
    elif any(os.path.exists(each) and os.path.samefile(target, each) for each in inputs):
        problem = "what is written is made from this file; choose another name"
    # The superuser may write to any file; its owner's "read-only" is respected all the same
    elif not old.st_mode & 0o222 or not os.access(target, os.W_OK):
        problem = "the file is read-only; remove it or choose another name"
    if problem:
        raise OutputError(f"cannot write {name}: {problem}")
    return target


def make_folder(folder: StrPath) -> str:
    """Return the absolute path of a folder, made if need be. Raises ``OutputError``."""
    try:
        path = os.path.abspath(os.fsdecode(folder))
        os.makedirs(path, exist_ok=True)
    except (OSError, TypeError, ValueError) as error:  # also of a zero byte, or a lone surrogate
        raise OutputError(f"cannot make the folder {folder!s}: {reason(error)}; choose another") from error
    return path


@contextlib.contextmanager
def _temporary(folder: str) -> Iterator[IO[bytes]]:
    """Give a new file in a folder, with the rights of the user's umask; remove it at the end."""
    name = os.path.join(folder, TEMPORARY.format(os.urandom(8).hex()))
    try:
        new = open(name, "x+b")  # noqa: SIM115 - closing it may fail
        try:
            yield new
        finally:
            with contextlib.suppress(OSError):  # a full disk has no room for the rest
                new.close()
    finally:
        with contextlib.suppress(OSError):
            os.unlink(name)
