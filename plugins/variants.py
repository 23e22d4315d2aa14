"""Differences between Mitsuba's scalar and vectorised variants, tables of numbers by index or by shape, and
facts that Mitsuba's objects do not state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import is_known


def is_jit() -> bool:
    """Return whether the current variant is a vectorised one (LLVM or CUDA)."""
    return not mi.variant().startswith("scalar")


def pointer(kind: str, objects: list[mi.Emitter] | mi.Emitter) -> mi.EmitterPtr:
    """Return an array of pointers to objects (``kind`` "Shape", ...); in scalar variants, the objects."""
    return getattr(mi, kind + "Ptr")(objects) if is_jit() else objects


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


def but_not(mask: mi.Bool, excluded: mi.Bool) -> mi.Bool:
    """Return ``mask & ~excluded``; on a Python bool, ~ gives a number."""
    return mask & ~excluded if is_jit() else mask and not excluded


def put_where(where: mi.Bool, si: mi.SurfaceInteraction3f, **fields: object) -> None:
    """Overwrite fields of an interaction where a mask holds; the normal ``n`` also for shading."""
    for name, value in fields.items():
        setattr(si, name, dr.select(where, value, getattr(si, name)))
    si.sh_frame.n = dr.select(where, fields["n"], si.sh_frame.n)


def varies(value: object) -> bool:
    """Return whether a value is a texture that may vary over a surface.

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


def aligned(values: np.ndarray, kind: type = np.float32) -> mi.Float:
    """Return numbers as a flat array, of float32 or uint32, at a multiple of 64 bytes.

    Dr.Jit uses arrays of numpy where they lie, and most lie elsewhere. Only from aligned ones does a kernel
    read several numbers in a row in one go, which makes one that searches a tree half as fast again; and both
    kernels would be compiled and kept.
    """
    size = np.size(values)
    room: np.ndarray = np.empty(size + 16, kind)
    start = -room.ctypes.data % 64 // 4
    place = room[start : start + size]
    place[:] = np.ravel(values)
    return mi.Float(place) if kind is np.float32 else mi.UInt32(place)


def shape_ids(shapes: Sequence[mi.Shape]) -> mi.UInt32 | Sequence[mi.Shape]:
    """Return Dr.Jit's numbers of shapes for ``shape_at``; in scalar variants, the shapes.

    If a recorded kernel reads pointers instead, Dr.Jit looks at all objects of all scenes at each launch.
    """
    if not is_jit():
        return shapes
    ids = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shapes))
    dr.eval(ids)
    return ids


def shape_at(ids: mi.UInt32 | Sequence[mi.Shape], index: mi.UInt32, active: mi.Bool) -> mi.ShapePtr:
    """Return one of the shapes that were given to ``shape_ids``, by index."""
    if not is_jit():
        return ids[index]
    return dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, ids, index, active))


class Table:
    """Numbers of a type of Mitsuba's, [n], [n, width] or [n, parts, width], looked up by index and part."""

    def __init__(self, kind: type, numbers: Sequence | np.ndarray) -> None:
        rows = np.array(numbers)
        self.kind = kind
        self.parts = rows.shape[1] if rows.ndim == 3 else 1
        self.rows: Any
        if is_jit():
            self.rows = aligned(rows, np.uint32 if kind is mi.UInt32 else np.float32)
        else:
            width = rows.shape[-1] if rows.ndim > 1 else 1
            self.rows = [kind(*row) for row in rows.reshape(-1, width).tolist()]

    def __call__(self, index: mi.UInt32, active: mi.Bool, part: int = 0) -> Any:
        place = index * self.parts + part
        if not is_jit():
            return self.rows[place if active else 0]
        return dr.gather(self.kind, self.rows, place, active)


class ByShape:
    """Numbers for each of some shapes, looked up for the one that was hit; ``fallback`` for others.

    In vectorised variants, they may have parts, as in a ``Table``.
    """

    def __init__(
        self, kind: type, shapes: Sequence[mi.Shape], rows: Sequence, fallback: float | list[float]
    ) -> None:
        self.fallback = kind(fallback)
        if not is_jit():
            self.shapes = shapes  # alive, or their ids could pass to others
            self.rows = {id(s): kind(row) for s, row in zip(shapes, rows, strict=True)}
            return
        ids = np.array(shape_ids(shapes))
        numbers = np.empty((ids.max() + 1, *np.shape(rows)[1:]), np.float32)
        numbers[:] = fallback
        numbers[ids] = rows
        self.table = Table(kind, numbers)
        self.size = dr.opaque(mi.UInt32, len(numbers))
        dr.make_opaque(self.fallback)

    def __call__(self, si: mi.SurfaceInteraction3f, active: mi.Bool, part: int = 0) -> Any:
        if not is_jit():
            return self.rows.get(id(si.shape), self.fallback) if active else self.fallback
        ids = dr.reinterpret_array(mi.UInt32, si.shape)
        known = active & (ids < self.size)
        return dr.select(known, self.table(ids, known, part), self.fallback)
