"""Polygons cut into triangles, also where they are not convex."""

from __future__ import annotations

import numpy as np

MAX_EAR_CORNERS = 1000  # maximum corners for ear clipping, whose time is quadratic
AREA_TOLERANCE = 1e-6  # fraction of a polygon's area: triangles turned over by less are rounding errors
_PLANES = ((1, 2), (2, 0), (0, 1))  # coordinates to project to, by axis


def triangulate(polygons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons [F, corners, 3] into triangles: corners [F, corners - 2, 3], and which ones failed [F].

    A fan around the first corner if none of its triangles is turned over, or else by cutting off ears. A
    polygon that crosses itself fails, and some of its triangles overlap or are missing.
    """
    number, count, _ = polygons.shape
    second = np.arange(1, count - 1)
    fan = np.stack([0 * second, second, second + 1], axis=1)  # [triangles, 3]
    cut = np.broadcast_to(fan, (number, *fan.shape)).copy()
    failed = np.zeros(number, bool)
    if count == 3:
        return cut, failed
    points = polygons - polygons[:, :1].astype(np.float64)
    normals = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)  # of twice the area
    areas = np.einsum("fti,fi->ft", np.cross(points[:, 1:-1], points[:, 2:]), normals)  # of the fan, twice
    turned = (areas < -AREA_TOLERANCE * (normals**2).sum(axis=1, keepdims=True)).any(axis=1)
    for row in np.flatnonzero(turned):
        axis = np.abs(normals[row]).argmax()
        plane = _PLANES[axis] if normals[row, axis] > 0 else _PLANES[axis][::-1]
        ears = _ears(points[row][:, plane]) if count <= MAX_EAR_CORNERS else None
        failed[row] = ears is None
        if ears is not None:
            cut[row] = ears
    return cut, failed


def _ears(points: np.ndarray) -> list[tuple[int, int, int]] | None:
    """Cut a polygon [corners, 2], counter-clockwise, into triangles; None if it crosses itself.

    An ear is a triangle of neighbours that holds no other corner.
    """
    around = list(range(len(points)))
    ears = []
    at = 0
    passed = 0  # corners since the last ear
    while len(around) > 3:
        if passed == len(around):
            return None
        ear = around[at - 1], around[at], around[(at + 1) % len(around)]
        if _is_ear(points[[*ear]], points[around]):
            ears.append(ear)
            del around[at]
            at -= 1  # its neighbour may have become one
            passed = 0
        else:
            at += 1
            passed += 1
        at %= len(around)
    last = around[0], around[1], around[2]
    return [*ears, last] if _is_ear(points[[*last]], points[around]) else None


def _is_ear(triangle: np.ndarray, corners: np.ndarray) -> bool:
    """True if a triangle [3, 2] is not turned over and holds no corner but those at its own places."""
    sides = np.roll(triangle, -1, axis=0) - triangle
    if _cross(sides[0], sides[1]) < 0:
        return False
    inside = (_cross(sides, corners[:, None] - triangle) >= 0).all(axis=1)
    own = (corners[inside, None] == triangle).all(axis=2).any(axis=1)
    return bool(own.all())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
