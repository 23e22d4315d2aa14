"""Mitsuba's spheres: their centres and radii, and corrected hits on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from .lookup import ByShape


class Spheres:
    """Centres and radii of Mitsuba's spheres.

    Mitsuba takes a hit from the distance along the ray. From a hundred radii away that is further off the
    sphere than secondary rays start, and the sphere would lie in its own shadow.
    """

    def __init__(self, shapes: Sequence[mi.Shape]) -> None:
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
