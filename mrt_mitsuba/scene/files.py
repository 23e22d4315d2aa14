"""Reading the files of a scene: bytes, lines, and where the files they name are."""

from __future__ import annotations

import io
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path

from mrt_mitsuba.errors import SceneError, reason, warn
from mrt_mitsuba.options import StrPath

MAX_LINE_BYTES = 2**18  # bytes, about 40,000 corners of a face
_CONTINUED = b"\\\n"  # at the end of a line that goes on in the next
MISSING = "is missing or may not be read in"  # text of messages about missing files


def require_file(path: StrPath) -> None:
    """Raise ``SceneError`` unless ``path`` is a regular file with permission to read: pipes may never end."""
    name = os.fspath(path)
    problem = ""
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
    except (OSError, ValueError) as error:  # also of a zero byte in the name
        problem = reason(error)
    if problem:
        raise SceneError(f"cannot read {name or repr(name)}: {problem}")


def read_text(path: Path) -> bytes:
    """Return the bytes of a text file, with Unix line ends; raise ``SceneError`` for a binary file.

    Lines that end in a backslash are joined with the next; empty ones after them keep line numbers right.
    """
    require_file(path)
    data = path.read_bytes()
    if b"\0" in data:
        raise SceneError(f"{path}: is not a text file (it holds a zero byte); export it as OBJ or MTL text")
    data = re.sub(rb"\r\n?", b"\n", data).removeprefix(b"\xef\xbb\xbf") + b"\n"

    def joined(lines: re.Match[bytes]) -> bytes:
        return lines[0].replace(_CONTINUED, b" ") + b"\n" * lines[0].count(_CONTINUED)

    if _CONTINUED in data:
        data = re.sub(rb"(?m)^(?:.*\\\n)+.*\n", joined, data)
    longest = max(io.BytesIO(data), key=len).removesuffix(b"\n")
    if len(longest) > MAX_LINE_BYTES:
        number = data.count(b"\n", 0, data.find(longest)) + 1
        raise SceneError(
            f"{path}:{number}: a line of {len(longest)} bytes; at most {MAX_LINE_BYTES} are read"
        )
    return data


def decode(data: bytes) -> str:
    """Decode text of unknown encoding: UTF-8, or else Latin-1, as older exporters wrote."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def find(name: str, folders: list[Path]) -> Path | None:
    """Return the file ``name`` in the first folder where it may be read, or None.

    It may be written with backslashes, as on Windows or before blanks, or in quotes.
    """
    forms = dict.fromkeys([name, name.replace("\\ ", " "), name.replace("\\", "/"), name.strip('"')])
    places = (os.path.join(folder, form) for form in forms for folder in folders)
    found = next((place for place in places if os.path.isfile(place) and os.access(place, os.R_OK)), None)
    return Path(found) if found else None


def has_alpha(path: StrPath) -> bool:
    """True if a picture is transparent somewhere."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return picture.convert("RGBA").getextrema()[3][0] < 255
    except Exception:  # whatever the library raises on broken files; reading the texture reports it
        return False


def warn_of(findings: Mapping[str, list[str]]) -> None:
    """Warn of the first finding of each kind, a plural noun, with the number of the others."""
    for kind, texts in findings.items():
        more = f"; {len(texts) - 1} more {kind} likewise" if texts[1:] else ""
        if texts:
            warn(f"{texts[0]}{more}")
