"""Mitsuba's spheres: their centres and radii, and corrected hits on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .lookup import ByShape, Table
from .snapshot import parameters_of
from .variants import first


class Spheres:
    """Centres and radii of Mitsuba's spheres.

    Mitsuba takes a hit from the distance along the ray. From a hundred radii away that is further off the
    sphere than secondary rays start, and the sphere would lie in its own shadow.
    """

    def __init__(self, shapes: Sequence[mi.Shape]) -> None:
        self.shapes = shapes
        self.by_shape = ByShape(mi.Vector4f, shapes, [center_and_radius(s) for s in shapes], [0.0] * 4)

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, found: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """Return what ``compute_surface_interaction`` gives, and the size of the coordinates: spheres only.

        Derivatives and texture coordinates are left out.
        """
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t, si.shape = dr.select(found, pi.t, dr.inf), dr.select(found, pi.shape, None)
        center, radius = self._center_and_radius(si, found)
        n = dr.normalize(dr.fma(ray.d, pi.t, ray.o) - center)
        si.p = dr.fma(n, radius, center)
        si.n = si.sh_frame.n = mi.Normal3f(n)
        return si, dr.max(dr.abs(center)) + radius

    def put_back(self, si: mi.SurfaceInteraction3f, found: mi.Bool) -> None:
        """Move hits on spheres onto them, along the radius."""
        center, radius = self._center_and_radius(si, found)
        p = dr.detach(si.p)
        v = p - center
        length = dr.norm(v)
        on_sphere = found & (radius > 0) & (length > 0)
        # A shift without a derivative: how the hit moves with the sphere is for Mitsuba to say
        si.p += dr.select(on_sphere, center + v * (radius / dr.select(on_sphere, length, 1)) - p, 0)

    def _center_and_radius(self, si: mi.SurfaceInteraction3f, found: mi.Bool) -> tuple[mi.Point3f, mi.Float]:
        row = self.by_shape(si, found)
        return mi.Point3f(row.x, row.y, row.z), row.w

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the boxes [n, 2, 3] of the spheres, and their numbers; they are then ready for ``block``."""
        found = [(s, next(e for e in parameters_of(s) if e[0] == "to_world")) for s in self.shapes]
        frames = [mi.get_property(value, kind, s).matrix for s, (_, value, kind) in found]
        numbers = np.array([[first(m[row][column]) for row in range(3) for column in (0, 3)] for m in frames])
        # To the last bit, which Mitsuba's boxes do not have
        centers, radii = numbers[:, 1::2], np.linalg.norm(numbers[:, ::2], axis=1)[:, None]
        self.balls = Table(mi.Vector4f, np.column_stack([centers, radii]).tolist())
        return np.stack([centers - radii, centers + radii], axis=1), np.arange(len(radii))

    def block(self, index: mi.UInt32, ray: mi.Ray3f) -> mi.Bool:
        """Return whether a sphere is in the way of a ray: to the bit what Mitsuba says."""
        row = self.balls(index, mi.Bool(True))
        o = ray.o - mi.Point3f(row.x, row.y, row.z)
        a, b = dr.squared_norm(ray.d), 2 * dr.dot(o, ray.d)
        c = dr.squared_norm(o) - dr.square(row.w)
        q = -0.5 * (b + dr.copysign(dr.sqrt(dr.fma(b, b, -(4 * a * c))), b))  # NaN where it misses
        one, other = q / a, c / q
        near, far = dr.minimum(one, other), dr.maximum(one, other)
        return (near <= ray.maxt) & (far >= 0) & ((near >= 0) | (far <= ray.maxt))


def is_sphere(shape: Any) -> bool:
    """Return whether a shape is Mitsuba's ``sphere``."""
    return shape.shape_type() == +mi.ShapeType.Sphere


def is_plain_sphere(shape: Any) -> bool:
    """Return whether a shape is a sphere that faces outwards and does not emit."""
    return is_sphere(shape) and not (shape.has_flipped_normals() or shape.is_emitter())


def center_and_radius(shape: Any) -> list[float]:
    """Return those of a sphere, zeros for another shape."""
    if not is_sphere(shape):
        return [0.0] * 4
    low, high = ([float(c) for c in corner] for corner in (shape.bbox().min, shape.bbox().max))
    return [0.5 * (a + b) for a, b in zip(low, high, strict=True)] + [0.5 * (high[0] - low[0])]
