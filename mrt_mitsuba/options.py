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

    ``from_text`` turns text into a value, ``check`` returns an allowed value; both raise ValueError or
    TypeError. A kind without a form is for Python only.
    """

    form: str
    allowed: str
    from_text: Callable[[str], Any]
    check: Callable[[Any], Any]


def require(holds: bool, value: Any) -> Any:
    """Return a value for which something holds; raise ``ValueError`` where it does not."""
    if not holds:
        raise ValueError
    return value


def integer(low: int, high: int) -> Kind:
    """Return the kind of whole numbers in [low, high]."""

    def check(value: Any) -> int:
        number = operator.index(require(not isinstance(value, bool), value))
        return int(require(low <= number <= high, number))

    return Kind("N", f"a whole number from {low} to {high}", lambda text: int(plain(text)), check)


def real(form: str, allowed: str, fits: Callable[[float], bool]) -> Kind:
    """Return the kind of numbers that fit."""

    def check(value: Any) -> float:
        return float(require(not isinstance(value, bool | str) and fits(value), value))

    return Kind(form, allowed, lambda text: float(plain(text)), check)


def choice(*names: str) -> Kind:
    """Return the kind of a choice among names."""
    return Kind("|".join(names), either(names), str, lambda value: str(require(value in names, value)))


def subset(known: Iterable[str]) -> Kind:
    """Return the kind of comma lists of known names, each once, or ``all``."""
    known = tuple(known)

    def parse(text: str) -> tuple[str, ...]:
        return known if text == "all" else tuple(text.split(","))

    def check(value: Any) -> tuple[str, ...]:
        names = parse(value) if isinstance(value, str) else tuple(value)
        require(len(set(names)) == len(names) and set(names) <= set(known), names)
        return names

    return Kind("A,B,..", f"a comma list out of {', '.join(known)}, each once, or all", parse, check)


def switch(form: str = "1|0") -> Kind:
    """Return the kind of yes or no."""
    words = {"1": True, "0": False, "yes": True, "no": False, "true": True, "false": False}

    def check(value: Any) -> bool:
        return bool(require(value in (False, True), value))

    return Kind(form, "1 or 0", lambda text: words.get(text.lower()), check)


def path() -> Kind:
    """Return the kind of paths of files."""

    def check(value: Any) -> str:
        value = os.fspath(value)
        return str(require(bool(value) and "\0" not in value, value))

    return Kind("PATH", "the path of a file", str, check)


def _vector(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(coordinate) for coordinate in value)
    require(math.isfinite(x + y + z), value)
    return x, y, z


def _target(value: Any) -> Any:
    if isinstance(value, Iterable):
        return _vector(value)
    return float(require(not isinstance(value, bool) and 0 < value < math.inf, value))


def _bytes(value: Any) -> int:
    if isinstance(value, str):
        upper = plain(value).upper().removesuffix("B").removesuffix("I")
        unit = upper[-1:] if upper[-1:] in UNITS else ""
        value = int(float(upper.removesuffix(unit)) * UNITS[unit])
    return operator.index(require(operator.index(value) >= SMALLEST_MEMORY, value))


def _rectangle(value: Any) -> tuple[int, int, int, int]:
    x, y, width, height = (operator.index(number) for number in value)
    require(x >= 0 and y >= 0 and width >= 1 and height >= 1, value)
    return x, y, width, height


def _numbers(text: str) -> Any:
    parts = [float(plain(part)) for part in text.split(",")]
    return parts if len(parts) > 1 else parts[0]


def _parameters(value: Any) -> Mapping[str, Any]:
    value = dict(value)
    require(all(isinstance(key, str) and key for key in value), value)
    return value


NUMBER = real("X", "a finite number, 0 or more", lambda value: 0 <= value < math.inf)
ANGLE = real("DEGREES", "degrees, more than 0 and less than 180", lambda value: 0 < value < 180)
VECTOR = Kind("X,Y,Z", "three finite numbers separated by commas", _numbers, _vector)
TARGET = Kind("X|X,Y,Z", "a positive number, or three separated by commas", _numbers, _target)
BYTES = Kind("BYTES", "bytes with an optional unit K, M, G or T, at least 64M, such as 4G", str, _bytes)
NAME = Kind(
    "NAME",
    "a name such as llvm_ad_rgb or scalar_rgb",
    str,
    lambda value: require(isinstance(value, str) and value.isidentifier(), value),
)
ANYTHING = Kind("", "anything", str, lambda value: value)  # checked where it is used
FUNCTION = Kind("", "a function", str, lambda value: require(callable(value), value))
RECTANGLE = Kind("", "four whole numbers: column, row, width and height in pixels", str, _rectangle)
PARAMETERS = Kind(
    "",
    "a dict of values by names of an XML file or keys of mi.traverse, such as material_0.alpha",
    str,
    _parameters,
)


def plain(text: str) -> str:
    """Return text that may be a number; raise ``ValueError`` for spaces and underscores, which int takes."""
    return str(require(text.isascii() and "_" not in text and text == text.strip(), text))


def either(names: Sequence[str]) -> str:
    """Return "a, b or c"."""
    return " or ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def option(default: Any, kind: Kind, text: str = "", shown: str | None = None) -> Any:
    """Declare a field of a table of options; ``shown`` is the default as the help names it."""
    return dataclasses.field(default=default, metadata={"kind": kind, "help": text, "shown": shown})


def table(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    """Return the fields that are options of the command, by name."""
    return {f.name: f for f in dataclasses.fields(kind) if f.metadata and f.metadata["kind"].form}


def checked(field: dataclasses.Field[Any], value: Any) -> Any:
    """Return a value from Python as the field holds it; raise ``UsageError`` if it is not allowed.

    The default passes as it is.
    """
    return value if value is field.default else check(field.name, field.metadata["kind"], value)


def check(name: str, kind: Kind, value: Any) -> Any:
    """Return a value from Python as its kind holds it; raise ``UsageError`` if it is not allowed."""
    try:
        return kind.check(value)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{name}={value!r}: must be {kind.allowed}") from None


def from_text(field: dataclasses.Field[Any], text: str) -> Any:
    """Return the value of a word of the command line; raise ``UsageError`` if it is not allowed."""
    kind = field.metadata["kind"]
    try:
        return kind.check(kind.from_text(text))
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{field.name}={text}: {field.name} must be {kind.allowed}") from None
