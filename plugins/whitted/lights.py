"""The lights of a scene, as rows of a table in place of calls to plugins where they are known.

A light of the table is an ``mrt_light``, or one of a class that derives from ``plugin("light").MrtLight``,
appends to its ``row`` and overrides ``arriving``.
"""

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
    kinds = classes_of("lights")
    if not is_jit() or mi.is_spectral or not all(isinstance(light, kinds) for light in lights):
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
            self.called = pointer("Emitter", lights)
        elif form != "none" and rows is not None:
            self.kind_of = [type(light) for light in lights]
            #: the kinds that the kernel holds, and how many vectors a row of each has
            self.kinds = dict(zip(self.kind_of, map(len, rows), strict=True))
            if form == "table":
                kinds = list(self.kinds)
                parts = np.zeros((1 + max(self.kinds.values()), len(lights), 3))
                for k, row in enumerate(rows):
                    parts[0, k] = kinds.index(self.kind_of[k])
                    parts[1 : 1 + len(row), k] = row
                self.parts = [Table(mi.Vector3f, part) for part in parts]
            else:
                self.rows = [[dr.opaque(mi.Vector3f, part) for part in row] for row in rows]

    def sample(
        self, light: Any, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.UnpolarizedSpectrum]:
        """Return the direction from ``it`` to light number ``light``, and the light that arrives."""
        number: Any = None  # of the kind, where there are several
        if self.called is not None:
            called = self.called
            one = called[light] if self.unrolled else dr.gather(mi.EmitterPtr, called, light, active)
            return one.sample_direction(it, sample, active)
        if self.unrolled:
            kinds = [self.kind_of[light]]
            row = self.rows[light]
        else:
            kinds = list(self.kinds)
            row = [part(light, active) for part in self.parts[1:]]
            number = self.parts[0](light, active).x if len(kinds) > 1 else None
        position, color, *more = row
        ds = towards(mi.Point3f(position), it)
        intensity = mi.UnpolarizedSpectrum(list(color)[: dr.size_v(mi.UnpolarizedSpectrum)])
        arriving, *others = (kind.arriving(ds.d, intensity, *more[: self.kinds[kind] - 2]) for kind in kinds)
        for k, other in enumerate(others, start=1):
            arriving = dr.select(number == k, other, arriving)
        return ds, arriving


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
