"""Options: kinds of values, how text becomes one, and the check that Python and the command share."""

from __future__ import annotations

import dataclasses
import math
import operator
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

from mrt_mitsuba.adaptive.target import Target, plain
from mrt_mitsuba.errors import UsageError

Value = TypeVar("Value")
Values = Mapping[str, Any]  # by the names of options or parameters
StrPath = str | os.PathLike[str]

UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}
SMALLEST_MEMORY = 64 * 2**20  # bytes


class Kind(NamedTuple):
    """A kind of value. ``form`` is the help's "name=form", ``allowed`` completes "must be ...".

    ``from_text`` turns the command's text into a value, and ``convert`` any value into the one that an option
    holds; both raise ValueError, TypeError or OverflowError for what is not allowed. A kind without a form is
    for Python only.
    """

    form: str
    allowed: str
    convert: Callable[[Any], Any]
    from_text: Callable[[str], Any] = str


def integer(low: int, high: int) -> Kind:
    """Return the kind of whole numbers in [low, high]."""

    def convert(value: Any) -> int:
        if isinstance(value, bool):
            raise TypeError
        return _only(operator.index(value), low <= value <= high)

    return Kind("N", f"a whole number from {low} to {high}", convert, lambda text: int(plain(text)))


def choice(*names: str) -> Kind:
    """Return the kind of a choice among names."""

    def convert(value: Any) -> str:
        return _only(str(value), value in names)

    return Kind("|".join(names), either(names), convert)


def subset(known: Iterable[str]) -> Kind:
    """Return the kind of comma lists of known names, each once, or ``all``."""
    known = tuple(known)

    def convert(value: Any) -> tuple[str, ...]:
        if value == "all":
            return known
        names = tuple(value.split(",") if isinstance(value, str) else value)
        return _only(names, len(set(names)) == len(names) and set(names) <= set(known))

    return Kind("A,B,..", f"a comma list out of {', '.join(known)}, each once, or all", convert)


def _only(value: Value, allowed: bool) -> Value:
    """Return the value if it is allowed; else raise ``ValueError``."""
    if not allowed:
        raise ValueError
    return value


def _real(value: Any, low: float = -sys.float_info.max, end: float = math.inf) -> float:
    """Return a number in [low, end), by default a finite one."""
    if isinstance(value, bool | str):
        raise TypeError
    return _only(float(value), low <= value < end)


def _real_in(text: str) -> float:
    return float(plain(text))


def _reals_in(text: str) -> tuple[float, ...]:
    return tuple(_real_in(part) for part in text.split(","))


def _point(value: Any) -> tuple[float, ...]:
    point = tuple(_real(part) for part in value)
    return _only(point, len(point) == 3)


def _target(value: Any) -> Target | tuple[float, ...]:
    """Return an error target, or the point of an OBJ file that the camera looks at."""
    if isinstance(value, Iterable) and not isinstance(value, str):
        return _point(value)
    return Target.of(value)


def _target_in(text: str) -> str | tuple[float, ...]:
    return _reals_in(text) if "," in text else text


def _bytes(value: Any) -> int:
    if isinstance(value, str):
        upper = plain(value).upper().removesuffix("B").removesuffix("I")
        unit = upper[-1:] if upper[-1:] in UNITS else ""
        value = int(float(upper.removesuffix(unit)) * UNITS[unit])
    count = operator.index(value)
    return _only(count, count >= SMALLEST_MEMORY)


def _switch(value: Any) -> bool:
    return _only(value, value in (False, True))


def _name(value: Any) -> str:
    return _only(value, str.isidentifier(value))


def _parameters(value: Any) -> dict[str, Any]:
    return _only(dict(value), all(isinstance(key, str) and key for key in value))


def instance(kind: type, allowed: str) -> Kind:
    """Return the kind of objects of a class, for Python only."""
    return Kind("", allowed, lambda value: _only(value, isinstance(value, kind)))


WORDS = {"1": True, "0": False, "yes": True, "no": False, "true": True, "false": False}
NUMBER = Kind("X", "a finite number, 0 or more", partial(_real, low=0), _real_in)
ANGLE = Kind(
    "DEGREES",
    "degrees, more than 0 and less than 180",
    partial(_real, low=sys.float_info.min, end=180),
    _real_in,
)
VECTOR = Kind("X,Y,Z", "three finite numbers separated by commas", _point, _reals_in)
TARGET = Kind(
    "X|P%|X,Y,Z",
    "a positive number, or three separated by commas, or a percentage above 0 such as 2%",
    _target,
    _target_in,
)
BYTES = Kind("BYTES", "bytes with an optional unit K, M, G or T, at least 64M, such as 4G", _bytes)
SWITCH = Kind("1|0", "1 or 0", _switch, lambda text: WORDS[text.lower()])
NAME = Kind("NAME", "a name such as llvm_ad_rgb or scalar_rgb", _name)
ANYTHING = instance(object, "anything")  # checked where it is used
FUNCTION = Kind("", "a function", lambda value: _only(value, callable(value)))
PARAMETERS = Kind(
    "",
    "a dict of values by names of an XML file or keys of mi.traverse, such as material_0.alpha",
    _parameters,
)


def either(names: Sequence[str]) -> str:
    """Return the text "a, b or c"."""
    return " or ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def option(default: Any, kind: Kind, text: str = "", shown: str | None = None) -> Any:
    """Declare a field of a table of options.

    ``shown`` is the default as the help names it.
    """
    metadata = {"kind": kind, "help": text, "shown": shown}
    return dataclasses.field(default=default, metadata=metadata)


def table(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    """Return the fields that are options of the command, by name."""
    return {f.name: f for f in dataclasses.fields(kind) if f.metadata and f.metadata["kind"].form}


def check(name: str, kind: Kind, value: Any, *, text: bool = False) -> Any:
    """Turn a value from Python, or the command's text, into the one that an option of this kind holds.

    Raises ``UsageError`` if it is not allowed.
    """
    try:
        return kind.convert(kind.from_text(value) if text else value)
    except (TypeError, ValueError, OverflowError, LookupError):
        shown = value if text else repr(value)
        raise UsageError(f"{name}={shown}: must be {kind.allowed}") from None


def is_path(scene: object, ending: str | tuple[str, ...]) -> bool:
    """True if a scene is given as a path with this ending, or one of them."""
    return isinstance(scene, str | os.PathLike) and os.fspath(scene).lower().endswith(ending)


def is_obj(scene: object, model: Values) -> bool:
    """True if a scene is given as the path of an OBJ file.

    Raises ``UsageError`` for options of a model if it is not.
    """
    obj = is_path(scene, ".obj")
    useless = [name for name, value in model.items() if (name, value) != ("convention", "report")]
    if useless and not obj:
        raise UsageError(f"{useless[0]} is of use only with an OBJ file: scene=PATH.obj")
    return obj
