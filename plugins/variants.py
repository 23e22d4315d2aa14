"""Differences between Mitsuba's scalar and vectorised variants, and facts that its objects do not state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from . import is_known


def is_jit() -> bool:
    """True if the current variant is a vectorised one (LLVM or CUDA)."""
    return not mi.variant().startswith("scalar")


def pointer(emitters: list[mi.Emitter] | mi.Emitter) -> mi.EmitterPtr:
    """Return an array of pointers to emitters; in scalar variants, the emitters."""
    return mi.EmitterPtr(emitters) if is_jit() else emitters


def first(value: mi.Float) -> float:
    """Return the first entry of a Dr.Jit array, or the number itself, as a Python float."""
    return float(value) if isinstance(value, float) else float(value[0])


def updatable(number: float) -> mi.Float:
    """Return a parameter in a form that ``mi.traverse`` can update, which Python floats are not."""
    return mi.Float(number) if is_jit() else dr.scalar.Array1f64(number)


def plain(number: mi.Float) -> mi.Float:
    """Return an ``updatable`` parameter as a number to compute with: in vectorised variants the array itself,
    as a single entry would have no derivative.
    """
    return number if is_jit() else first(number)


def and_not(mask: mi.Bool, excluded: mi.Bool) -> mi.Bool:
    """Return ``mask & ~excluded``; on a Python bool, ~ gives a number."""
    return mask & ~excluded if is_jit() else mask and not excluded


def put_where(where: mi.Bool, si: mi.SurfaceInteraction3f, **fields: object) -> None:
    """Overwrite fields of an interaction where a mask holds; the normal ``n`` also for shading."""
    for name, value in fields.items():
        setattr(si, name, dr.select(where, value, getattr(si, name)))
    si.sh_frame.n = dr.select(where, fields["n"], si.sh_frame.n)


def varies(value: object) -> bool:
    """True if a value is a texture that may vary over a surface.

    ``mesh_attribute`` denies it, and a class that somebody else wrote in Python need not say so.
    """
    if not isinstance(value, mi.Texture):
        return False
    denies = value.class_name() == "MeshAttribute" or not is_known(value)
    return bool(denies or value.is_spatially_varying())


def _spectrum(texture: mi.Texture) -> mi.Float | list[float]:
    """Return the values of a spectrum at each nanometre from ``MI_CIE_MIN`` on."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    wavelengths = range(int(mi.MI_CIE_MIN), int(mi.MI_CIE_MAX) + 1)
    if is_jit():
        si.wavelengths[0] = dr.linspace(mi.Float, wavelengths[0], wavelengths[-1], len(wavelengths))
        return texture.eval(si)[0]
    values = []
    for wavelength in wavelengths:
        si.wavelengths = mi.UnpolarizedSpectrum(wavelength)
        values.append(texture.eval(si)[0])
    return values


def unbounded_reflectance(color: Sequence[float]) -> mi.Texture:
    """Return a reflectance spectrum of a colour that exceeds 1, in a spectral variant.

    Mitsuba's own spectra of colours end at 1. As those of its lights, this one is the spectrum of a colour of
    at most a half, times a factor; it is sampled at each nanometre.
    """
    factor = 2 * max(color)
    half = mi.load_dict({"type": "srgb", "color": mi.ScalarColor3f([c / factor for c in color])})
    samples = (factor * np.array(_spectrum(half))).tolist()
    return mi.load_dict({"type": "spectrum", "value": list(enumerate(samples, start=int(mi.MI_CIE_MIN)))})


def largest(texture: mi.Texture) -> float:
    """Return the largest value of a texture; inf where it is not known."""
    if varies(texture):
        return math.inf
    value = _spectrum(texture) if mi.is_spectral else texture.eval(dr.zeros(mi.SurfaceInteraction3f))
    if dr.grad_enabled(value):
        return math.inf
    if mi.is_spectral:
        return float(np.max(np.abs(np.array(value))))
    # Channel by channel: reads the numbers where they are, while an array of all would take a kernel
    return max(abs(first(channel)) for channel in value)


def text_of(thing: object) -> str:
    """Return an object's own description, or the name of its class where one in Python has none."""
    try:
        return str(thing)
    except RuntimeError:  # its to_string, or that of something inside it, is missing
        return type(thing).__name__


def construct_quietly(integrator: mi.SamplingIntegrator, props: mi.Properties) -> None:
    """Construct the base class without Mitsuba's warning about scalar variants; ``mrt.render`` gives one."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        mi.SamplingIntegrator.__init__(integrator, props)
    finally:
        mi.set_log_level(level)
