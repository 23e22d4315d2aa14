"""Pictures on disk: PNG as the report writes it or in sRGB, and EXR in float32 with layers and a header."""

from __future__ import annotations

import contextlib
import io
import json
import os
import stat
import sys
from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Any

from mrt_mitsuba.errors import OutputError, UsageError, reason, warn
from mrt_mitsuba.files.replacing import replacing
from mrt_mitsuba.interrupts import defer_signals, deliver_pending
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.options import StrPath, Values, check, choice

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image = NDArray[np.float32]

# For zlib to look for runs only: as fast as its level 1, and 161 kB for scene 3 in place of 206
PNG_RUNS = 3

MAX_EXR_NAME = 255  # bytes of the name of a channel or an attribute; the library cuts longer ones

COMPRESSION = choice("zip", "none")
TONEMAP = choice("report", "srgb")
_PIXELS = 2**14  # converted to 8 bit at a time, so that intermediate arrays stay in the processor's cache


Picture = namedtuple("Picture", "image layers header")
Picture.__doc__ = """An EXR as read: ``image`` [H, W, 3], and ``layers`` [H, W] by channel name ("depth.Z"),
all float32; ``header``: its values by name."""


def save(
    paths: StrPath | Sequence[StrPath],
    image: Image,
    *,
    layers: Mapping[str, Image] | None = None,
    header: Values | None = None,
    tonemap: str = "report",
    compression: str = "zip",
    inputs: Iterable[StrPath] = (),
) -> None:
    """Write a linear picture [H, W, 3] in the formats that the endings of ``paths`` name, .png or .exr.

    All files are replaced, or none. Layers, [H, W] by channel ("depth.Z"), header and ``compression`` ("zip",
    lossless, or "none") are for EXR files, ``tonemap`` (see ``to_8bit``) for PNG files. Header values are
    text or numbers; anything else is written as JSON. ``inputs``: files that the picture is made from.

    Raises ``OutputError`` for a file that cannot be written, or that is one of ``inputs``, and for pixels,
    names or values that a picture cannot hold; ``UsageError`` without a name of a file.
    """
    check("tonemap", TONEMAP, tonemap)
    check("compression", COMPRESSION, compression)
    paths = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not paths:
        raise UsageError('save: give the name of a file, such as "out.exr"')
    endings = []
    for path in paths:
        if not isinstance(path, str | os.PathLike):
            raise UsageError(f'save: {path!r} is no name of a file; give one such as "out.exr"')
        endings.append(os.path.splitext(os.fspath(path))[1].lower())
        if endings[-1] not in (".png", ".exr"):
            raise OutputError(f"cannot write {os.fspath(path)}: the name must end in .png or .exr")
    picture = _floats(image, "the picture")
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise OutputError(f"the picture has shape {picture.shape}; expected [H, W, 3], not empty")
    with replacing(*paths, inputs=inputs) as files:
        for file, ending in zip(files, endings, strict=True):
            if ending == ".png":
                _write_png(file, picture, tonemap)
            else:
                _write_exr(file, picture, layers or {}, header or {}, compression)


def _floats(values: Any, what: str) -> Image:
    """Return values as a float32 array; raise ``OutputError`` if they are not numeric."""
    import numpy as np

    try:
        if np.iscomplexobj(values):
            raise TypeError("they are complex")
        with np.errstate(over="ignore"):  # beyond float32 is infinite
            return np.asarray(values, np.float32)
    except (TypeError, ValueError) as error:
        raise OutputError(f"{what} is no array of numbers: {error}") from error


def _write_png(file: IO[bytes], image: Image, tonemap: str) -> None:
    from PIL import Image as PilImage

    picture = PilImage.fromarray(to_8bit(image, tonemap))
    picture.save(file, format="PNG", compress_type=PNG_RUNS)


def _write_exr(
    file: IO[bytes], image: Image, layers: Mapping[str, Image], header: Values, compression: str
) -> None:
    """Write the picture [H, W, 3] and its layers, which are copied only where the library would."""
    import numpy as np
    import OpenEXR

    planes = {"RGB": np.ascontiguousarray(image)}
    for name in (*layers, *header):
        _check_name(name)
    for name, values in layers.items():
        planes[name] = np.ascontiguousarray(_floats(values, f"layer {name}"))
        if planes[name].shape != image.shape[:2]:
            raise OutputError(f"layer {name} of shape {planes[name].shape} is no channel of the picture")
    attributes = {name: _attribute(name, value) for name, value in header.items()}
    raised: list[BaseException] = []

    def remembering(call: Callable[..., int], stops: bool) -> Callable[..., int]:
        """Return a method of the file that keeps what it raises, and raises it only if it ``stops``.

        In its destructor, where it writes the table of offsets, the library ignores what ``write`` raises,
        and ends the process for what ``seek`` or ``tell`` raise. After a fault, nothing is written.
        """

        def run(*arguments: Any) -> int:
            if not raised:
                try:
                    deliver_pending()
                    return call(*arguments)
                except BaseException as error:
                    raised.append(error)
                    if stops:
                        raise
            return 0

        return run

    # A stream in Python, as the library does not report a full disk when it opens the file itself
    methods = {name: remembering(getattr(file, name), name == "write") for name in ("tell", "seek", "write")}
    kind = OpenEXR.ZIP_COMPRESSION if compression == "zip" else OpenEXR.NO_COMPRESSION
    with defer_signals(), exr_threads():
        try:
            exr = OpenEXR.File({**attributes, "compression": kind, "type": OpenEXR.scanlineimage}, planes)
            exr.write(SimpleNamespace(**methods))
        except (RuntimeError, TypeError, ValueError) as error:
            if not raised:
                raise OutputError(f"not a picture that an EXR can hold: {error}") from error
        if raised:
            raise raised[0]


