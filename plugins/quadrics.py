"""The exact cones, cylinders and spheres of a scene, as ``mrt_whitted`` traces them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import LATERAL, Frame
from .point_buffer import PointBuffer
from .quadric_kinds import KINDS
from .tree import Tree
from .variants import aligned, is_jit, put_where, shape_ids

if TYPE_CHECKING:
    from .exact_mesh import ExactMesh


class Quadrics:
    """The numbers of all quadrics, in the order of the leaves of a tree over their boxes.

    Scalar variants have no tree: they go through the list.
    """

    def __init__(self, shapes: Sequence[ExactMesh]) -> None:
        tables = self._tables = [s.quadrics() for s in shapes]
        counts = [len(t.rows) for t in tables]
        self.count = sum(counts)
        self.kinds = sorted({t.kind for t in tables})  # the kernel holds these only
        self.flipped = any(t.flipped for t in tables)
        boxes = np.concatenate([t.boxes() for t in tables])
        numbers = np.concatenate([t.numbers(self.kinds) for t in tables])
        owners = np.repeat(np.arange(len(shapes)), counts).tolist()
        faces = np.concatenate([t.first_faces for t in tables])
        if not is_jit():
            self.rows = numbers.tolist()
            self.shapes = [shapes[k] for k in owners]
            self.faces = faces.tolist()
            self.moving: list[tuple[int, Frame]] = []
            return
        tree = self.tree = Tree(boxes)
        table = np.zeros((tree.leaves, 4, 4), np.float32)
        table[tree.leaf_of] = numbers
        self.table = aligned(table)
        of_leaves = np.zeros((2, tree.leaves), np.uint32)
        of_leaves[:, tree.leaf_of] = owners, faces
        self.shapes = dr.gather(mi.UInt32, shape_ids(shapes), mi.UInt32(of_leaves[0]))
        self.faces = mi.UInt32(of_leaves[1])
        dr.eval(self.shapes, self.faces)
        leaves = tree.leaf_of[np.cumsum([0, *counts[:-1]])].tolist()  # of the first quadric of each shape
        frames = [s.moving_frame() for s in shapes]
        self.moving = [(k, f) for k, f in zip(leaves, frames, strict=True) if f is not None]

    def intersect(
        self, ray: mi.Ray3f, active: mi.Bool, eye: PointBuffer | None = None, any_hit: bool = False
    ) -> tuple[mi.Float, mi.UInt32, mi.Int32]:
        """Return distance, place in the rows and part of the nearest quadric; ``ray.maxt`` for none.

        ``eye``: lists for a point that rays may come from. ``any_hit``: another than the nearest will do.
        """

        def visit(leaf: mi.UInt32, state: tuple) -> tuple:
            t, part = self._meet(leaf, ray)
            closer = t < state[0]
            return tuple(dr.select(closer, *pair) for pair in zip((t, leaf, part), state, strict=True))

        state = mi.Float(ray.maxt), mi.UInt32(0), mi.Int32(LATERAL)
        if eye is not None:
            state, seen = eye.nearest(ray, active, visit, state)
            active = active & ~seen
        if is_jit():
            return self.tree.walk(ray, active, visit, state, any_hit=any_hit)
        for k in range(self.count) if active else ():
            state = visit(k, state)
        return state

    def occluded(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Return whether there is a quadric before ``ray.maxt``."""
        t, _, _ = self.intersect(ray, active, any_hit=True)
        return active & (t < ray.maxt)

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the boxes [n, 2, 3] of the quadrics, and their places in the rows."""
        return np.concatenate([t.boxes() for t in self._tables]), self.tree.leaf_of

    def block(self, leaf: mi.UInt32, ray: mi.Ray3f) -> mi.Bool:
        """Return whether a quadric is before ``ray.maxt``."""
        t, _ = self._meet(leaf, ray)
        return t < ray.maxt

    def scale(self, leaf: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Return the size of the coordinates of a quadric: the largest number in its box."""
        if not is_jit():
            return self.rows[leaf][3][1]
        return dr.gather(mi.Float, self.table, 16 * leaf + 13, active)

    def put_into(
        self,
        si: mi.SurfaceInteraction3f,
        ray: mi.Ray3f,
        hit: tuple[mi.Float, mi.UInt32, mi.Int32],
        where: mi.Bool,
        *,
        tangents: bool = False,
    ) -> None:
        """Make ``si`` the interaction of ``ray`` with what ``intersect`` found."""
        t, leaf, part = hit
        if not (is_jit() or where):
            return
        frame, kind, side = self._row(leaf, where)
        for number, moving in self.moving:
            rows = zip((moving.origin, moving.x, moving.y, moving.z), vars(frame).values(), strict=True)
            frame = Frame(*(dr.select(leaf == number, mi.Vector3f(a), mi.Vector3f(b)) for a, b in rows))
        if self.moving:
            # The hit goes along the ray as the surface moves
            met = ray.o + ray.d * t
            p, n, _, _ = self._by_kind(kind, "surface", met, part, frame)
            t = dr.replace_grad(t, t + dr.dot(p - met, n) / dr.dot(ray.d, n))
        p, n, u, v = self._by_kind(kind, "surface", dr.fma(ray.d, t, ray.o), part, frame)
        if tangents:
            by_u, by_v = self._by_kind(kind, "derivatives", frame.point(p), part)
            si.dp_du = dr.select(where, frame.to_world(by_u), si.dp_du)
            si.dp_dv = dr.select(where, frame.to_world(by_v), si.dp_dv)
        if self.flipped:
            n *= side
        if is_jit():
            shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self.shapes, leaf, where))
            face = dr.gather(mi.UInt32, self.faces, leaf, where)
        else:
            shape = self.shapes[leaf]
            face = self.faces[leaf]
        put_where(where, si, t=t, p=p, n=mi.Normal3f(n), uv=mi.Point2f(u, v), shape=shape, prim_index=face)

    def _row(self, leaf: mi.UInt32, active: mi.Bool = True) -> tuple[Frame, mi.Float, mi.Float]:
        """Return frame, kind and side of the normal."""
        if is_jit():
            x, y, z, more = (dr.gather(mi.Vector4f, self.table, 4 * leaf + k, active) for k in range(4))
        else:
            x, y, z, more = map(mi.Vector4f, self.rows[leaf])
        rows = (mi.Vector3f(r.x, r.y, r.z) for r in (x, y, z))
        return Frame(mi.Point3f(x.w, y.w, z.w), *rows), more.x, more.w

    def _meet(self, leaf: mi.UInt32, ray: mi.Ray3f) -> tuple[mi.Float, mi.Int32]:
        """Return distance and part of a quadric; inf where it is not met."""
        frame, kind, _ = self._row(leaf)
        t, part = self._by_kind(kind, "intersect", ray.o, ray.d, frame)
        return t, mi.Int32(part)

    def _by_kind(self, kind: mi.Float, function: str, *arguments: object) -> tuple:
        """Return the tuple that a function gives, by its name, of the kind of each quadric."""
        if not is_jit():
            return getattr(KINDS[self.kinds[int(kind)]], function)(*arguments)
        first, *others = (getattr(KINDS[name], function)(*arguments) for name in self.kinds)
        for k, other in enumerate(others, start=1):
            first = tuple(dr.select(kind == k, *pair) for pair in zip(other, first, strict=True))
        return first
