"""Putting files in the place of others: all of one result, or none.

New files are written next to the old ones under temporary names. Once all are complete and on the disk, they
take the places of the old; if anything goes wrong before, they disappear. What a killed process left
is removed by the next one that writes to the folder: a lock says whether its writer still lives.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import IO

from mrt_mitsuba.errors import OutputError

log = logging.getLogger(__name__)

Path = str | os.PathLike[str]

_PREFIX, _SUFFIX = ".mrt-", ".tmp"
_OLD = 10.0  # seconds after which a file that nobody has locked has been left behind
_unfinished: set[str] = set()  # temporary files of this process
_tidied: set[str] = set()  # folders


def check_target(path: Path) -> None:
    """Raise ``OutputError`` if ``path`` cannot be written; to be asked before the work. Leaves no trace."""
    with _explained(path):
        temporary, file = _open_next_to(_target(path))
        file.close()
        _discard(temporary)


def check_not_read(paths: Sequence[Path], pictures: Iterable[Path]) -> None:
    """Raise ``OutputError`` if one of the paths is one of the pictures that a scene is read from."""
    read = set(map(os.path.realpath, pictures))
    for path in paths:
        if os.path.realpath(path) in read:
            raise OutputError(
                f"cannot write {os.fspath(path)}: the scene uses this picture; choose another name"
            )


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Give a binary file to write to, which takes the place of ``path`` when all went well.

    A symbolic link stays and its target is replaced. Whatever is raised inside, the old file is left as it
    was and no temporary file remains; an ``OSError`` becomes an ``OutputError``.
    """
    with replacing_together([path]) as (file,):
        yield file


@contextlib.contextmanager
def replacing_together(paths: Sequence[Path]) -> Iterator[list[IO[bytes]]]:
    """Give a file for each of several paths, as ``replacing`` does; all are replaced, or none."""
    written: list[tuple[str, str]] = []  # temporary file, target
    with contextlib.ExitStack() as stack:
        try:
            files = []
            for path in paths:
                with _explained(path):
                    target = _target(path)
                    temporary, file = _open_next_to(target)
                    stack.callback(_close, file)
                    written.append((temporary, target))
                    files.append(file)
            with _explained(*paths):
                yield files
            for path, file, (temporary, target) in zip(paths, files, written, strict=True):
                with _explained(path):
                    file.flush()
                    os.fsync(file.fileno())
                    if os.path.exists(target):
                        os.chmod(temporary, stat.S_IMODE(os.stat(target).st_mode))
            with _explained(*paths):
                _rename(written)
        finally:
            for temporary, _ in written:
                _discard(temporary)
    for _, target in written:
        log.info("wrote %s", target)


def _close(file: IO[bytes]) -> None:
    with contextlib.suppress(OSError):  # of what a full disk has no room for; good files have been flushed
        file.close()


def _rename(files: Sequence[tuple[str, str]]) -> None:
    """Put all files in their places; an interrupt in between is raised afterwards."""
    waiting, interrupt = list(files), None
    while waiting:
        try:
            while waiting:
                if os.path.exists(waiting[0][0]):
                    os.replace(*waiting[0])
                del waiting[0]
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        raise interrupt


def discard_unfinished() -> None:
    """Remove the temporary files of this process; for one about to end by force."""
    for temporary in tuple(_unfinished):
        _discard(temporary)


def _discard(temporary: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(temporary)
    _unfinished.discard(temporary)


@contextlib.contextmanager
def _explained(*paths: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        names = " and ".join(os.fspath(path) for path in paths)
        raise OutputError(f"cannot write {names}: {error.strerror or error}") from error


def _target(path: Path) -> str:
    """Return the real path to write; raise ``OutputError`` where replacing a file there would be wrong."""
    name = os.fspath(path)
    target = os.path.realpath(name)
    folder = os.path.dirname(target)
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise OutputError(f"cannot write {name}: {folder} is a file, not a folder; choose another place")
    if not os.path.isdir(folder):
        raise OutputError(f"cannot write {name}: the folder {folder} does not exist; create it first")
    try:
        found = os.lstat(target)
    except FileNotFoundError:
        return target
    mode, problem = found.st_mode, ""
    if stat.S_ISLNK(mode):
        problem = "its symbolic links lead in a circle"
    elif stat.S_ISDIR(mode):
        problem = "it is a folder; choose another name"
    elif not stat.S_ISREG(mode):
        problem = "it is not a regular file"
    # The superuser may write to any file; its owner's "read-only" is respected all the same.
    elif not mode & 0o222 or not os.access(target, os.W_OK):
        problem = "the file is read-only; remove it or choose another name"
    elif _is_kept_by(found.st_uid, os.stat(folder)):
        problem = "the file is another user's, and only its owner may replace it here; choose another name"
    if problem:
        raise OutputError(f"cannot write {name}: {problem}")
    return target


def _is_kept_by(owner: int, folder: os.stat_result) -> bool:
    """Return whether a folder such as /tmp (with a sticky bit) forbids this user to replace a file in it."""
    return bool(folder.st_mode & stat.S_ISVTX) and os.geteuid() not in (0, owner, folder.st_uid)


def _open_next_to(target: str) -> tuple[str, IO[bytes]]:
    """Create and lock a new file in the folder of ``target``, with the rights the user's umask gives."""
    folder = os.path.dirname(target)
    _tidy(folder)
    temporary = os.path.join(folder, f"{_PREFIX}{os.urandom(8).hex()}{_SUFFIX}")
    _unfinished.add(temporary)
    descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    with contextlib.suppress(OSError):  # not every file system can
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return temporary, os.fdopen(descriptor, "w+b")


def _tidy(folder: str) -> None:
    """Remove what killed processes left in a folder, once."""
    if folder in _tidied:
        return
    _tidied.add(folder)
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(_PREFIX) and entry.name.endswith(_SUFFIX):
                with contextlib.suppress(OSError):
                    _remove_if_left(entry)


def _remove_if_left(entry: os.DirEntry[str]) -> None:
    found = entry.stat(follow_symlinks=False)
    if not stat.S_ISREG(found.st_mode) or time.time() - found.st_mtime < _OLD:
        return
    descriptor = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while its writer lives
        os.unlink(entry.path)
    finally:
        os.close(descriptor)
