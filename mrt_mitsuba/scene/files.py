"""Reading the text files of a model: bytes, lines, numbers, and where a file that they name lies."""

from __future__ import annotations

import errno
import math
import os
import stat
from pathlib import Path

from mrt_mitsuba.errors import SceneError


def read_lines(path: Path) -> list[str]:
    """The logical lines of a text file; where one is continued with a backslash, empty ones follow it."""
    lines = decode(read_bytes(path)).split("\n")
    for i in range(len(lines) - 1, 0, -1):
        if lines[i - 1].endswith("\\"):
            lines[i - 1], lines[i] = lines[i - 1][:-1] + " " + lines[i], ""
    return lines


def require_file(path: str | os.PathLike[str]) -> None:
    """Raise ``SceneError`` unless ``path`` is a file that may be read. Pipes and devices have no end to wait
    for."""
    name, problem = os.fspath(path), ""
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISDIR(mode):
            problem = "it is a folder; name a file in it"
        elif not stat.S_ISREG(mode):
            problem = "it is not a regular file; copy its content into one"
        elif not os.access(path, os.R_OK):
            problem = f"permission denied; try chmod +r {name}"
    except (FileNotFoundError, NotADirectoryError):
        problem = f"there is no such file in {os.path.dirname(os.path.abspath(name))}"
    except ValueError as error:  # a zero byte in the name
        problem = str(error)
    except OSError as error:
        circle = error.errno == errno.ELOOP
        problem = "its symbolic links lead in a circle" if circle else error.strerror or str(error)
    if problem:
        raise SceneError(f"cannot read {name or repr(name)}: {problem}")


def read_bytes(path: Path) -> bytes:
    """The bytes of a text file, with Unix line ends. Raises ``SceneError`` if it cannot be read as text."""
    require_file(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"cannot read {path}: {error.strerror or error}") from None
    if b"\0" in data:
        raise SceneError(f"{path}: is not a text file (it holds a zero byte); export it as OBJ or MTL text")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data.removeprefix(b"\xef\xbb\xbf")


def decode(data: bytes) -> str:
    """Text of unknown encoding: UTF-8, else the Latin letters that older exporters wrote."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def find(name: str, folders: list[Path]) -> Path | None:
    """The file ``name`` relative to the first folder that has it; backslashes may separate folders."""
    for form in (name, name.replace("\\", "/")):
        for folder in folders:
            candidate = folder / form
            if candidate.is_file():
                return candidate
    return None


def numbers(where: str, statement: str, words: list[str], least: int, most: int) -> list[float]:
    """``least`` to ``most`` finite numbers. Raises ``SceneError`` that names the statement."""
    if not least <= len(words) <= most:
        wanted = f"{least}" if least == most else f"{least} to {most}"
        raise SceneError(f"{where}: {statement} has {len(words)} numbers, but must have {wanted}")
    values = []
    for word in words:
        try:
            value = float(word) if word.isascii() and "_" not in word else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) <= 3.4e38:  # the largest float32; false for NaN, too
            raise SceneError(f"{where}: {statement} holds {word!r}, which is not a finite number")
        values.append(value)
    return values
