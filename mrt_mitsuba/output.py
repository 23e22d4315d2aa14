"""Pictures on disk: PNG as the report writes it or in sRGB, and EXR in float32 with layers and a header.

A picture replaces the file of that name only once it is complete and on the disk: it is written beside it
under a temporary name, which also disappears if anything goes wrong.
"""

from __future__ import annotations

import contextlib
import os
import stat
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any

from mrt_mitsuba.errors import MrtWarning, OutputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image = NDArray[np.float32]

# The layers of an EXR and their channels, in the order in which the last axis of an array holds them.
LAYERS = {
    "depth": "Z",
    "normal": "XYZ",
    "albedo": "RGB",
    "edges": "Y",
    "samples": "Y",
    "blur": "Y",
    "direct": "RGB",
    "reflection": "RGB",
    "bounces": "Y",
}
_unfinished: set[str] = set()  # temporary files
_ROWS = 256  # rows converted to 8 bit at a time, to bound the memory of intermediate arrays


@dataclass(frozen=True)
class Picture:
    """An EXR as read: ``image`` [H, W, 3], ``layers`` [H, W] by channel name ("depth.Z"), all float32."""

    image: Image
    layers: dict[str, Image]
    header: dict[str, Any]


def save(
    path: str | os.PathLike[str],
    image: Image,
    *,
    layers: Mapping[str, Image] | None = None,
    header: Mapping[str, Any] | None = None,
    tonemap: str = "report",
) -> None:
    """Write a picture [H, W, 3] in the format that the extension of ``path`` names, .png or .exr.

    Layers and header go into an EXR only, ``tonemap`` concerns a PNG only. Raises ``OutputError``.
    """
    ending = os.path.splitext(os.fspath(path))[1].lower()
    if ending == ".png":
        write_png(path, image, tonemap=tonemap)
    elif ending == ".exr":
        write_exr(path, image, layers or {}, header or {})
    else:
        raise OutputError(f"cannot write {os.fspath(path)}: the name must end in .png or .exr")


def write_png(path: str | os.PathLike[str], image: Image, *, tonemap: str = "report") -> None:
    """Write a linear picture [H, W, 3] as PNG; ``tonemap`` as in ``to_8bit``. Raises ``OutputError``."""
    from PIL import Image as PilImage

    pixels = to_8bit(image, tonemap)
    with replacing(path) as file:
        PilImage.fromarray(pixels).save(file, format="PNG")


def write_exr(
    path: str | os.PathLike[str],
    image: Image,
    layers: Mapping[str, Image] | None = None,
    header: Mapping[str, Any] | None = None,
) -> None:
    """Write a linear picture [H, W, 3] as float32 EXR, with layers (see ``channels``) and header attributes.

    Header values are text or numbers; anything else is written as JSON. Raises ``OutputError``.
    """
    import OpenEXR

    attributes = {name: _attribute(value) for name, value in (header or {}).items()}
    attributes |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    # The library does not report a full disk when it opens the file itself, so the file is ours.
    picture = OpenEXR.File(attributes, channels(image, layers or {}))
    with replacing(path) as file:
        picture.write(file)


def read_exr(path: str | os.PathLike[str]) -> Picture:
    """Read an EXR with the channels R, G, B; raise ``OutputError`` if there is none or it is broken."""
    import numpy as np
    import OpenEXR

    name = os.fspath(path)
    try:
        with open(name, "rb") as file:  # reports a missing or unreadable file better than the library
            file.read(1)
        part = OpenEXR.File(name, separate_channels=True)
        planes = {key: np.asarray(value.pixels, np.float32) for key, value in part.channels().items()}
        image = np.stack([planes.pop(channel) for channel in "RGB"], axis=-1)  # [H, W, 3]
    except KeyError as error:
        raise OutputError(f"cannot read {name}: it has no channel {error}") from error
    except OSError as error:
        raise OutputError(f"cannot read {name}: {error.strerror or error}") from error
    except (RuntimeError, ValueError, TypeError) as error:
        raise OutputError(f"cannot read {name}: not a whole EXR ({error})") from error
    return Picture(image, planes, dict(part.header()))


def to_8bit(image: Image, tonemap: str = "report") -> NDArray[np.uint8]:
    """Return a linear picture [H, W, 3] in 8 bit.

    "report": trunc(255 c) clamped to 0..255, without gamma. "srgb": the sRGB transfer function (IEC
    61966-2-1) of the values clamped to 0..1, rounded. NaN becomes 0, with a warning.
    """
    import numpy as np

    convert = {"report": _report_levels, "srgb": _srgb_levels}[tonemap]
    pixels = np.empty(image.shape, np.uint8)
    lost = 0
    for row in range(0, len(image), _ROWS):
        block = np.asarray(image[row : row + _ROWS], np.float32)
        lost += int(np.isnan(block).any(axis=-1).sum())
        pixels[row : row + _ROWS] = convert(np.nan_to_num(np.clip(block, 0, 1), nan=0.0))
    if lost:
        warnings.warn(f"{lost} pixels are NaN; the PNG holds 0 there", MrtWarning, stacklevel=3)
    return pixels


