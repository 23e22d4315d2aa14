"""Options: kinds of values, how text becomes one, and the check that Python and the command share."""

from __future__ import annotations

import dataclasses
import math
import operator
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from mrt_mitsuba.errors import UsageError

UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}
SMALLEST_MEMORY = 64 * 2**20  # bytes; about what one tile with all layers takes


class Kind(NamedTuple):
    """A kind of value. ``form`` is the help's "name=form", ``allowed`` completes "must be ...".

    ``from_text`` turns the command's text into a value, ``convert`` any value into the one that is held, and
    ``fits`` says whether it is allowed; all may raise ValueError, TypeError or OverflowError. A kind without
    a form is for Python only.
    """

    form: str
    allowed: str
    fits: Callable[[Any], Any]
    convert: Callable[[Any], Any] = lambda value: value
    from_text: Callable[[str], Any] = str


def integer(low: int, high: int) -> Kind:
    """Return the kind of whole numbers in [low, high]."""
    allowed = f"a whole number from {low} to {high}"
    return Kind("N", allowed, lambda value: low <= value <= high, _whole, lambda text: int(plain(text)))


def choice(*names: str) -> Kind:
    """Return the kind of a choice among names."""
    return Kind("|".join(names), either(names), names.__contains__, str)


def subset(known: Iterable[str]) -> Kind:
    """Return the kind of comma lists of known names, each once, or ``all``."""
    known = tuple(known)

    def convert(value: Any) -> tuple[str, ...]:
        if isinstance(value, str):
            return known if value == "all" else tuple(value.split(","))
        return tuple(value)

    return Kind(
        "A,B,..",
        f"a comma list out of {', '.join(known)}, each once, or all",
        lambda names: len(set(names)) == len(names) and set(names) <= set(known),
        convert,
    )


def _whole(value: Any) -> int:
    if isinstance(value, bool):
        raise TypeError
    return operator.index(value)


def _real(value: Any) -> float:
    if isinstance(value, bool | str):
        raise TypeError
    return float(value)


def _numbers(value: Any) -> Any:
    return tuple(map(_real, value)) if isinstance(value, Iterable) else _real(value)


def _numbers_in(text: str) -> Any:
    parts = [float(plain(part)) for part in text.split(",")]
    return parts if len(parts) > 1 else parts[0]


def _point(value: Any) -> bool:
    return len(value) == 3 and all(map(math.isfinite, value))


def _bytes(value: Any) -> int:
    if isinstance(value, str):
        upper = plain(value).upper().removesuffix("B").removesuffix("I")
        unit = upper[-1:] if upper[-1:] in UNITS else ""
        value = int(float(upper.removesuffix(unit)) * UNITS[unit])
    return operator.index(value)


NUMBER = Kind("X", "a finite number, 0 or more", lambda x: 0 <= x < math.inf, _real, _numbers_in)
ANGLE = Kind("DEGREES", "degrees, more than 0 and less than 180", lambda x: 0 < x < 180, _real, _numbers_in)
VECTOR = Kind("X,Y,Z", "three finite numbers separated by commas", _point, _numbers, _numbers_in)
TARGET = Kind(
    "X|X,Y,Z",
    "a positive number, or three separated by commas",
    lambda value: 0 < value < math.inf if isinstance(value, float) else _point(value),
    _numbers,
    _numbers_in,
)
BYTES = Kind(
    "BYTES",
    "bytes with an optional unit K, M, G or T, at least 64M, such as 4G",
    lambda count: count >= SMALLEST_MEMORY,
    _bytes,
)
WORDS = {"1": True, "0": False, "yes": True, "no": False, "true": True, "false": False}
SWITCH = Kind("1|0", "1 or 0", (False, True).__contains__, from_text=lambda text: WORDS.get(text.lower()))
NAME = Kind("NAME", "a name such as llvm_ad_rgb or scalar_rgb", str.isidentifier)
ANYTHING = Kind("", "anything", lambda value: True)  # checked where it is used
FUNCTION = Kind("", "a function", callable)
RECTANGLE = Kind(
    "",
    "four whole numbers: column, row, width and height in pixels",
    lambda value: len(value) == 4 and min(value) >= 0 and min(value[2:]) >= 1,
    lambda value: tuple(map(_whole, value)),
)
PARAMETERS = Kind(
    "",
    "a dict of values by names of an XML file or keys of mi.traverse, such as material_0.alpha",
    lambda value: all(isinstance(key, str) and key for key in value),
    dict,
)


def plain(text: str) -> str:
    """Return text that may be a number; raise ``ValueError`` for spaces and underscores, which int takes."""
    if not text.isascii() or "_" in text or text != text.strip():
        raise ValueError
    return text


def either(names: Sequence[str]) -> str:
    """Return "a, b or c"."""
    return " or ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def option(default: Any, kind: Kind, text: str = "", shown: str | None = None) -> Any:
    """Declare a field of a table of options; ``shown`` is the default as the help names it."""
    return dataclasses.field(default=default, metadata={"kind": kind, "help": text, "shown": shown})


def table(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    """Return the fields that are options of the command, by name."""
    return {f.name: f for f in dataclasses.fields(kind) if f.metadata and f.metadata["kind"].form}


def check(name: str, kind: Kind, value: Any, *, text: bool = False) -> Any:
    """Return a value from Python, or from the command's text, as its kind holds it.

    Raises ``UsageError`` if it is not allowed.
    """
    try:
        held = kind.convert(kind.from_text(value) if text else value)
        if kind.fits(held):
            return held
    except (TypeError, ValueError, OverflowError):
        pass
    raise UsageError(f"{name}={value if text else repr(value)}: must be {kind.allowed}")


def is_obj(scene: object, model: Mapping[str, Any]) -> bool:
    """Return whether a scene is given as the path of an OBJ file.

    Raises ``UsageError`` where it is not, for options of ``model_scene``.
    """
    obj = isinstance(scene, str | os.PathLike) and os.fspath(scene).lower().endswith(".obj")
    useless = [name for name, value in model.items() if (name, value) != ("convention", "report")]
    if useless and not obj:
        raise UsageError(f"{useless[0]} is of use only with an OBJ file: scene=PATH.obj")
    return obj
