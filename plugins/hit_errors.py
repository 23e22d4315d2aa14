"""How far off its surface a hit may be: secondary rays start that much away from it.

A light is on a surface if it is no further off; shadow rays must end short of it, or some would meet the
surface just before it, and others not.

With u = 2⁻²⁴, every bound has the form δ = k u (size of the numbers that are added):

- Curved surfaces, analytic planes: k = 32, the largest coordinate of the shape's box or of the hit. A few
  times what intersection, projection and ray test lose together.
- Triangles and rectangles: k = 16, the size across the surface alone, Σᵢ |nᵢ| (|pᵢ| + wᵢ) + c with the
  normal n, the hit p, and the largest extents wᵢ of a triangle along the axes. Derivation: docs/maths.md,
  "Where secondary rays start". So a floor that is level or upright takes no harm from its size. The other
  bound is kept where it is smaller: slivers make c larger than the shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import drjit.scalar
import mitsuba as mi
import numpy as np

from .intersect import Frame
from .mesh_api import triangles
from .quadric_kinds import KINDS, QuadricTable
from .simple_shapes import center_and_radius, is_sphere
from .variants import ByShape

# What a curved surface's hit, projection and ray test lose, in roundings of the largest coordinate
CURVED = 32 * 2.0**-24

# The same for flat ones, in roundings of the numbers across the surface: 11 are proven, in first order
FLAT = 16 * 2.0**-24

# A level triangle at height zero has no error at all, but a ray that starts on it exactly may meet it
LEAST = 2.0**-12

# Objects of a group that are looked at for a light: of those whose boxes hold it, which are few
MOST_LOOKED_AT = 64


class HitErrors:
    """The bounds for hits on Mitsuba's own shapes, by the shape that was hit.

    The shapes inside an instance are not of the scene's own: the largest size for them.
    """

    def __init__(self, shapes: list[mi.Shape]) -> None:
        corners = [np.array([s.bbox().min, s.bbox().max], float).ravel() for s in shapes]
        sizes = [float(np.abs(c).max()) for c in corners]
        self.sizes = ByShape(mi.Float, shapes, sizes, max(sizes)) if shapes else None
        triangles = [flat_triangles(s) for s in shapes]
        self.flat: ByShape | None = None
        if any(t is not None for t in triangles):
            curved = [0.0, 0.0, 0.0, dr.inf]
            rows = [curved if t is None else _sizes_across(t) for t in triangles]
            self.flat = ByShape(mi.Vector4f, shapes, rows, curved)

    def size(self, si: mi.SurfaceInteraction3f, found: mi.Bool) -> mi.Float:
        """Return the largest coordinate of the shape."""
        return mi.Float(0) if self.sizes is None else self.sizes(si, found)

    def of_flat(self, si: mi.SurfaceInteraction3f, found: mi.Bool) -> mi.Float | None:
        """Return the bound at a hit on a flat shape; inf on a curved one, None where all are."""
        if self.flat is None:
            return None
        row = self.flat(si, found)
        width = mi.Vector3f(row.x, row.y, row.z)
        return FLAT * (dr.dot(dr.abs(si.n), dr.abs(si.p) + width) + row.w)


def _sizes_across(corners: np.ndarray) -> list[float]:
    """Return w and c of triangles."""
    edges = np.stack([corners[:, k] - corners[:, k - 1] for k in range(3)], axis=1)  # [n, 3, 3]
    width = np.abs(edges).max(axis=1, initial=0.0)  # [n, 3]
    a, b = edges[:, 0], edges[:, 1]
    normal = np.linalg.norm(np.cross(a, b), axis=1)
    # What the components of a cross product lose, by the extents that they are multiplied with
    lost = sum(
        width[:, i] * (np.abs(a[:, i - 2] * b[:, i - 1]) + np.abs(a[:, i - 1] * b[:, i - 2]))
        for i in range(3)
    )
    condition = np.divide(lost, normal, out=np.zeros_like(lost), where=normal > 0)
    width = width.max(axis=0, initial=0.0)
    return [*width.tolist(), float(condition.max(initial=0.0) + LEAST * width.max())]


def flat_triangles(shape: Any) -> np.ndarray | None:
    """Return the corners [n, 3, 3] of a mesh's triangles, or of the two of a rectangle; None for others."""
    if shape.shape_type() == +mi.ShapeType.Rectangle:
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
        square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) @ matrix[:3, :3].T + matrix[:3, 3]
        return square[[(0, 1, 2), (0, 2, 3)]]
    return triangles(shape) if shape.is_mesh() else None


