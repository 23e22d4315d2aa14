"""The options of the ``mrt`` command: one table for parsing, checking, defaults and the help text.

The table is the class ``Options``: each field holds its default, its kind (how text becomes a value and which
values are allowed) and a line of help. The Python interface checks its arguments with the same table through
``check``.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.command.logs import LEVELS
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.output.files import LAYERS
from mrt_mitsuba.scene.report import NUMBERS

LARGEST_SIDE = 65536  # pixels; whether the memory suffices is checked where it is planned
LARGEST_AA = 64  # 4096 samples per pixel; beyond, float32 sums lose more than more samples gain
# A scene file has its own, unless these are given
DECIDED_BY_FILE = ("width", "height", "fresnel")
# An OBJ file has neither camera nor lights; other scenes have their own
FOR_MODELS = ("texturing", "camera", "target", "up", "fov", "light")
UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}
SMALLEST_MEMORY = 64 * 2**20  # bytes; about what one tile with all layers takes


@dataclass(frozen=True)
class Kind:
    """A kind of value. ``form`` is the help's "name=form", ``allowed`` completes "must be ...".

    ``from_text`` turns text into a value, ``check`` returns an allowed value; both raise ValueError or
    TypeError.
    """

    form: str
    allowed: str
    from_text: Callable[[str], Any]
    check: Callable[[Any], Any]


def integer(low: int, high: int) -> Kind:
    """A whole number in [low, high]."""

    def check(value: Any) -> int:
        if isinstance(value, bool) or not low <= operator.index(value) <= high:
            raise ValueError
        return operator.index(value)

    return Kind("N", f"a whole number from {low} to {high}", lambda text: int(_plain(text)), check)


def number(low: float) -> Kind:
    """A finite number ≥ low."""

    def check(value: Any) -> float:
        if isinstance(value, bool) or not (math.isfinite(value) and value >= low):
            raise ValueError
        return float(value)

    return Kind("X", f"a finite number, {low:g} or more", lambda text: float(_plain(text)), check)


def choice(*names: str) -> Kind:
    """One of some names."""

    def check(value: Any) -> str:
        if value not in names:
            raise ValueError
        return str(value)

    return Kind("|".join(names), _either(names), str, check)


def switch() -> Kind:
    """Yes or no."""
    words = {"1": True, "0": False, "yes": True, "no": False, "true": True, "false": False}

    def check(value: Any) -> bool:
        if value not in (False, True):
            raise ValueError
        return bool(value)

    return Kind("1|0", "1 or 0", lambda text: words.get(text.lower()), check)


def subset(known: Iterable[str]) -> Kind:
    """A comma list of known names, each once, or ``all``."""
    known = tuple(known)

    def from_text(text: str) -> tuple[str, ...]:
        return known if text == "all" else tuple(text.split(","))

    def check(value: Any) -> tuple[str, ...]:
        if isinstance(value, str):
            value = from_text(value)
        if len(set(value)) != len(value) or not set(value) <= set(known):
            raise ValueError
        return tuple(value)

    return Kind("A,B,..", f"a comma list out of {', '.join(known)}, each once, or all", from_text, check)


def angle() -> Kind:
    """Degrees between 0 and 180, without these."""

    def check(value: Any) -> float:
        if isinstance(value, bool) or not 0 < value < 180:
            raise ValueError
        return float(value)

    return Kind("DEGREES", "degrees, more than 0 and less than 180", lambda text: float(_plain(text)), check)


def vector(form: str = "X,Y,Z") -> Kind:
    """Three finite numbers."""

    def check(value: Any) -> tuple[float, float, float]:
        x, y, z = (float(coordinate) for coordinate in value)
        if not all(map(math.isfinite, (x, y, z))):
            raise ValueError
        return x, y, z

    def from_text(text: str) -> list[float]:
        return [float(_plain(part)) for part in text.split(",")]

    return Kind(form, "three finite numbers separated by commas", from_text, check)


def size() -> Kind:
    """A number of bytes, as text with a unit: 4G, 512M."""

    def from_text(text: str) -> int:
        upper = _plain(text).upper().removesuffix("B").removesuffix("I")
        unit = upper[-1:] if upper[-1:] in UNITS else ""
        return int(float(upper.removesuffix(unit)) * UNITS[unit])

    def check(value: Any) -> int:
        value = from_text(value) if isinstance(value, str) else operator.index(value)
        if value < SMALLEST_MEMORY:
            raise ValueError
        return value

    return Kind(
        "BYTES", "bytes with an optional unit K, M, G or T, at least 64M, such as 4G", from_text, check
    )


def word() -> Kind:
    """A name made of letters, digits and underscores, such as a variant."""

    def check(value: Any) -> str:
        if not (isinstance(value, str) and value.isidentifier()):
            raise ValueError
        return value

    return Kind("NAME", "a name such as llvm_ad_rgb or scalar_rgb", str, check)


def path() -> Kind:
    """The path of a file."""

    def check(value: Any) -> str:
        value = os.fspath(value)
        if not value or "\0" in value:
            raise ValueError
        return str(value)

    return Kind("PATH", "the path of a file", str, check)


def _plain(text: str) -> str:
    """Return text that may be a number; int and float would also take spaces and underscores."""
    if not text.isascii() or "_" in text or text != text.strip():
        raise ValueError
    return text


def _either(names: Sequence[str]) -> str:
    return " or ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def option(default: Any, kind: Kind, text: str, shown: str | None = None) -> Any:
    """Declare a field of ``Options``; ``shown`` is the default as the help names it."""
    return dataclasses.field(default=default, metadata={"kind": kind, "help": text, "shown": shown})


@dataclass(frozen=True)
class Options:
    """What to render, how, and what to write. None: decided by the scene or the machine."""

    filename: str
    scene_number: int = 0
    width: int | None = option(800, integer(1, LARGEST_SIDE), f"image width in pixels, up to {LARGEST_SIDE}")
    height: int | None = option(
        600, integer(1, LARGEST_SIDE), f"image height in pixels, up to {LARGEST_SIDE}"
    )
    aa: int = option(
        4, integer(1, LARGEST_AA), f"anti-aliasing: aa x aa samples per pixel, up to {LARGEST_AA}"
    )
    aamode: str = option(
        "sobel",
        choice("none", "luma", "sobel", "geometry"),
        "refine every pixel, or only edges in brightness (luma, sobel) or in shape (geometry)",
    )
    focaldist: float | None = option(
        None, number(0), "distance in focus, from the camera; 0: no depth of field", "from the scene"
    )
    focalrange: float | None = option(
        None, number(0), "half-width of the sharp zone around it", "from the scene"
    )
    fresnel: str | None = option("schlick", choice("schlick", "dielectric"), "reflectance formula")
    variant: str | None = option(None, word(), "Mitsuba variant", "llvm_ad_rgb, without LLVM scalar_rgb")
    layers: tuple[str, ...] = option(
        (), subset(LAYERS), f"further EXR layers: all, or some of {', '.join(LAYERS)}", "none"
    )
    format: str = option("both", choice("png", "exr", "both"), "files to write")
    tonemap: str = option(
        "report", choice("report", "srgb"), "values in the PNG: linear as in the report, or sRGB"
    )
    motion: tuple[float, float, float] | None = option(
        None, vector("DX,DY,DZ"), "motion blur: how far the camera moves", "none"
    )
    motionsamples: int = option(16, integer(1, 65536), "moments at which motion blur sees the scene")
    motionmode: str = option(
        "frames", choice("frames", "stratified"), "motion blur: a render for each moment, or one for all"
    )
    spp: int = option(1, integer(1, 65536), "rays for each sample, where the integrator is random")
    memory: int | None = option(
        None, size(), "memory to stay within: a number, with K, M, G or T for a unit", "half of what is free"
    )
    seed: int = option(0, integer(0, 2**32 - 1), "seed where anything is random")
    scene: str | None = option(None, path(), "XML or OBJ file to render in place of a numbered scene", "none")
    lattice: str = option(
        "report", choice("report", "centered"), "samples from the pixel centre on, or around it"
    )
    dof: str = option(
        "report", choice("report", "corrected"), "depth of field as in the report, or without its flaws"
    )
    convention: str = option(
        "report", choice("report", "standard"), "MTL files: Ni is the roughness, or the IOR"
    )
    texturing: str | None = option(
        None,
        choice("report", "standard"),
        "textures of an OBJ file: nearest texel, or bilinear from sRGB",
        "as convention",
    )
    camera: tuple[float, float, float] | None = option(
        None, vector(), "OBJ file: where the camera is", "by the model's size"
    )
    target: tuple[float, float, float] | None = option(
        None, vector(), "OBJ file: what the camera looks at", "the model's centre"
    )
    up: tuple[float, float, float] | None = option(None, vector(), "OBJ file: what is up", "0,1,0")
    fov: float | None = option(None, angle(), "OBJ file: horizontal field of view", "60")
    light: tuple[float, float, float] | None = option(
        None, vector(), "OBJ file: where a white light is, in place of the two", "two, by the model's size"
    )
    plan: str = option("hide", choice("show", "hide"), "print what will run and what is left out, and why")
    quiet: bool = option(False, switch(), "print errors only", "0")
    log: str = option(
        "warn",
        choice(*LEVELS),
        "what to tell: warnings; times; every kernel",
    )

    def render_arguments(self) -> dict[str, Any]:
        """Return the options that say how to render, by name, without those about files and messages."""
        others = {
            "filename",
            "scene_number",
            "scene",
            "format",
            "tonemap",
            "plan",
            "quiet",
            "log",
            *FOR_MODELS,
        }
        return {name: getattr(self, name) for name in TABLE if name not in others}

    def shows_model(self) -> bool:
        """Whether the scene is an OBJ file, which has neither camera nor lights."""
        return self.scene is not None and self.scene.lower().endswith(".obj")

    def model_arguments(self) -> dict[str, Any]:
        """Return what was given about the view of an OBJ file, by name."""
        return {name: getattr(self, name) for name in FOR_MODELS if getattr(self, name) is not None}

    def outputs(self) -> tuple[str, ...]:
        """Return the paths of the pictures to write."""
        endings = ("png", "exr") if self.format == "both" else (self.format,)
        return tuple(f"{self.filename}.{ending}" for ending in endings)


TABLE: dict[str, dataclasses.Field[Any]] = {
    field.name: field for field in dataclasses.fields(Options) if "kind" in field.metadata
}


def parse(arguments: Sequence[str]) -> Options:
    """Turn ``FILENAME [SCENE] [name=value ...]`` into options; raise ``UsageError`` naming what is wrong."""
    if not arguments:
        raise UsageError("FILENAME is missing: mrt FILENAME [SCENE] [name=value ...]")
    values: dict[str, Any] = {"filename": _filename(arguments[0])}
    rest = list(arguments[1:])
    if rest and "=" not in rest[0]:
        values["scene_number"] = _scene_number(rest.pop(0))
    for argument in rest:
        name, equals, text = argument.partition("=")
        if not equals:
            raise UsageError(f"unexpected argument {argument!r}: options are written name=value")
        if name not in TABLE:
            raise UsageError(_unknown(name))
        if name in values:
            raise UsageError(f"{name} is given twice")
        values[name] = _value(name, text)
    if "scene" in values and "scene_number" in values:
        raise UsageError(f"both SCENE {values['scene_number']} and scene={values['scene']}: give one of them")
    for name in ("motionsamples", "motionmode"):
        if name in values and "motion" not in values:
            raise UsageError(f"{name} is of use only with motion=dx,dy,dz")
    of_models = [name for name in FOR_MODELS if name in values]
    if of_models and not str(values.get("scene", "")).lower().endswith(".obj"):
        raise UsageError(f"{of_models[0]} is of use only with an OBJ file: scene=PATH.obj")
    if "camera" in values and values["camera"] == values.get("target"):
        raise UsageError("camera and target are the same point: move one of them")
    if values.get("up") == (0, 0, 0):
        raise UsageError("up=0,0,0: up must have a length, such as up=0,1,0")
    if "scene" in values:
        values = dict.fromkeys(DECIDED_BY_FILE) | values
    if "layers=all" in rest and values.get("aamode") == "none":
        values["layers"] = tuple(layer for layer in values["layers"] if layer != "edges")  # nothing detects
    return Options(**values)


def check(name: str, value: Any) -> Any:
    """Return a value from Python as the option ``name`` holds it; raise ``UsageError`` if it is not allowed.

    None passes where it is the default, or where a scene file decides.
    """
    if name not in TABLE:
        raise UsageError(_unknown(name))
    field = TABLE[name]
    if value is None and (field.default is None or name in DECIDED_BY_FILE):
        return None
    try:
        return field.metadata["kind"].check(value)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{name}={value!r}: must be {field.metadata['kind'].allowed}") from None


def _value(name: str, text: str) -> Any:
    kind = TABLE[name].metadata["kind"]
    try:
        return kind.check(kind.from_text(text))
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{name}={text}: {name} must be {kind.allowed}") from None


def _filename(text: str) -> str:
    stem, ending = os.path.splitext(text)
    if "=" in text and text.partition("=")[0] in TABLE:
        raise UsageError(f"FILENAME is missing before {text}: mrt FILENAME [SCENE] [name=value ...]")
    if text.startswith("-"):
        raise UsageError(f"unknown option {text}: options are written name=value; 'mrt help' lists them")
    if ending.lower() in (".png", ".exr"):
        raise UsageError(f"FILENAME has no extension: write {stem} format={ending[1:].lower()}")
    if not os.path.basename(text) or "\0" in text:
        raise UsageError(f"FILENAME {text!r} names no file")
    return text


def _scene_number(text: str) -> int:
    try:
        number = int(_plain(text))
    except ValueError:
        hint = f" For a file of your own, write scene={text}" if "." in text or os.path.exists(text) else ""
        raise UsageError(f"SCENE {text!r}: must be {_scenes()}.{hint}") from None
    if number not in NUMBERS:
        raise UsageError(f"SCENE {number}: must be {_scenes()}")
    return number


def _scenes() -> str:
    return f"{_either([str(number) for number in NUMBERS])} ('mrt scenes' lists them)"


def _unknown(name: str) -> str:
    import difflib

    close = difflib.get_close_matches(name.lstrip("-").lower(), TABLE, n=1)
    hint = f" Did you mean {close[0]}?" if close else " 'mrt help' lists the options."
    return f"unknown option {name!r}.{hint}"
