"""The exact cones, cylinders and spheres of a scene, as ``mrt_whitted`` traces them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..intersect import Frame
from ..quadric_kinds import KINDS, LATERAL
from ..variants import is_jit, put_where
from .tables import Table, shape_at, shape_ids
from .tree import Tree

if TYPE_CHECKING:
    from ..axial import AxialMesh
    from ..group import MrtGroup
    from .buffers import PointBuffer


class Quadrics:
    """The numbers of all quadrics, in the order of the leaves of a tree over their boxes.

    Scalar variants have no tree: they go through the list.
    """

    def __init__(self, shapes: Sequence[AxialMesh | MrtGroup]) -> None:
        tables = [s.table for s in shapes]
        counts = [len(t.rows) for t in tables]
        self.count = sum(counts)
        self.kinds = sorted({t.kind for t in tables})  # the kernel holds these only
        sides = [-1 if s.has_flipped_normals() else 1 for s in shapes]
        self._boxes = np.concatenate([t.boxes() for t in tables])
        self.leaf_of = np.arange(self.count)
        leaves = self.count
        if is_jit():
            self.tree = Tree(self._boxes)
            self.leaf_of = self.tree.leaf_of
            leaves = self.tree.leaves
        # A row and a coordinate of the origin, three times; then kind, size of coordinates, 0, side of the
        # normal: a kernel reads four at a time
        numbers = np.zeros((leaves, 4, 4))
        numbers[self.leaf_of, :3, :3] = np.concatenate([t.rows for t in tables])
        numbers[self.leaf_of, :3, 3] = np.concatenate([t.origins for t in tables])
        numbers[self.leaf_of, 3, 0] = np.repeat([self.kinds.index(t.kind) for t in tables], counts)
        numbers[self.leaf_of, 3, 1] = np.abs(self._boxes).max(axis=(1, 2))
        numbers[self.leaf_of, 3, 3] = np.repeat(sides, counts)
        self.numbers = Table(mi.Vector4f, numbers)
        faces, owners = np.zeros((2, leaves), int)
        faces[self.leaf_of] = np.concatenate([t.first_faces for t in tables])
        owners[self.leaf_of] = np.repeat(np.arange(len(shapes)), counts)
        self.faces = Table(mi.UInt32, faces)
        self.shapes = shape_ids([shapes[k] for k in owners])
        firsts = self.leaf_of[np.cumsum([0, *counts[:-1]])].tolist()  # of the first quadric of each shape
        frames = [s.moving_frame() for s in shapes]
        self.moving = [(k, f) for k, f in zip(firsts, frames, strict=True) if f is not None]

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
        """True if there is a quadric before ``ray.maxt``."""
        t, _, _ = self.intersect(ray, active, any_hit=True)
        return active & (t < ray.maxt)

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the boxes [n, 2, 3] of the quadrics, and their places in the rows."""
        return self._boxes, self.leaf_of

    def block(self, leaf: mi.UInt32, ray: mi.Ray3f) -> mi.Bool:
        """True if a quadric is before ``ray.maxt``."""
        t, _ = self._meet(leaf, ray)
        return t < ray.maxt

    def fill_interaction(
        self,
        si: mi.SurfaceInteraction3f,
        ray: mi.Ray3f,
        hit: tuple[mi.Float, mi.UInt32, mi.Int32],
        where: mi.Bool,
        scale: mi.Float,
        *,
        tangents: bool = False,
    ) -> mi.Float:
        """Make ``si`` the interaction of ``ray`` with the ``hit`` that ``intersect`` found.

        Returns the size of its coordinates, the largest number in the quadric's box; ``scale`` elsewhere.
        """
        t, leaf, part = hit
        if not (is_jit() or where):
            return scale
        frame, kind, size, side = self._row(leaf, where)
        for number, moving in self.moving:
            rows = zip(vars(moving).values(), vars(frame).values(), strict=True)
            frame = Frame(*(dr.select(leaf == number, mi.Vector3f(a), mi.Vector3f(b)) for a, b in rows))
        if self.moving:
            # The hit goes along the ray as the surface moves
            met = ray.o + ray.d * t
            p, n, *_ = self._by_kind(kind, "surface", met, part, frame)
            t = dr.replace_grad(t, t + dr.dot(p - met, n) / dr.dot(ray.d, n))
        p, n, u, v, by_u, by_v = self._by_kind(kind, "surface", dr.fma(ray.d, t, ray.o), part, frame)
        more = {}
        if tangents:
            more = {"dp_du": frame.to_world(by_u), "dp_dv": frame.to_world(by_v)}
        shape = shape_at(self.shapes, leaf, where)
        more |= {"uv": mi.Point2f(u, v), "shape": shape, "prim_index": self.faces(leaf, where)}
        put_where(where, si, t=t, p=p, n=mi.Normal3f(n * side), **more)
        return dr.select(where, size, scale)

    def _row(self, leaf: mi.UInt32, active: mi.Bool = True) -> tuple[Frame, mi.Float, mi.Float, mi.Float]:
        """Return frame, kind, size of the coordinates and side of the normal."""
        x, y, z, more = (self.numbers(leaf, active, part) for part in range(4))
        rows = (mi.Vector3f(r.x, r.y, r.z) for r in (x, y, z))
        return Frame(mi.Point3f(x.w, y.w, z.w), *rows), more.x, more.y, more.w

    def _meet(self, leaf: mi.UInt32, ray: mi.Ray3f) -> tuple[mi.Float, mi.Int32]:
        """Return distance and part of a quadric; inf where it is not met."""
        frame, kind, _, _ = self._row(leaf)
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
