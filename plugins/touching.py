"""Point lights that lie on surfaces, found in plain numbers: shadow rays must end short of them.

A light is on a surface if it is no further off it than rounding takes a point on it (see ``hit_errors``).
Otherwise some shadow rays would meet the surface just before the light, and others not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit.scalar
import numpy as np

from .hit_errors import CURVED, flat_triangles
from .intersect import Frame
from .protocols import PlaneShape, QuadricShape
from .quadric_kinds import KINDS, QuadricTable
from .spheres import center_and_radius, is_sphere

# Objects of a group that are looked at for a light: of those whose boxes hold it, which are few
MOST_LOOKED_AT = 64


def any_touching(shapes: Sequence[Any], points: Sequence[tuple[float, ...]]) -> bool:
    """Return whether one of the points is on a plane, sphere, quadric, rectangle or mesh."""
    if not points:
        return False
    p = np.array(points)  # [n, 3]
    balls = np.array([center_and_radius(s) for s in shapes if is_sphere(s)]).reshape(-1, 4)
    return any(_on_spheres(balls, q) for q in p) or any(_touches(s, p) for s in shapes if not is_sphere(s))


def _touches(shape: Any, points: np.ndarray) -> bool:
    if isinstance(shape, PlaneShape):
        heights = np.abs(points @ shape.unit_normal + shape.distance)
        return bool((heights <= CURVED * np.maximum(abs(shape.distance), _sizes(points))).any())
    if isinstance(shape, QuadricShape):
        table = shape.quadrics()
        boxes = table.boxes()
        return any(_on_quadrics(table, boxes, p) for p in points)
    box = np.array([[list(shape.bbox().min), list(shape.bbox().max)]], float).reshape(1, 2, 3)
    known = np.isfinite(box).all()  # merged rectangles have none
    inside = [p for p in points if not known or _holding(box, p)[0].any()]
    corners = flat_triangles(shape) if inside else None
    return corners is not None and any(_on_triangles(corners, p) for p in inside)


def _sizes(values: np.ndarray) -> np.ndarray:
    """Return the largest coordinates [n] of values [n, ...]."""
    return np.asarray(np.abs(values).reshape(len(values), -1).max(axis=1))


def _on_spheres(balls: np.ndarray, p: np.ndarray) -> bool:
    heights = np.abs(np.linalg.norm(balls[:, :3] - p, axis=1) - balls[:, 3])
    sizes = np.abs(balls[:, :3]).max(axis=1, initial=0) + balls[:, 3]
    return bool((heights <= CURVED * np.maximum(sizes, np.abs(p).max())).any())


def _holding(boxes: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which boxes [n, 2, 3] hold a point, and the slack [n] that they have for it."""
    slack = CURVED * np.maximum(_sizes(boxes), np.abs(p).max())
    low, high = boxes[:, 0] - slack[:, None], boxes[:, 1] + slack[:, None]
    return ((p >= low) & (p <= high)).all(axis=1), slack


def _on_quadrics(table: QuadricTable, boxes: np.ndarray, p: np.ndarray) -> bool:
    near, slack = _holding(boxes, p)
    kind, vector = KINDS[table.kind], drjit.scalar.Array3f64
    for k in np.flatnonzero(near)[:MOST_LOOKED_AT]:
        origin, x, y, z = (vector(row.tolist()) for row in (table.origins[k], *table.rows[k]))
        frame = Frame(origin, x, y, z)
        feet = np.array([kind.surface(vector(p.tolist()), part, frame).p for part in kind.parts])
        # A part goes on beyond the object, but not within its box, or nearly so
        there = [_holding(boxes[k : k + 1], foot)[0][0] for foot in feet]
        if (there & (np.linalg.norm(feet - p, axis=1) <= slack[k])).any():
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
