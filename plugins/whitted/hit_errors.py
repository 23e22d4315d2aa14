"""Bounds of the error of a hit: secondary rays are offset by as much.

With u = 2⁻²⁴, every bound has the form δ = k u (size of the numbers that are added):

- Curved surfaces, analytic planes: k = 32, the largest coordinate of the shape's box or of the hit. A few
  times what intersection, projection and ray test lose together.
- Triangles and rectangles: k = 16, the size across the surface alone, Σᵢ |nᵢ| (|pᵢ| + wᵢ) + c with the
  normal n, the hit p, and the largest extents wᵢ of a triangle along the axes. Derivation: docs/maths.md,
  "Where secondary rays start". So a floor that is level or upright takes no harm from its size. The other
  bound is kept where it is smaller: slivers make c larger than the shape.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..mesh_api import triangles
from .tables import ByShape

# What a curved surface's hit, projection and ray test lose, in roundings of the largest coordinate
CURVED = 32 * 2.0**-24

# The same for flat ones, in roundings of the numbers across the surface: 11 are proven, in first order
FLAT = 16 * 2.0**-24

# A level triangle at height zero has no error at all, but a ray that starts on it exactly may meet it
LEAST = 2.0**-12


class HitErrors:
    """The bounds of hits, and the sizes of Mitsuba's own shapes that they depend on.

    Shapes inside an instance are not the scene's own, and get the largest size.
    """

    def __init__(self, shapes: list[mi.Shape]) -> None:
        corners = [np.array([s.bbox().min, s.bbox().max], float).ravel() for s in shapes]
        sizes = [float(np.abs(c).max()) for c in corners]
        self.sizes = ByShape(mi.Float, shapes, sizes, max(sizes)) if shapes else None
        triangles = [_flat_triangles(s) for s in shapes]
        self.flat: ByShape | None = None
        if any(t is not None for t in triangles):
            curved = [0.0, 0.0, 0.0, dr.inf]
            rows = [curved if t is None else _sizes_across(t) for t in triangles]
            self.flat = ByShape(mi.Vector4f, shapes, rows, curved)

    def size(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Return the largest coordinate of the shape."""
        return mi.Float(0) if self.sizes is None else self.sizes(si, active)

    def bound(self, si: mi.SurfaceInteraction3f, scale: mi.Float, active: mi.Bool) -> mi.Float:
        """Return how far a hit may be off its surface, in scene units.

        ``scale``: the largest coordinate of the shape that was hit, which may be another than Mitsuba's.
        """
        error = CURVED * dr.maximum(scale, dr.max(dr.abs(si.p)))
        if self.flat is None:
            return error
        row = self.flat(si, active)
        width = mi.Vector3f(row.x, row.y, row.z)
        return dr.minimum(error, FLAT * (dr.dot(dr.abs(si.n), dr.abs(si.p) + width) + row.w))


def _sizes_across(corners: np.ndarray) -> list[float]:
    """Return w and c of triangles."""
    edges = corners - np.roll(corners, 1, axis=1)  # [n, 3, 3]
    width = np.abs(edges).max(axis=1, initial=0.0)  # [n, 3]
    normal = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # What the components of a cross product lose, by the extents that they are multiplied with
    a = np.abs(edges[:, 0])
    b = np.abs(edges[:, 1])
    products = np.roll(a, 2, axis=1) * np.roll(b, 1, axis=1) + np.roll(a, 1, axis=1) * np.roll(b, 2, axis=1)
    lost = (width * products).sum(axis=1)
    condition = np.divide(lost, normal, out=np.zeros_like(lost), where=normal > 0)
    width = width.max(axis=0, initial=0.0)
    return [*width.tolist(), float(condition.max(initial=0.0) + LEAST * width.max())]


def _flat_triangles(shape: mi.Shape) -> np.ndarray | None:
    """Return the corners [n, 3, 3] of a mesh's triangles, or of the two of a rectangle; None for others."""
    if shape.shape_type() == +mi.ShapeType.Rectangle:
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
        square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        corners = square @ matrix[:3, :3].T + matrix[:3, 3]
        return corners[[(0, 1, 2), (0, 2, 3)]]
    return triangles(shape) if shape.is_mesh() else None
