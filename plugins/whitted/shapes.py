"""The infinite planes of a scene as ``mrt_whitted`` traces them, and Mitsuba's spheres with exact hits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..intersect import intersect_plane
from ..variants import first, put_where
from .snapshot import parameters_of
from .tables import ByShape, Table, shape_at, shape_ids

if TYPE_CHECKING:
    from ..plane import MrtPlane


class Planes:
    """Equations and tangents of all planes, as kernel data."""

    def __init__(self, shapes: Sequence[MrtPlane]) -> None:
        sides = [-1 if s.has_flipped_normals() else 1 for s in shapes]
        self.equations = [
            (mi.Vector3f((side * s.unit_normal).tolist()), mi.Float(side * s.distance))
            for side, s in zip(sides, shapes, strict=True)
        ]
        # The same kernel serves every plane of every scene: its numbers are data
        dr.make_opaque(self.equations)
        self.tangents = Table(mi.Vector3f, [s.tangents for s in shapes])
        self.shapes = shape_ids(shapes)

    def intersect(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32, mi.Bool]:
        """Return the distance of the nearest plane, or ``ray.maxt``, its number, and if there is one."""
        t = mi.Float(ray.maxt)
        index = mi.UInt32(0)
        for k, (normal, distance) in enumerate(self.equations):
            t_plane = intersect_plane(ray.o, ray.d, normal, distance)
            closer = active & (t_plane < t)
            t = dr.select(closer, t_plane, t)
            index = dr.select(closer, mi.UInt32(k), index)
        return t, index, t < ray.maxt

    def separate(self, p: mi.Point3f, q: mi.Point3f) -> mi.Bool:
        """True if there is a plane between two points."""
        blocked = mi.Bool(False)
        for equation in self.equations:
            # Opposite sides: no distance is computed, so none can be wrong
            blocked |= _height(p, *equation) * _height(q, *equation) < 0
        return blocked

    def fill_interaction(
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
            chosen = index == k
            n = dr.select(chosen, normal, n)
            distance = dr.select(chosen, d, distance)
        p = dr.fma(ray.d, ray.maxt, ray.o)
        # Along a grazing ray the error of t is far larger than that of the plane
        p -= n * _height(p, n, distance)
        along = [self.tangents(index, where, part) for part in range(2)]
        more = {"dp_du": along[0], "dp_dv": along[1]} if tangents else {}
        uv = mi.Point2f(*(dr.dot(tangent, p) for tangent in along))
        shape = shape_at(self.shapes, index, where)
        put_where(where, si, t=ray.maxt, p=p, n=mi.Normal3f(n), uv=uv, shape=shape, **more)
        return dr.select(where, dr.abs(distance), scale)


def _height(p: mi.Point3f, normal: mi.Vector3f, distance: mi.Float) -> mi.Float:
    """Return the signed distance of a point from a plane."""
    return dr.dot(normal, p) + distance


class Spheres:
    """Centres and radii of Mitsuba's spheres.

    Mitsuba takes a hit from the distance along the ray. From a hundred radii away that is further off the
    sphere than secondary rays start, and the sphere would lie in its own shadow.
    """

    def __init__(self, shapes: Sequence[mi.Shape]) -> None:
        self.shapes = shapes
        self.by_shape = ByShape(mi.Vector4f, shapes, [center_and_radius(s) for s in shapes], [0.0] * 4)

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """Return the interaction with a sphere, and the size of its coordinates, for scenes of spheres only.

        Derivatives and texture coordinates are left out.
        """
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t = dr.select(active, pi.t, dr.inf)
        si.shape = dr.select(active, pi.shape, None)
        center, radius = self._center_and_radius(si, active)
        n = dr.normalize(dr.fma(ray.d, pi.t, ray.o) - center)
        si.p = dr.fma(n, radius, center)
        si.n = si.sh_frame.n = mi.Normal3f(n)
        return si, dr.max(dr.abs(center)) + radius

    def put_back(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        """Move hits on spheres onto them, along the radius."""
        center, radius = self._center_and_radius(si, active)
        p = dr.detach(si.p)
        v = p - center
        length = dr.norm(v)
        on_sphere = active & (radius > 0) & (length > 0)
        # A shift without a derivative: how the hit moves with the sphere is for Mitsuba to say
        scale = radius / dr.select(on_sphere, length, 1)
        si.p += dr.select(on_sphere, center + v * scale - p, 0)

    def _center_and_radius(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Point3f, mi.Float]:
        row = self.by_shape(si, active)
        return mi.Point3f(row.x, row.y, row.z), row.w

    def boxes(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return the boxes [n, 2, 3] of the spheres, their numbers, and that they are balls; they are then
        ready for ``block``."""
        frames = [
            mi.get_property(value, kind, shape).matrix
            for shape in self.shapes
            for name, value, kind in parameters_of(shape)
            if name == "to_world"
        ]
        numbers = np.array([[first(m[row][column]) for row in range(3) for column in (0, 3)] for m in frames])
        # To the last bit, which Mitsuba's boxes do not have
        centers = numbers[:, 1::2]
        radii = np.linalg.norm(numbers[:, ::2], axis=1)[:, None]
        self.balls = Table(mi.Vector4f, np.column_stack([centers, radii]))
        return np.stack([centers - radii, centers + radii], axis=1), np.arange(len(radii)), True

    def block(self, index: mi.UInt32, ray: mi.Ray3f) -> mi.Bool:
        """True if a sphere blocks a ray, which Mitsuba answers the same to the bit."""
        row = self.balls(index, mi.Bool(True))
        o = ray.o - mi.Point3f(row.x, row.y, row.z)
        a = dr.squared_norm(ray.d)
        b = 2 * dr.dot(o, ray.d)
        c = dr.squared_norm(o) - dr.square(row.w)
        root = dr.sqrt(dr.fma(b, b, -(4 * a * c)))  # NaN where it misses
        q = -0.5 * (b + dr.copysign(root, b))
        one = q / a
        other = c / q
        near = dr.minimum(one, other)
        far = dr.maximum(one, other)
        return (near <= ray.maxt) & (far >= 0) & ((near >= 0) | (far <= ray.maxt))


def is_sphere(shape: mi.Shape) -> bool:
    """True if a shape is Mitsuba's ``sphere``."""
    return shape.shape_type() == +mi.ShapeType.Sphere


def center_and_radius(shape: mi.Shape) -> list[float]:
    """Return centre and radius of a sphere, zeros for another shape."""
    if not is_sphere(shape):
        return [0.0] * 4
    low, high = np.array([shape.bbox().min, shape.bbox().max], float)
    return [*0.5 * (low + high), 0.5 * (high[0] - low[0])]
