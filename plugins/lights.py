"""The lights of a scene, as numbers in place of calls to plugins where they are known.

A light that is tabled is an emitter with ``numbers()``: its class among those below, and its numbers. To
table another kind, derive it from ``PointLight`` and return it in the ``row`` of its emitter.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .lookup import Table
from .variants import first, is_jit, largest, pointer


class PointLight:
    """A light at a point, as bright far away as near by; its numbers come in threes."""

    def __init__(self, position: mi.Point3f, intensity: mi.UnpolarizedSpectrum, *more: mi.Vector3f) -> None:
        self.position, self.intensity, self.more = position, intensity, more

    def arriving(self, d: mi.Vector3f) -> mi.UnpolarizedSpectrum:
        """Return what arrives at a point from which the light is seen along the unit vector ``d``."""
        return self.intensity

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.UnpolarizedSpectrum]:
        """Return the direction to the light, with a density of 1, and what arrives from it."""
        ds = mi.DirectionSample3f()
        ds.p = self.position
        ds.d = ds.p - it.p
        ds.dist = dr.norm(ds.d)
        # A point on the light itself has no direction to it; any will do, and scalar variants raise on 0/0
        away = ds.dist > 0
        ds.d = dr.select(away, ds.d * (1 / dr.select(away, ds.dist, 1)), mi.Vector3f(0, 0, 1))
        ds.n, ds.uv, ds.time = mi.Normal3f(-ds.d), mi.Point2f(0), it.time
        ds.pdf, ds.delta = mi.Float(1), mi.Bool(True)
        return ds, self.arriving(ds.d)


def numbers_of(lights: list[Any]) -> list[Any] | None:
    """Return lights as classes and numbers; None where not all of them are."""
    if not is_jit() or mi.is_spectral or not all(hasattr(light, "numbers") for light in lights):
        return None
    found = [light.numbers() for light in lights]
    return None if None in found else found


class Lights:
    """The lights of a scene as its kernels have them; ``form`` is that of the plan."""

    def __init__(self, lights: list[Any], numbers: list[Any] | None, form: str) -> None:
        self.each: list[Any] = []  #: those with code of their own
        self.pointers = pointer("Emitter", lights) if form == "loop" else None
        self.count = dr.opaque(mi.UInt32, len(lights)) if form in ("loop", "table") else None
        self.columns: list[Table] = []
        if form == "unrolled":
            self.each = lights
            if numbers is not None:
                self.each = [_light(kind, *(dr.opaque(mi.Vector3f, p) for p in row)) for kind, row in numbers]
        elif form == "table" and numbers:
            self.kinds = list(dict.fromkeys(kind for kind, _ in numbers))  # the kernel holds these only
            parts = max(len(parts) for _, parts in numbers)
            rows = np.zeros((1 + parts, len(numbers), 3))
            for k, (kind, row) in enumerate(numbers):
                rows[0, k], rows[1 : 1 + len(row), k] = self.kinds.index(kind), row
            self.columns = [Table(mi.Vector3f, part) for part in rows[len(self.kinds) == 1 :]]

    def sample(
        self, light: Any, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.UnpolarizedSpectrum]:
        """Return the direction from ``it`` to a light, by its number, and what arrives from it."""
        if self.each:
            return self.each[light].sample_direction(it, sample, active)
        if self.pointers is not None:
            return dr.gather(mi.EmitterPtr, self.pointers, light, active).sample_direction(it, sample, active)
        parts = [column(light, active) for column in self.columns]
        if len(self.kinds) == 1:
            return _light(self.kinds[0], *parts).sample_direction(it, sample, active)
        number, *parts = parts
        found = [_light(kind, *parts).sample_direction(it, sample, active) for kind in self.kinds]
        ds, arriving = found[0]
        for k, (_, other) in enumerate(found[1:], start=1):
            arriving = dr.select(number.x == k, other, arriving)
        return ds, arriving


def _light(kind: type[PointLight], position: Any, intensity: Any, *more: Any) -> PointLight:
    """Return a light by its numbers: three of a colour, whatever colours the variant has."""
    channels = dr.size_v(mi.UnpolarizedSpectrum)
    return kind(mi.Point3f(position), mi.UnpolarizedSpectrum(list(intensity)[:channels]), *more)


def brightness(emitter: Any) -> float:
    """Return the largest radiance, irradiance or intensity of an emitter; inf where it is not known.

    It is not known of what varies, of spectra in scalar variants, and where derivatives are wanted.
    """
    parameters = mi.traverse(emitter)
    if emitter.class_name() == "EnvironmentMapEmitter":
        data, scale = parameters["data"], parameters["scale"]
        known = not dr.grad_enabled(data, scale)
        return float(np.max(np.array(data)[..., :3]) * np.max(np.array(scale))) if known else np.inf
    values = [largest(node) for node in parameters.hierarchy if isinstance(node, mi.Texture)]
    return max(values, default=np.inf)


def place(emitter: Any) -> tuple[float, ...] | None:
    """Return where an emitter is a point; None for one that is none."""
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
        return None
    parameters = mi.traverse(emitter)
    return tuple(first(x) for x in parameters["position"]) if "position" in parameters else None
