"""Reading and checking plugin parameters: the one place where their error messages are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn

import drjit as dr
import mitsuba as mi
import numpy as np

from .variants import unbounded_reflectance

# Mitsuba computes in float32, where larger numbers would become infinite, and smaller ones zero
LARGEST = 3.4e38
SMALLEST = 1.2e-38

# From some thousand sides on triangles are slivers, between which rays slip through; more would not help
MOST_SEGMENTS = 65536


class ParameterError(ValueError):
    """A plugin parameter has a wrong value. The text names plugin, key, value and what is allowed."""


class PluginError(RuntimeError):
    """A plugin raised while rays were traced. The text names it and has its own message."""


def _fail(props: mi.Properties, name: str, value: object, allowed: str) -> NoReturn:
    raise ParameterError(f'{props.plugin_name()}: "{name}" is {value!r}, but must be {allowed}')


def _without_tiny(value: float) -> float:
    return 0.0 if abs(value) < SMALLEST else float(value)


def number(
    props: mi.Properties,
    name: str,
    default: float,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> float:
    """Return a finite float parameter, > ``above``, >= ``least`` and <= ``most``."""
    value = props.get(name, default)
    bounds = ((">", above), (">=", least), ("<=", most))
    limits = " and".join(f" {sign} {bound:g}" for sign, bound in bounds if math.isfinite(bound))
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        _fail(props, name, value, f"a number{limits}")
    rounded = _without_tiny(value)
    if not (abs(rounded) <= LARGEST and rounded > above and least <= rounded <= most):
        _fail(props, name, value, f"a finite number{limits}")
    return rounded


def integer(props: mi.Properties, name: str, default: int, *, least: int, most: int) -> int:
    """Return an integer parameter from ``least`` to ``most``."""
    value = props.get(name, default)
    if type(value) is not int or not least <= value <= most:
        _fail(props, name, value, f"an integer from {least} to {most}")
    return value


def segments(props: mi.Properties, default: int) -> int:
    """Return the parameter ``segments``: sides of a mesh."""
    return integer(props, "segments", default, least=3, most=MOST_SEGMENTS)


def flag(props: mi.Properties, name: str, default: bool) -> bool:
    """Return a boolean parameter."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        _fail(props, name, value, "true or false")
    return value


def choice(props: mi.Properties, name: str, allowed: Sequence[str]) -> str:
    """Return one of a few strings; the first is the default."""
    value = props.get(name, allowed[0])
    if not isinstance(value, str) or value not in allowed:
        _fail(props, name, value, "one of " + ", ".join(allowed))
    return value


def vector(
    props: mi.Properties, name: str, default: Sequence[float] | None = None, *, nonzero: bool = False
) -> list[float]:
    """Return three finite numbers, not all 0 if ``nonzero``. Without a default the key is required."""
    if name not in props and default is None:
        raise ParameterError(f'{props.plugin_name()}: "{name}" is missing; give three numbers')
    value = props.get(name, default)
    try:
        numbers = [_without_tiny(x) for x in value]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 3 or not all(abs(x) <= LARGEST for x in numbers):
        _fail(props, name, value, "three finite numbers")
    if nonzero and not any(numbers):
        _fail(props, name, value, "a vector of non-zero length")
    return numbers


def transform(props: mi.Properties, name: str) -> np.ndarray:
    """Return the matrix of a transform, float64 [4, 4]; the identity by default."""
    value = props.get(name, mi.ScalarTransform4f())
    if "Transform" not in type(value).__name__:  # it has several classes, and arrays have any attribute
        _fail(props, name, value, "a transform")
    return np.array(value.matrix, np.float64)


def bitmap(props: mi.Properties, name: str, form: str) -> np.ndarray:
    """Return a bitmap as an array [rows, columns, channels]; ``form`` is the one it must have, in words."""
    if name not in props or type(props[name]).__name__ != "Bitmap":
        raise ParameterError(f'{props.plugin_name()}: "{name}" must be a mi.Bitmap {form}')
    return np.array(props[name])


def spectrum(
    props: mi.Properties, name: str, default: float | None = None, *, emissive: bool = False
) -> mi.Texture:
    """Return a spectrum or texture as a texture; numbers and colours must be finite and not negative.

    ``emissive``: one for lights, with the spectrum of daylight where a variant renders spectra.
    """
    value = props.get(name, default)
    if dr.is_array_v(value):
        value = [float(x) for x in value]
    if isinstance(value, int | float | list):
        levels = value if isinstance(value, list) else [value]
        if isinstance(value, bool) or not all(0 <= x <= LARGEST for x in levels):
            _fail(props, name, value, "finite and not negative")
        if isinstance(value, list) and mi.is_spectral and not emissive and max(levels) > 1:
            return unbounded_reflectance(value)
    read = props.get_emissive_texture if emissive else props.get_unbounded_texture
    try:
        return read(name) if default is None else read(name, default)
    except RuntimeError:
        _fail(props, name, value, "a number, a colour, a spectrum or a texture")


def text(props: mi.Properties, name: str) -> str:
    """Return a string parameter."""
    value = props.get(name, "")
    if not isinstance(value, str) or not value:
        _fail(props, name, value, "a text that is not empty")
    return value