def _report_levels(values: Image) -> NDArray[np.uint8]:
    import numpy as np

    return (values * np.float32(255)).astype(np.uint8)


def _srgb_levels(values: Image) -> NDArray[np.uint8]:
    import numpy as np

    encoded = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).astype(np.uint8)


def channels(image: Image, layers: Mapping[str, Image]) -> dict[str, Image]:
    """Return the EXR channels, [H, W] each, of a picture [H, W, 3] and its layers.

    A layer is named by one channel ("depth.Z", [H, W]) or as a whole ("depth", [H, W]; "normal", [H, W, 3]),
    with the channels of ``LAYERS``, else R, G, B or Y. Raises ``OutputError`` if a shape does not fit.
    """
    import numpy as np

    planes: dict[str, Image] = {}
    for name, array in {"": image, **layers}.items():
        array = np.asarray(array, np.float32)
        if array.shape[:2] != np.shape(image)[:2] or array.ndim not in (2, 3):
            raise OutputError(f"layer {name or 'R,G,B'} of shape {array.shape} does not fit the picture")
        prefix = f"{name}." if name else ""
        array = np.atleast_3d(array)
        letters = LAYERS.get(name, "RGB" if array.shape[2] == 3 else "Y")
        names = [name] if "." in name else [prefix + letter for letter in letters]
        if len(names) != array.shape[2]:
            raise OutputError(
                f"layer {name or 'R,G,B'} has {array.shape[2]} channels in place of {len(names)}"
            )
        for index, channel in enumerate(names):
            planes[channel] = np.ascontiguousarray(array[:, :, index])
    return planes


def _attribute(value: Any) -> str | int | float:
    import json

    return value if isinstance(value, str | int | float) else json.dumps(value)


def check_target(path: str | os.PathLike[str]) -> None:
    """Raise ``OutputError`` if ``path`` cannot be written; to be asked before the work. Leaves no trace."""
    with _explained(path):
        temporary, file = _open_beside(_target(path))
        file.close()
        os.unlink(temporary)
        _unfinished.discard(temporary)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Give a binary file to write to, which takes the place of ``path`` when all went well.

    A symbolic link stays and its target is replaced. Whatever is raised inside, the old file is left as it
    was and no temporary file remains; an ``OSError`` becomes an ``OutputError``.
    """
    with _explained(path):
        target = _target(path)
        temporary, file = _open_beside(target)
        try:
            with file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if os.path.exists(target):
                os.chmod(temporary, stat.S_IMODE(os.stat(target).st_mode))
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        finally:
            _unfinished.discard(temporary)


def discard_unfinished() -> None:
    """Remove the temporary files of pictures that are being written; for a process about to end by force."""
    for temporary in tuple(_unfinished):
        with contextlib.suppress(OSError):
            os.unlink(temporary)


@contextlib.contextmanager
def _explained(path: str | os.PathLike[str]) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write {os.fspath(path)}: {error.strerror or error}") from error


def _target(path: str | os.PathLike[str]) -> str:
    """Return the real path to write; raise ``OutputError`` where replacing a file there would be wrong."""
    name = os.fspath(path)
    target = os.path.realpath(name)
    folder = os.path.dirname(target)
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise OutputError(f"cannot write {name}: {folder} is a file, not a folder; choose another place")
    if not os.path.isdir(folder):
        raise OutputError(f"cannot write {name}: the folder {folder} does not exist; create it first")
    try:
        mode = os.lstat(target).st_mode
    except FileNotFoundError:
        return target
    if stat.S_ISLNK(mode):
        raise OutputError(f"cannot write {name}: its symbolic links lead in a circle")
    if stat.S_ISDIR(mode):
        raise OutputError(f"cannot write {name}: it is a folder; choose another name")
    if not stat.S_ISREG(mode):
        raise OutputError(f"cannot write {name}: it is not a regular file")
    # The superuser may write to any file; its owner's "read-only" is respected all the same.
    if not mode & 0o222 or not os.access(target, os.W_OK):
        raise OutputError(f"cannot write {name}: the file is read-only; remove it or choose another name")
    return target


def _open_beside(target: str) -> tuple[str, IO[bytes]]:
    """Create a new file in the folder of ``target``, with the rights the user's umask gives."""
    temporary = os.path.join(os.path.dirname(target), f".mrt-{os.urandom(8).hex()}.tmp")
    _unfinished.add(temporary)
    descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
    return temporary, os.fdopen(descriptor, "w+b")