def _check_name(name: Any) -> None:
    """Raise ``OutputError`` for a name of a channel or an attribute that an EXR would cut or refuse."""
    try:
        size = 0 if "\0" in name else len(name.encode())
    except (TypeError, AttributeError, ValueError):  # no text, or a lone surrogate
        size = 0
    if not 0 < size <= MAX_EXR_NAME:
        shown = f"{name!r:.60}"
        raise OutputError(f"{shown} is no name that an EXR can hold: text of 1 to {MAX_EXR_NAME} bytes")


def _attribute(name: str, value: Any) -> str | int | float:
    """Return a header value as an EXR holds it: text and numbers as they are, anything else as JSON."""
    import numpy as np

    def plain(part: Any) -> Any:
        """Return a part that JSON does not know as numbers, or as text where it has a text of its own."""
        numbers = np.asarray(part)
        if numbers.dtype.kind in "biuf":
            return numbers.tolist()
        text = str(part)
        if isinstance(part, bytes) or " at 0x" in text:  # an address, another one each time
            raise TypeError(f"{type(part).__name__} {text:.60}")
        return text

    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) or (isinstance(value, int) and -(2**31) <= value < 2**31):
        return value
    try:
        text = value if isinstance(value, str) else json.dumps(value, default=plain)
    except (TypeError, ValueError) as error:
        raise OutputError(f"header {name}: neither text nor numbers nor JSON can hold {error}") from error
    return text.encode(errors="backslashreplace").decode()


@contextlib.contextmanager
def exr_threads() -> Iterator[None]:
    """Let the EXR library compress in threads, to the same file.

    The threads are gone afterwards: a process that is forked while it has some deadlocks.
    """
    import OpenEXR

    before = OpenEXR.global_thread_count()
    OpenEXR.set_global_thread_count(usable_cores())
    try:
        yield
    finally:
        OpenEXR.set_global_thread_count(before)


def read_exr(path: StrPath) -> Picture:
    """Read an EXR with the channels R, G, B; ``OutputError`` if it is none, or broken."""
    import numpy as np

    planes, headers = read_channels(path)
    for channel in "RGB":
        if channel not in planes:
            raise OutputError(f"cannot read {os.fspath(path)}: it has no channel {channel!r}")
    image = np.stack([planes.pop(channel) for channel in "RGB"], axis=-1)  # [H, W, 3]
    return Picture(image, planes, headers["R"])


def read_channels(path: StrPath) -> tuple[dict[str, Image], dict[str, dict[str, Any]]]:
    """Every channel of an EXR, [H, W] float32 by name, and the header of each.

    Where a file has several parts, their names come before those of their channels. Raises ``OutputError``
    for a file that is no EXR, or broken.
    """
    import numpy as np
    import OpenEXR

    name = os.fspath(path)
    try:
        if not stat.S_ISREG(os.stat(name).st_mode):  # a pipe has no end to wait for
            raise OutputError(f"cannot read {name}: it is not a regular file")
        with open(name, "rb") as file:  # reports an unreadable file better than the library
            file.read(1)
        with silenced():
            if any("deep" in str(part.type()) for part in OpenEXR.File(name, header_only=True).parts):
                raise OutputError(
                    f"cannot read {name}: a deep EXR has many values in a pixel; flatten it first"
                )
            parts = OpenEXR.File(name, separate_channels=True).parts
        if not parts:
            raise ValueError("no part of it can be read")
    except OSError as error:
        raise OutputError(f"cannot read {name}: {reason(error)}") from error
    except (RuntimeError, ValueError, TypeError) as error:
        raise OutputError(f"cannot read {name}: not a whole EXR ({error})") from error
    planes = {}
    headers = {}
    for part in parts:
        if len({values.pixels.shape for values in part.channels.values()}) > 1:
            raise OutputError(f"cannot read {name}: its channels differ in size; write them all at full size")
        for channel, values in part.channels.items():
            key = channel if len(parts) == 1 else f"{part.name()}.{channel}"
            planes[key] = np.asarray(values.pixels, np.float32)
            headers[key] = dict(part.header)
    return planes, headers


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Keep the EXR library from printing about broken files, in Python and in its own code."""
    sys.stderr.flush()
    before = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(before, 2)
        os.close(before)


def to_8bit(image: Image, tonemap: str = "report") -> NDArray[np.uint8]:
    """A linear picture [H, W, 3] in 8 bit.

    "report": trunc(255 c) clamped to 0..255, without gamma. "srgb": the sRGB transfer function (IEC
    61966-2-1) of the values clamped to 0..1, rounded. NaN becomes 0, with a warning.
    """
    import numpy as np

    check("tonemap", TONEMAP, tonemap)
    pixels = np.empty(image.shape, np.uint8)
    rows = max(1, _PIXELS // image.shape[1])
    lost = 0
    for row in range(0, len(image), rows):
        block = np.asarray(image[row : row + rows], np.float32)
        lost += int(np.isnan(block).any(axis=-1).sum())
        values = np.fmin(np.fmax(block, 0), 1)  # of NaN and a number, the number
        if tonemap == "report":
            values *= np.float32(255)
        else:
            encoded = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
            values = encoded * 255 + 0.5
        pixels[row : row + rows] = values.astype(np.uint8)
    if lost:
        warn(f"{lost} pixels are NaN; the PNG holds 0 there")
    return pixels


def png(image: Image) -> bytes:
    """A linear picture [H, W, 3] as a PNG file, in sRGB as screens expect it."""
    buffer = io.BytesIO()
    _write_png(buffer, image, "srgb")
    return buffer.getvalue()
