"""The exact cones, cylinders and spheres of a scene, as ``mrt_whitted`` traces them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import LATERAL, Frame, SurfaceHit, SurfacePoint
from .lookup import aligned, shape_ids
from .quadric_kinds import KINDS, QuadricTable
from .tree import Tree
from .variants import is_jit


class Quadrics:
    """Tables of the numbers of all quadrics, in the order of the leaves of a tree over their boxes.

    A shape takes part if it has ``quadrics()``, a ``QuadricTable``.
    """

    def __init__(self, shapes: list) -> None:
        tables = self._quadrics = [s.quadrics() for s in shapes]
        counts = [len(t.rows) for t in tables]
        self.count = sum(counts)
        self.kinds = sorted({t.kind for t in tables})  # the kernel holds these only
        self.flipped = any(t.flipped for t in tables)
        boxes = np.concatenate([t.boxes() for t in tables])
        tree = self.tree = Tree(boxes)
        table = np.zeros((tree.leaves, 4, 4), np.float32)
        table[tree.leaf_of] = _numbers(tables, self.kinds, boxes)
        self.table = aligned(table)
        owner, faces = np.zeros((2, tree.leaves), np.uint32)
        owner[tree.leaf_of] = np.repeat(np.arange(len(shapes)), counts)
        faces[tree.leaf_of] = np.concatenate([t.first_faces for t in tables])
        self.shapes = dr.gather(mi.UInt32, shape_ids(shapes), mi.UInt32(owner))
        self.faces = mi.UInt32(faces)
        dr.eval(self.shapes, self.faces)
        leaves = tree.leaf_of[np.cumsum([0, *counts[:-1]])].tolist()  # of the first quadric of each shape
        frames = [s.moving_frame() for s in shapes]
        self.moving = [(k, f) for k, f in zip(leaves, frames, strict=True) if f is not None]

    def intersect(self, ray: Any, active: Any) -> tuple[Any, Any, Any]:
        """Return distance, place in the tables and part of the nearest quadric; ``ray.maxt`` for none."""
        return self._walk(ray, active, any_hit=False)

    def occluded(self, ray: Any, active: Any) -> Any:
        """Return whether there is a quadric before ``ray.maxt``."""
        return active & (self._walk(ray, active, any_hit=True)[0] < ray.maxt)

    def hulls(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what holds the quadrics, ellipsoids [n, 2, 3, 4], and their places in the tables."""
        return np.concatenate([t.hulls() for t in self._quadrics]), self.tree.leaf_of

    def block(self, leaf: Any, ray: Any) -> Any:
        """Return whether a quadric is before ``ray.maxt``."""
        return self._meet(leaf, ray).t < ray.maxt

    def _walk(self, ray: Any, active: Any, *, any_hit: bool) -> tuple[Any, Any, Any]:
        def visit(leaf: Any, state: tuple) -> tuple:
            hit = self._meet(leaf, ray)
            closer = hit.t < state[0]
            return (dr.select(closer, hit.t, state[0]), dr.select(closer, leaf, state[1]),
                    dr.select(closer, hit.part, state[2]))  # fmt: skip

        state = mi.Float(ray.maxt), mi.UInt32(0), mi.Int32(LATERAL)
        return self.tree.walk(ray, active, visit, state, any_hit=any_hit)

    def _row(self, leaf: Any, active: Any = True) -> tuple[Frame, Any, Any]:
        """Return frame, kind and side of the normal."""
        x, y, z, more = (dr.gather(mi.Vector4f, self.table, 4 * leaf + k, active) for k in range(4))
        origin = mi.Point3f(x.w, y.w, z.w)
        x, y, z = (mi.Vector3f(r.x, r.y, r.z) for r in (x, y, z))
        return Frame(origin, x, y, z), more.x, more.w

    def _meet(self, leaf: Any, ray: Any) -> SurfaceHit:
        frame, kind, _ = self._row(leaf)
        t, part = mi.Float(dr.inf), mi.Int32(LATERAL)
        for k, name in enumerate(self.kinds):
            hit = KINDS[name].intersect(ray.o, ray.d, frame)
            own = kind == k
            t, part = dr.select(own, hit.t, t), dr.select(own, hit.part, part)
        return SurfaceHit(t, part)

    def put_into(self, si: Any, ray: Any, hit: tuple, where: Any, *, tangents: bool = False) -> None:
        """Make ``si`` the interaction of ``ray`` with what ``intersect`` found."""
        t, leaf, part = hit
        frame, kind, side = self._row(leaf, where)
        for number, moving in self.moving:
            own = leaf == number
            frame = Frame(
                *(dr.select(own, *both) for both in zip(_frame(moving), _frame(frame), strict=True))
            )
        if self.moving:
            # The hit goes along the ray as the surface moves
            surface = self._surface(ray.o + ray.d * t, part, frame, kind)
            to_surface = dr.dot(surface.p - (ray.o + ray.d * t), surface.n)
            t = dr.replace_grad(t, t + to_surface / dr.dot(ray.d, surface.n))
        surface = self._surface(dr.fma(ray.d, t, ray.o), part, frame, kind)
        if tangents:
            q = frame.point(surface.p)
            derivatives = [KINDS[name].derivatives(q, part, frame) for name in self.kinds]
            for name, by_kind in zip(("dp_du", "dp_dv"), zip(*derivatives, strict=True), strict=True):
                chosen = by_kind[0]
                for k, other in enumerate(by_kind[1:], start=1):
                    chosen = dr.select(kind == k, other, chosen)
                setattr(si, name, dr.select(where, frame.to_world(chosen), getattr(si, name)))
        if self.flipped:
            surface.n *= side
        shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self.shapes, leaf, where))
        _put_surface(si, t, surface, shape, where)
        si.prim_index = dr.select(where, dr.gather(mi.UInt32, self.faces, leaf, where), si.prim_index)

    def _surface(self, p: Any, part: Any, frame: Frame, kind: Any) -> SurfacePoint:
        """Put a point onto the quadric of this frame and kind."""
        surface = KINDS[self.kinds[0]].surface(p, part, frame)
        for k, name in list(enumerate(self.kinds))[1:]:
            other, own = KINDS[name].surface(p, part, frame), kind == k
            surface = SurfacePoint(
                *(dr.select(own, a, b) for a, b in zip(_members(other), _members(surface), strict=True))
            )
        return surface

    def scale(self, leaf: Any, active: Any) -> Any:
        """Return the size of the coordinates of a quadric: the largest number in its box."""
        return dr.gather(mi.Float, self.table, 16 * leaf + 13, active)


