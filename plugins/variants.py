"""Differences between Mitsuba's scalar and vectorised variants, and what its objects do not reveal."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def is_jit() -> bool:
    """Return whether the current variant is a vectorised one (LLVM or CUDA)."""
    return not mi.variant().startswith("scalar")


def pointer(kind: str, objects: Any) -> Any:
    """Return an array of pointers to objects (``kind`` "Shape", ...); in scalar variants, the objects."""
    return getattr(mi, kind + "Ptr")(objects) if is_jit() else objects


def first(value: Any) -> float:
    """Return the first entry of a Dr.Jit array, or the number itself, as a Python float."""
    return float(value) if isinstance(value, float) else float(value[0])


def updatable(number: float) -> mi.Float:
    """Return a parameter in a form that ``mi.traverse`` can update, which Python floats are not."""
    return mi.Float(number) if is_jit() else dr.scalar.Array1f64(number)


def but_not(mask: mi.Bool, excluded: mi.Bool) -> mi.Bool:
    """Return ``mask & ~excluded``; on a Python bool, ~ gives a number."""
    return mask & ~excluded if is_jit() else mask and not excluded


def varies(texture: mi.Texture) -> bool:
    """Return whether a texture varies over a surface; Mitsuba's ``mesh_attribute`` denies that it does."""
    return texture.is_spatially_varying() or texture.class_name() == "MeshAttribute"


def largest(texture: mi.Texture) -> float:
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


def construct_quietly(integrator: mi.SamplingIntegrator, props: mi.Properties) -> None:
    """Construct the base class without Mitsuba's warning about scalar variants; ``mrt.render`` gives one."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        mi.SamplingIntegrator.__init__(integrator, props)
    finally:
        mi.set_log_level(level)
