"""Point lights as numbers, in place of calls to plugins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .lookup import Table
from .protocols import TabledLight
from .variants import is_jit, pointer

Numbers = tuple[list[float], list[float]]  # position and intensity


@dataclass
class PointLight:
    """A point light without falloff, as kernel data."""

    position: mi.Point3f
    intensity: mi.UnpolarizedSpectrum

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.UnpolarizedSpectrum]:
        """Return the direction to the light and what arrives from it, as an emitter does."""
        return direction_to(self.position, it), self.intensity


def direction_to(position: mi.Point3f, it: mi.Interaction3f) -> mi.DirectionSample3f:
    """Return the direction to a point, with a density of 1."""
    ds = mi.DirectionSample3f()
    ds.p = position
    ds.d = ds.p - it.p
    ds.dist = dr.norm(ds.d)
    # A point on the light itself has no direction to it; any will do, and scalar variants raise on 0/0
    away = ds.dist > 0
    ds.d = dr.select(away, ds.d * (1 / dr.select(away, ds.dist, 1)), mi.Vector3f(0, 0, 1))
    ds.n = mi.Normal3f(-ds.d)
    ds.uv = mi.Point2f(0)
    ds.time = it.time
    ds.pdf = mi.Float(1)
    ds.delta = mi.Bool(True)
    return ds


def numbers_of(lights: list[Any]) -> list[Numbers] | None:
    """Return lights as numbers; None where not all of them are."""
    if not is_jit() or mi.is_spectral or not all(isinstance(light, TabledLight) for light in lights):
        return None
    found = [light.numbers() for light in lights]
    return None if None in found else found


class Lights:
    """The lights of a scene as its kernels have them: as numbers where they are known, else by calls."""

    def __init__(self, lights: list[Any], numbers: list[Numbers] | None, form: str) -> None:
        self.each: list[Any] = []  #: those with code of their own
        self.pointers = pointer("Emitter", lights) if form == "loop" else None
        self.count = dr.opaque(mi.UInt32, len(lights)) if form in ("loop", "table") else None
        self.columns: list[Table] = []
        if form == "unrolled":
            self.each = lights if numbers is None else [_opaque(*pair) for pair in numbers]
        elif form == "table" and numbers:
            # three numbers of a colour, whatever the variant's colours have
            columns = zip(*numbers, strict=True)
            self.columns = [Table(mi.Vector3f, [(3 * v)[:3] for v in column]) for column in columns]

    def at(self, index: mi.UInt32, active: mi.Bool) -> Any:
        """Return a light by its number, for a loop over all."""
        if self.pointers is not None:
            return dr.gather(mi.EmitterPtr, self.pointers, index, active)
        position, intensity = (column(index, active) for column in self.columns)
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        return PointLight(mi.Point3f(position), mi.UnpolarizedSpectrum(list(intensity)[:channels]))


def _opaque(position: list[float], intensity: list[float]) -> PointLight:
    return PointLight(dr.opaque(mi.Point3f, position), dr.opaque(mi.UnpolarizedSpectrum, intensity))