def any_touching(shapes: Sequence[Any], points: Sequence[tuple[float, ...]]) -> bool:
    """Return whether one of the points is on a plane, sphere, quadric, rectangle or mesh."""
    if not points:
        return False
    p = np.array(points)  # [n, 3]
    balls = np.array([center_and_radius(s) for s in shapes if is_sphere(s)]).reshape(-1, 4)
    tables = [s.quadrics() for s in shapes if hasattr(s, "quadrics")]
    if len(balls):
        tables.append(QuadricTable.of_numbers("sphere", balls, 0, lambda frame: frame, flipped=False))
    others = [s for s in shapes if not (is_sphere(s) or hasattr(s, "quadrics"))]
    return any(_on_quadrics(t, q) for t in tables for q in p) or any(_on_other(s, p) for s in others)


def _on_other(shape: Any, points: np.ndarray) -> bool:
    if hasattr(shape, "unit_normal"):
        heights = np.abs(points @ shape.unit_normal + shape.distance)
        return bool((heights <= CURVED * np.maximum(abs(shape.distance), np.abs(points).max(axis=1))).any())
    box = np.array([[list(shape.bbox().min), list(shape.bbox().max)]], float).reshape(1, 2, 3)
    known = np.isfinite(box).all()  # merged rectangles have none
    inside = [p for p in points if not known or _holding(box, p)[0].any()]
    corners = flat_triangles(shape) if inside else None
    return corners is not None and any(_on_triangles(corners, p) for p in inside)


def _holding(boxes: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which boxes [n, 2, 3] hold a point, and the slack [n] that they have for it."""
    slack = CURVED * np.maximum(np.abs(boxes).max(axis=(1, 2)), np.abs(p).max(axis=-1))
    low, high = boxes[:, 0] - slack[:, None], boxes[:, 1] + slack[:, None]
    return ((p >= low) & (p <= high)).all(axis=1), slack


def _on_quadrics(table: QuadricTable, p: np.ndarray) -> bool:
    boxes, kind, vector = table.boxes(), KINDS[table.kind], drjit.scalar.Array3f64
    near, slack = _holding(boxes, p)
    for k in np.flatnonzero(near)[:MOST_LOOKED_AT]:
        frame = Frame(*(vector(row.tolist()) for row in (table.origins[k], *table.rows[k])))
        for part in kind.parts:
            foot = np.array(kind.surface(vector(p.tolist()), part, frame)[0])
            # A part goes on beyond the object, but not within its box, or nearly so
            if _holding(boxes[[k]], foot)[0].all() and np.linalg.norm(foot - p) <= slack[k]:
                return True
    return False


def _on_triangles(corners: np.ndarray, p: np.ndarray) -> bool:
    """Return whether a point is on one of the triangles [n, 3, 3]; what counts is rounding across them."""
    a, b, c = corners.swapaxes(0, 1)
    normal, off = np.cross(b - a, c - a), p - a
    area = np.linalg.norm(normal, axis=1)
    normal /= np.where(area == 0, 1, area)[:, None]
    height = np.abs((off * normal).sum(axis=1))
    size = (np.abs(normal) * (np.abs(p) + np.abs(corners).max(axis=1))).sum(axis=1)
    u, v = ((np.cross(*pair) * normal).sum(axis=1) for pair in ((off, c - a), (b - a, off)))
    least = -1e-6 * area
    inside = (u >= least) & (v >= least) & (u + v <= area - least)
    return bool(((area > 0) & inside & (height <= CURVED * size)).any())
