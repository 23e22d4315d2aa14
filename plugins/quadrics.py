"""The exact cones, cylinders and spheres of a scene, as ``mrt_whitted`` traces them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import (
    LATERAL,
    Frame,
    SurfaceHit,
    SurfacePoint,
    cone_surface,
    cylinder_surface,
    intersect_cone,
    intersect_cylinder,
)
from .tree import Tree
from .variants import is_jit, pointer

# For each kind, how to meet it and how to put a point onto it
_KINDS = {
    "cone": (lambda o, d, f: intersect_cone(o, d, f), cone_surface),
    "open cone": (lambda o, d, f: intersect_cone(o, d, f, capped=False), cone_surface),
    "cylinder": (lambda o, d, f: intersect_cylinder(o, d, f), cylinder_surface),
    "open cylinder": (lambda o, d, f: intersect_cylinder(o, d, f, capped=False), cylinder_surface),
}


class Quadrics:
    """Tables of the numbers of all quadrics, in the order of the leaves of a tree over their boxes.

    A shape takes part by its ``quadric`` (a kind), ``capped`` and ``frame()``.
    """

    def __init__(self, shapes: list) -> None:
        kinds = [s.quadric if s.capped else f"open {s.quadric}" for s in shapes]
        self.kinds = sorted(set(kinds))  # the kernel holds these only
        frames = [s.frame() for s in shapes]
        origins = np.array([list(f.origin) for f in frames])  # [n, 3]
        rows = np.array([[list(f.x), list(f.y), list(f.z)] for f in frames])  # [n, 3, 3]
        boxes = _boxes(kinds, origins, np.linalg.inv(rows))
        tree = self.tree = Tree(boxes)
        # Four numbers at a time: a row and a coordinate of the origin, three times; kind; size of coordinates
        table = np.zeros((tree.leaves, 4, 4), np.float32)
        table[tree.leaf_of, :3, :3] = rows
        table[tree.leaf_of, :3, 3] = origins
        table[tree.leaf_of, 3, 0] = [self.kinds.index(k) for k in kinds]
        table[tree.leaf_of, 3, 1] = np.abs(boxes).max(axis=(1, 2))
        self.table = mi.Float(table.ravel())
        owner = np.zeros(tree.leaves, np.uint32)
        owner[tree.leaf_of] = np.arange(len(shapes))
        self.shapes = dr.gather(mi.ShapePtr, pointer("Shape", shapes), mi.UInt32(owner))
        dr.eval(self.table, self.shapes)

    def intersect(self, ray: Any, active: Any) -> tuple[Any, Any, Any]:
        """Distance, place in the tables and part of the nearest quadric; distance ``ray.maxt`` for none."""
        return self._walk(ray, active, any_hit=False)

    def occluded(self, ray: Any, active: Any) -> Any:
        """Is there a quadric before ``ray.maxt``?"""
        return active & (self._walk(ray, active, any_hit=True)[0] < ray.maxt)

    def _walk(self, ray: Any, active: Any, *, any_hit: bool) -> tuple[Any, Any, Any]:
        def visit(leaf: Any, state: tuple) -> tuple:
            hit = self._meet(leaf, ray)
            closer = hit.t < state[0]
            return (dr.select(closer, hit.t, state[0]), dr.select(closer, leaf, state[1]),
                    dr.select(closer, hit.part, state[2]))  # fmt: skip

        state = mi.Float(ray.maxt), mi.UInt32(0), mi.Int32(LATERAL)
        return self.tree.walk(ray, active, visit, state, any_hit=any_hit)

    def _frame_and_kind(self, leaf: Any, active: Any = True) -> tuple[Frame, Any]:
        x, y, z, more = (dr.gather(mi.Vector4f, self.table, 4 * leaf + k, active) for k in range(4))
        rows = [mi.Vector3f(r.x, r.y, r.z) for r in (x, y, z)]
        return Frame(mi.Point3f(x.w, y.w, z.w), *rows), more.x

    def _meet(self, leaf: Any, ray: Any) -> SurfaceHit:
        frame, kind = self._frame_and_kind(leaf)
        t, part = mi.Float(dr.inf), mi.Int32(LATERAL)
        for k, name in enumerate(self.kinds):
            hit = _KINDS[name][0](ray.o, ray.d, frame)
            own = kind == k
            t, part = dr.select(own, hit.t, t), dr.select(own, hit.part, part)
        return SurfaceHit(t, part)

    def put_into(self, si: Any, ray: Any, hit: tuple, where: Any) -> None:
        """Make ``si`` the interaction of ``ray`` with what ``intersect`` found."""
        t, leaf, part = hit
        frame, kind = self._frame_and_kind(leaf, where)
        p = dr.fma(ray.d, t, ray.o)
        surface = _KINDS[self.kinds[0]][1](p, part, frame)
        for k, name in list(enumerate(self.kinds))[1:]:
            other, own = _KINDS[name][1](p, part, frame), kind == k
            surface = SurfacePoint(
                *(dr.select(own, a, b) for a, b in zip(_members(other), _members(surface), strict=True))
            )
        _put_surface(si, t, surface, dr.gather(mi.ShapePtr, self.shapes, leaf, where), where)

    def scale(self, leaf: Any, active: Any) -> Any:
        """Size of the coordinates of a quadric: the largest number in its box."""
        return dr.gather(mi.Float, self.table, 16 * leaf + 13, active)


class ScalarQuadrics:
    """The same for scalar variants, where a loop in Python over all quadrics is one cost among many."""

    def __init__(self, shapes: list) -> None:
        self.shapes = shapes
        self.kinds = [s.quadric if s.capped else f"open {s.quadric}" for s in shapes]
        self.frames = [Frame(mi.Point3f(f.origin), *(mi.Vector3f(row) for row in (f.x, f.y, f.z)))
                       for f in (s.frame() for s in shapes)]  # fmt: skip

    def intersect(self, ray: Any, active: bool) -> tuple[float, int, int]:
        best = (ray.maxt, 0, LATERAL)
        for k, (kind, frame) in enumerate(zip(self.kinds, self.frames, strict=True) if active else ()):
            hit = _KINDS[kind][0](ray.o, ray.d, frame)
            if hit.t < best[0]:
                best = hit.t, k, hit.part
        return best

    def occluded(self, ray: Any, active: bool) -> bool:
        return active and self.intersect(ray, active)[0] < ray.maxt

    def put_into(self, si: Any, ray: Any, hit: tuple[float, int, int], where: bool) -> None:
        t, k, part = hit
        if where:
            surface = _KINDS[self.kinds[k]][1](ray(t), part, self.frames[k])
            _put_surface(si, t, surface, self.shapes[k], where)

    def scale(self, k: int, active: bool) -> float:
        box = self.shapes[k].bbox()
        return max(abs(c) for corner in (box.min, box.max) for c in corner)


def quadrics_of(shapes: list) -> Quadrics | ScalarQuadrics | None:
    """What traces the shapes that are quadrics; None where there is none."""
    found = [s for s in shapes if hasattr(s, "quadric")]
    if not found:
        return None
    return Quadrics(found) if is_jit() else ScalarQuadrics(found)


def _members(surface: SurfacePoint) -> tuple:
    return surface.p, surface.n, surface.u, surface.v


def _put_surface(si: Any, t: Any, surface: SurfacePoint, shape: Any, where: Any) -> None:
    si.t = dr.select(where, t, si.t)
    si.p = dr.select(where, surface.p, si.p)
    si.n = dr.select(where, mi.Normal3f(surface.n), si.n)
    si.sh_frame.n = dr.select(where, mi.Normal3f(surface.n), si.sh_frame.n)
    si.uv = dr.select(where, mi.Point2f(surface.u, surface.v), si.uv)
    si.shape = dr.select(where, shape, si.shape)


def _boxes(kinds: list[str], origins: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Bounding boxes [n, 2, 3] of quadrics with these origins and unit-to-world matrices [n, 3, 3]."""
    axis = columns[:, :, 2]
    disc = np.sqrt(columns[:, :, 0] ** 2 + columns[:, :, 1] ** 2)  # half extent of the disc x² + y² <= 1
    at_origin = disc * np.array([not k.endswith("cone") for k in kinds])[:, None]
    low = np.minimum(origins - at_origin, origins + axis - disc)
    high = np.maximum(origins + at_origin, origins + axis + disc)
    return np.stack([low, high], axis=1)
