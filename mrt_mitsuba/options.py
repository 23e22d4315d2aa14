"""Options: kinds of values, how text becomes one, and the check that Python and the command share."""

from __future__ import annotations

import dataclasses
import math
import operator
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.errors import UsageError

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
    """Return the kind of whole numbers in [low, high]."""
    allowed = f"a whole number from {low} to {high}"
    return _numeric("N", allowed, int, operator.index, lambda value: low <= value <= high)


def number(low: float) -> Kind:
    """Return the kind of finite numbers from ``low`` on."""
    allowed = f"a finite number, {low:g} or more"
    return _numeric("X", allowed, float, float, lambda value: low <= value < math.inf)


def angle() -> Kind:
    """Return the kind of degrees between 0 and 180, excluding both."""
    allowed = "degrees, more than 0 and less than 180"
    return _numeric("DEGREES", allowed, float, float, lambda value: 0 < value < 180)


def _numeric(
    form: str,
    allowed: str,
    read: Callable[[str], Any],
    convert: Callable[[Any], Any],
    within: Callable[[Any], bool],
) -> Kind:
    check = _such(lambda value: not isinstance(value, bool | str) and within(value), convert)
    return Kind(form, allowed, lambda text: read(plain(text)), check)


def _such(allowed: Callable[[Any], Any], convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return the check that takes what is ``allowed``, and converts it."""

    def check(value: Any) -> Any:
        if not allowed(value):
            raise ValueError
        return convert(value)

    return check


def choice(*names: str) -> Kind:
    """Return the kind of a choice among names."""
    return Kind("|".join(names), either(names), str, _such(names.__contains__, str))


def switch() -> Kind:
    """Return the kind of yes or no."""
    words = {"1": True, "0": False, "yes": True, "no": False, "true": True, "false": False}
    check = _such((False, True).__contains__, bool)
    return Kind("1|0", "1 or 0", lambda text: words.get(text.lower()), check)


def subset(known: Iterable[str]) -> Kind:
    """Return the kind of comma lists of known names, each once, or ``all``."""
    known = tuple(known)

    def parse(text: str) -> tuple[str, ...]:
        return known if text == "all" else tuple(text.split(","))

    def check(value: Any) -> tuple[str, ...]:
        if isinstance(value, str):
            value = parse(value)
        if len(set(value)) != len(value) or not set(value) <= set(known):
            raise ValueError
        return tuple(value)

    return Kind("A,B,..", f"a comma list out of {', '.join(known)}, each once, or all", parse, check)


def vector(form: str = "X,Y,Z") -> Kind:
    """Return the kind of three finite numbers."""

    def check(value: Any) -> tuple[float, float, float]:
        x, y, z = (float(coordinate) for coordinate in value)
        if not all(map(math.isfinite, (x, y, z))):
            raise ValueError
        return x, y, z

    def parse(text: str) -> list[float]:
        return [float(plain(part)) for part in text.split(",")]

    return Kind(form, "three finite numbers separated by commas", parse, check)


def error_or_place() -> Kind:
    """Return the kind of one positive number, or three finite ones."""
    place = vector()

    def check(value: Any) -> Any:
        if isinstance(value, Iterable):
            return place.check(value)
        if isinstance(value, bool) or not 0 < value < math.inf:
            raise ValueError
        return float(value)

    def parse(text: str) -> Any:
        return place.from_text(text) if "," in text else float(plain(text))

    return Kind("X|X,Y,Z", "a positive number, or three separated by commas", parse, check)


def size() -> Kind:
    """Return the kind of numbers of bytes, in text with a unit: 4G, 512M."""

    def parse(text: str) -> int:
        upper = plain(text).upper().removesuffix("B").removesuffix("I")
        unit = upper[-1:] if upper[-1:] in UNITS else ""
        return int(float(upper.removesuffix(unit)) * UNITS[unit])

    def check(value: Any) -> int:
        value = parse(value) if isinstance(value, str) else operator.index(value)
        if value < SMALLEST_MEMORY:
            raise ValueError
        return value

    return Kind("BYTES", "bytes with an optional unit K, M, G or T, at least 64M, such as 4G", parse, check)


def word() -> Kind:
    """Return the kind of names made of letters, digits and underscores, such as variants."""
    check = _such(lambda value: isinstance(value, str) and value.isidentifier(), str)
    return Kind("NAME", "a name such as llvm_ad_rgb or scalar_rgb", str, check)


def anything() -> Kind:
    """Return the kind of what Python gives, checked where it is used."""
    return Kind("", "anything", str, lambda value: value)


def function() -> Kind:
    """Return the kind of what can be called."""
    return Kind("", "a function", str, _such(callable, lambda value: value))


def rectangle() -> Kind:
    """Return the kind of rectangles: column and row of the first pixel, width and height."""

    def check(value: Any) -> tuple[int, int, int, int]:
        x, y, width, height = (operator.index(number) for number in value)
        if x < 0 or y < 0 or width < 1 or height < 1:
            raise ValueError
        return x, y, width, height

    return Kind("", "four whole numbers: column, row, width and height in pixels", str, check)


def parameters() -> Kind:
    """Return the kind of dicts of values by names of an XML file or keys of ``mi.traverse``."""
    allowed = "a dict of values by names of an XML file or keys of mi.traverse, such as material_0.alpha"
    check = _such(lambda value: all(isinstance(key, str) and key for key in value), lambda value: value)
    return Kind("", allowed, str, lambda value: check(dict(value)))


def path() -> Kind:
    """Return the kind of paths of files."""

    def check(value: Any) -> str:
        value = os.fspath(value)
        if not value or "\0" in value:
            raise ValueError
        return str(value)

    return Kind("PATH", "the path of a file", str, check)


def plain(text: str) -> str:
    """Return text that may be a number; raise ``ValueError`` for spaces and underscores, which int takes."""
    if not text.isascii() or "_" in text or text != text.strip():
        raise ValueError
    return text


def either(names: Sequence[str]) -> str:
    """Return "a, b or c"."""
    return " or ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def option(default: Any, kind: Kind, text: str = "", shown: str | None = None) -> Any:
    """Declare a field of a table of options; ``shown`` is the default as the help names it.

    A field without ``text`` is no option of the command.
    """
    return dataclasses.field(default=default, metadata={"kind": kind, "help": text, "shown": shown})


def checked(field: dataclasses.Field[Any], value: Any) -> Any:
    """Return a value from Python as the field holds it; raise ``UsageError`` if it is not allowed.

    The default passes as it is.
    """
    if value is field.default:
        return value
    return check(field.name, field.metadata["kind"], value)


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