def _numbers(tables: list[QuadricTable], kinds: list[str], boxes: np.ndarray) -> np.ndarray:
    """Return what a kernel reads of each quadric, [n, 4, 4]: four numbers at a time.

    A row and a coordinate of the origin, three times; kind, size of coordinates, nothing, side of the normal.
    """
    numbers = np.zeros((len(boxes), 4, 4))
    numbers[:, :3, :3] = np.concatenate([t.rows for t in tables])
    numbers[:, :3, 3] = np.concatenate([t.origins for t in tables])
    numbers[:, 3, 0] = np.concatenate([np.full(len(t.rows), kinds.index(t.kind)) for t in tables])
    numbers[:, 3, 1] = np.abs(boxes).max(axis=(1, 2))
    numbers[:, 3, 3] = np.concatenate([np.full(len(t.rows), -1 if t.flipped else 1) for t in tables])
    return numbers


class ScalarQuadrics:
    """``Quadrics`` for scalar variants, where a loop in Python over all quadrics is one cost among many."""

    def __init__(self, shapes: list) -> None:
        self.objects = [
            _ScalarObject(s, t, k) for s in shapes for t in (s.quadrics(),) for k in range(len(t.rows))
        ]
        self.kinds = sorted({o.kind for o in self.objects})
        self.count = len(self.objects)

    def intersect(self, ray: Any, active: bool) -> tuple[float, int, int]:
        best = (ray.maxt, 0, LATERAL)
        for k, thing in enumerate(self.objects if active else ()):
            hit = KINDS[thing.kind].intersect(ray.o, ray.d, thing.frame)
            if hit.t < best[0]:
                best = hit.t, k, hit.part
        return best

    def occluded(self, ray: Any, active: bool) -> bool:
        return active and self.intersect(ray, active)[0] < ray.maxt

    def put_into(
        self, si: Any, ray: Any, hit: tuple[float, int, int], where: bool, *, tangents: bool = False
    ) -> None:
        t, k, part = hit
        if where:
            thing = self.objects[k]
            kind, frame = KINDS[thing.kind], thing.frame
            surface = kind.surface(ray(t), part, frame)
            if tangents:
                derivatives = kind.derivatives(frame.point(surface.p), part, frame)
                si.dp_du, si.dp_dv = (frame.to_world(v) for v in derivatives)
            surface.n *= thing.side
            _put_surface(si, t, surface, thing.shape, where)
            si.prim_index = thing.first_face

    def scale(self, k: int, active: bool) -> float:
        return self.objects[k].scale


class _ScalarObject:
    """One quadric of a table."""

    def __init__(self, shape: Any, table: QuadricTable, k: int) -> None:
        self.shape, self.kind, self.first_face = shape, table.kind, int(table.first_faces[k])
        x, y, z = (mi.Vector3f(row.tolist()) for row in table.rows[k])
        self.frame = Frame(mi.Point3f(table.origins[k].tolist()), x, y, z)
        self.side = -1 if table.flipped else 1
        self.scale = float(np.abs(table.boxes()[k]).max())


def quadrics_of(shapes: list) -> Quadrics | ScalarQuadrics | None:
    """Return what traces these quadrics; None without any."""
    if not shapes:
        return None
    return Quadrics(shapes) if is_jit() else ScalarQuadrics(shapes)


def _members(surface: SurfacePoint) -> tuple:
    return surface.p, surface.n, surface.u, surface.v


def _frame(frame: Frame) -> tuple:
    return (
        mi.Vector3f(frame.origin),
        *(mi.Vector3f(r) for r in (frame.x, frame.y, frame.z)),
    )


def _put_surface(si: Any, t: Any, surface: SurfacePoint, shape: Any, where: Any) -> None:
    si.t = dr.select(where, t, si.t)
    si.p = dr.select(where, surface.p, si.p)
    si.n = dr.select(where, mi.Normal3f(surface.n), si.n)
    si.sh_frame.n = dr.select(where, mi.Normal3f(surface.n), si.sh_frame.n)
    si.uv = dr.select(where, mi.Point2f(surface.u, surface.v), si.uv)
    si.shape = dr.select(where, shape, si.shape)
