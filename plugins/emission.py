"""How bright the emitters of a scene are, as far as plain numbers say it."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .protocols import SteadyLight
from .variants import first, is_jit, varies

# Emitters beyond this number are not looked at one by one where one could be on a surface
MOST_EMITTERS = 64


def arriving(emitter: Any, largest: float) -> float:
    """Return the most that arrives from an emitter of this brightness anywhere: its falloff has no limit."""
    steady = isinstance(emitter, SteadyLight) or emitter.class_name() == "DirectionalEmitter"
    return largest if steady or largest == 0 else math.inf


def brightness(emitter: Any) -> float:
    """Return the largest radiance, irradiance or intensity of an emitter; inf where it is not known.

    It is not known of what varies, of spectra in scalar variants, and where derivatives are wanted.
    """
    parameters = mi.traverse(emitter)
    if emitter.class_name() == "EnvironmentMapEmitter":
        data, scale = parameters["data"], parameters["scale"]
        known = not dr.grad_enabled(data, scale)
        return float(np.max(np.array(data)[..., :3]) * np.max(np.array(scale))) if known else math.inf
    values = [largest(node) for node in parameters.hierarchy if isinstance(node, mi.Texture)]
    return max(values, default=math.inf)


def place(emitter: Any) -> tuple[float, ...] | None:
    """Return where an emitter is a point; None for one that is none."""
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
        return None
    parameters = mi.traverse(emitter)
    return tuple(first(x) for x in parameters["position"]) if "position" in parameters else None


def largest(texture: Any) -> float:
    """Return the largest value of a texture; inf where it is not known."""
    if varies(texture) or (mi.is_spectral and not is_jit()):
        return math.inf
    si = dr.zeros(mi.SurfaceInteraction3f)
    if mi.is_spectral:  # each nanometre
        count = int(mi.MI_CIE_MAX - mi.MI_CIE_MIN) + 1
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.wavelengths[0] = dr.linspace(mi.Float, mi.MI_CIE_MIN, mi.MI_CIE_MAX, count)
    value = texture.eval(si)
    if dr.grad_enabled(value):
        return math.inf
    if mi.is_spectral:
        return float(np.max(np.abs(np.array(value))))
    # Channel by channel: reads the numbers where they are, while an array of all would take a kernel
    return max(abs(first(channel)) for channel in value)
