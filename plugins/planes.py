"""The infinite planes of a scene, as ``mrt_whitted`` traces them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from .intersect import intersect_plane
from .lookup import Table


class Planes:
    """Equations and tangents of all planes, as kernel data."""

    def __init__(self, shapes: Sequence[Any]) -> None:
        sides = [-1 if s.has_flipped_normals() else 1 for s in shapes]
        self.equations = [
            (mi.Vector3f((side * s.unit_normal).tolist()), mi.Float(side * s.distance))
            for side, s in zip(sides, shapes, strict=True)
        ]
        # The same kernel serves every plane of every scene: its numbers are data
        dr.make_opaque(self.equations)
        self.tangents = [Table(mi.Vector3f, [s.tangents[k] for s in shapes]) for k in range(2)]
        self.shapes = Table("Shape", shapes)

    def __len__(self) -> int:
        return len(self.equations)

    def intersect(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32, mi.Bool]:
        """Return the distance of the nearest plane, or ``ray.maxt``, its number, and if there is one."""
        t, index, found = mi.Float(ray.maxt), mi.UInt32(0), mi.Bool(False)
        for k, (normal, distance) in enumerate(self.equations):
            t_plane = intersect_plane(ray.o, ray.d, normal, distance)
            closer = active & (t_plane < t)
            t = dr.select(closer, t_plane, t)
            index = dr.select(closer, mi.UInt32(k), index)
            found = found | closer
        return t, index, found

    def separate(self, p: mi.Point3f, q: mi.Point3f) -> mi.Bool:
        """Return whether there is a plane between two points."""
        blocked = mi.Bool(False)
        for equation in self.equations:
            # Opposite sides: no distance is computed, so none can be wrong
            blocked |= _height(p, *equation) * _height(q, *equation) < 0
        return blocked

    def put_into(
        self,
        si: mi.SurfaceInteraction3f,
        ray: mi.Ray3f,
        index: mi.UInt32,
        where: mi.Bool,
        scale: mi.Float,
        *,
        tangents: bool = False,
    ) -> mi.Float:
        """Make ``si`` the interaction of ``ray`` with plane ``index`` at t = ray.maxt.

        Returns the size of its coordinates; ``scale`` elsewhere.
        """
        (n, distance), *others = self.equations
        for k, (normal, d) in enumerate(others, start=1):  # of few planes, quicker chosen than looked up
            n, distance = dr.select(index == k, normal, n), dr.select(index == k, d, distance)
        p = dr.fma(ray.d, ray.maxt, ray.o)
        # Along a grazing ray the error of t is far larger than that of the plane
        p -= n * _height(p, n, distance)
        si.t = dr.select(where, ray.maxt, si.t)
        si.p = dr.select(where, p, si.p)
        si.n = dr.select(where, mi.Normal3f(n), si.n)
        si.sh_frame.n = dr.select(where, mi.Normal3f(n), si.sh_frame.n)
        along = [tangent(index, where) for tangent in self.tangents]
        if tangents:
            si.dp_du, si.dp_dv = (
                dr.select(where, *both) for both in zip(along, (si.dp_du, si.dp_dv), strict=True)
            )
        uv = mi.Point2f(*(dr.dot(tangent, p) for tangent in along))
        si.uv = dr.select(where, uv, si.uv)
        si.shape = dr.select(where, self.shapes(index, where), si.shape)
        return dr.select(where, dr.abs(distance), scale)


def _height(p: Any, normal: Any, distance: Any) -> Any:
    """Return the signed distance of a point from a plane."""
    return dr.dot(normal, p) + distance
