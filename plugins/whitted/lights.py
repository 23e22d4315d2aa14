"""The lights of a scene: positions and intensities, in place of calls where all are ``mrt_light``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import classes_of, is_known
from ..variants import is_jit, largest, pointer
from .tables import Table


def towards(position: mi.Point3f, it: mi.Interaction3f) -> mi.DirectionSample3f:
    """Return the direction from ``it`` to a point, with a density of 1."""
    ds = mi.DirectionSample3f()
    ds.p = position
    ds.d = ds.p - it.p
    ds.dist = dr.norm(ds.d)
    # A point on the light itself has no direction to it; any will do, and scalar variants raise on 0/0
    away = ds.dist > 0
    inverse = 1 / dr.select(away, ds.dist, 1)
    ds.d = dr.select(away, ds.d * inverse, mi.Vector3f(0, 0, 1))
    ds.n = mi.Normal3f(-ds.d)
    ds.uv = mi.Point2f(0)
    ds.time = it.time
    ds.pdf = mi.Float(1)
    ds.delta = mi.Bool(True)
    return ds


def light_rows(lights: list[mi.Emitter]) -> list[list[list[float]]] | None:
    """Return the ``fixed_row`` of each light, vectors of three; None where one has no place in a table."""
    kinds = classes_of("lights")  # one of a class that derives from it may be anything
    if not is_jit() or mi.is_spectral or not all(type(light) in kinds for light in lights):
        return None
    rows = [light.fixed_row() for light in lights]
    return None if None in rows else rows


class Lights:
    """The lights of a scene as its kernels have them; ``form`` is that of the plan."""

    def __init__(self, lights: list[mi.Emitter], rows: list[list[list[float]]] | None, form: str) -> None:
        self.unrolled = len(lights) if form == "unrolled" else 0  #: those with code of their own
        self.count = dr.opaque(mi.UInt32, len(lights)) if form in ("loop", "table") else None
        self.called: Any = lights if rows is None else None
        if form == "loop":
            self.called = pointer(lights)
        elif form == "table" and rows is not None:
            self.table = Table(mi.Vector3f, rows)
        elif rows is not None:
            self.rows = [[dr.opaque(mi.Vector3f, part) for part in row] for row in rows]

    def sample(
        self, light: int | mi.UInt32, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.UnpolarizedSpectrum]:
        """Return the direction from ``it`` to light number ``light``, and the light that arrives."""
        if self.called is not None:
            called = self.called
            one = called[light] if self.unrolled else dr.gather(mi.EmitterPtr, called, light, active)
            return one.sample_direction(it, sample, active)
        if self.unrolled:
            position, color = self.rows[light]
        else:
            position, color = (self.table(light, active, part) for part in range(2))
        intensity = mi.UnpolarizedSpectrum(list(color)[: dr.size_v(mi.UnpolarizedSpectrum)])
        return towards(mi.Point3f(position), it), intensity


def brightness(emitter: mi.Emitter) -> float:
    """Return the largest radiance, irradiance or intensity of an emitter; inf where it is not known.

    Not known are textures that vary, spectra in scalar variants, classes that somebody else wrote in Python,
    and values whose derivatives are wanted.
    """
    if not is_known(emitter):
        return np.inf
    parameters = mi.traverse(emitter)
    if emitter.class_name() == "EnvironmentMapEmitter":
        data = parameters["data"]
        scale = parameters["scale"]
        if dr.grad_enabled(data, scale):
            return np.inf
        return float(np.array(data)[..., :3].max() * np.array(scale).max())
    values = [largest(node) for node in parameters.hierarchy if isinstance(node, mi.Texture)]
    return max(values, default=np.inf)
