"""Which objects are seen from a light: lists of them for the cells of a cube around it.

A ray to the light looks up the cell that it comes through and tests the objects listed there, one or
two of hundreds, in place of a walk down a tree. Each list begins with the object nearest to the point, and a
ray leaves it where all others are beyond its end, or behind its hit. The lists are conservative: objects are
taken for wider by what float32 loses; what a ray meets is for the test of each to say.
Source: Haines and Greenberg, "The Light Buffer: A Shadow-Testing Accelerator", IEEE Computer Graphics and
Applications 6(9), 1986.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .lookup import aligned

# With more cells, or more objects in all of them, lists would take more memory and time than they save
MOST_CELLS, MOST_LISTED = 2**21, 2**22

# Directions in float32 are off by less, in radians; so are places in cells
_OFF_ANGLE, _OFF_CELL = 2e-6, 1e-3

# Rays from a point miss it in float32 by less than this share of the coordinates
_OFF_PLACE = 2.0**-21

# A ray to a light may be taken for shorter than it is by less than this share
_SHORT = 2.0**-9


class PointBuffer:
    """Lists of objects for each of some points, in ``size`` x ``size`` cells of each face of its cube.

    The cells of a face divide what the objects take up of it.
    """

    def __init__(self, places: np.ndarray, faces: list[_Face], extent: float, size: int) -> None:
        points = len(places)
        # Data: one kernel serves all places and sizes
        self.size = dr.opaque(mi.UInt32, size)
        self.places = aligned(np.column_stack([places, np.full(points, _OFF_PLACE * extent)]))
        columns = zip(*(f.listed(size) for f in faces), strict=True)
        cell, objects, near = (np.concatenate(column) for column in columns)
        order = np.lexsort((near, cell))
        counts = np.bincount(cell, minlength=6 * points * size**2)
        ends = np.cumsum(counts + (counts > 0))  # of each list, after what ends it: an object at infinity
        self.starts = aligned(np.where(counts > 0, ends - counts - 1, ends[-1]), np.uint32)
        lists = np.full((ends[-1] + 1, 2), np.inf, np.float32)
        listed = np.ones(len(lists), bool)
        listed[ends[counts > 0] - 1] = listed[-1] = False
        lists[listed, 0] = near[order]
        lists.view(np.uint32)[listed, 1] = objects[order]
        self.lists = aligned(lists)
        windows = [np.concatenate([f.low, f.scale(size)], axis=1) for f in faces]
        self.faces = aligned(np.stack(windows, axis=1))
        dr.eval(self.places, self.starts, self.lists, self.faces)

    def any(self, light: Any, to_light: Any, active: Any, test: Callable[[Any], Any]) -> Any:
        """Return whether ``test(object)`` holds of an object listed where a ray comes to ``light`` from."""
        first, depth = self._look(light, -to_light)
        end = depth(-to_light) * (1 + _SHORT)
        return self._walk(
            first, lambda near, blocked: active & (near < end) & ~blocked,
            lambda thing, blocked: test(thing), mi.Bool(False),
        )  # fmt: skip

    def _look(self, point: Any, d: Any) -> tuple[Any, Callable[[Any], Any]]:
        """Return where the list for a direction from a point begins, and what gives the depth of vectors:
        their part along the axis of the face."""
        far = dr.abs(d)
        on_x = (far.x >= far.y) & (far.x >= far.z)
        on_y = ~on_x & (far.y >= far.z)

        def along(v: Any) -> Any:
            return dr.select(on_x, v.x, dr.select(on_y, v.y, v.z))

        backwards, inverse = along(d) < 0, 1 / along(far)
        face = dr.select(on_x, mi.UInt32(0), dr.select(on_y, mi.UInt32(2), 4)) + dr.select(
            backwards, mi.UInt32(1), 0
        )
        face += 6 * point
        low_u, low_v, scale_u, scale_v = dr.gather(mi.Vector4f, self.faces, face)
        row = self._cell((dr.select(on_x | on_y, d.z, d.y) * inverse - low_v) * scale_v)
        column = self._cell((dr.select(on_x, d.y, d.x) * inverse - low_u) * scale_u)
        first = dr.gather(mi.UInt32, self.starts, (face * self.size + row) * self.size + column)
        return first, lambda v: dr.select(backwards, -along(v), along(v))

    def _cell(self, x: Any) -> Any:
        return mi.UInt32(dr.clip(mi.Int32(x), 0, mi.Int32(self.size) - 1))

    def _walk(self, first: Any, goes_on: Callable, visit: Callable, state: Any) -> Any:
        """Return what ``visit(object, state)`` makes of a state, object by object, while ``goes_on(near,
        state)`` with the depth at which the next begins, or infinity."""

        def entry(k: Any) -> tuple[Any, Any]:
            near, thing = dr.gather(mi.Vector2f, self.lists, k)
            return near, dr.reinterpret_array(mi.UInt32, thing)

        return dr.while_loop(
            (first, *entry(first), state),
            lambda k, near, thing, state: goes_on(near, state),
            lambda k, near, thing, state: (k + 1, *entry(k + 1), visit(thing, state)),
            label="point buffer",
        )[3]


def point_buffer(places: np.ndarray, hulls: np.ndarray, numbers: np.ndarray) -> PointBuffer | None:
    """Return lists for points at ``places`` [m, 3] of objects, by their ``numbers`` [n].

    ``hulls`` [n, ends, 3, 4]: each object is within the convex hull of ellipsoids, one or two, of three
    semi-axes and a centre, as columns. Returns None where the lists would be too long.
    """
    points, count, least = len(places), len(hulls), 2
    if 6 * points * least**2 > MOST_CELLS:
        return None
    extent = float(max(np.abs(places).max(), np.abs(hulls).sum(axis=3).max()))
    faces = _faces(places, hulls, numbers, extent)
    size = 2 ** int(np.ceil(np.log2(2 * np.sqrt(count))))
    while size >= least:
        listed = sum(int(f.areas(size).sum()) for f in faces)
        if 6 * points * size**2 <= MOST_CELLS and listed <= MOST_LISTED:
            return PointBuffer(places, faces, extent, size)
        size //= 2
    return None


@dataclass
class _Face:
    """What objects take up of one face of the cubes around all points, along its two axes."""

    side: int
    point: np.ndarray  # [k], of pairs of a point and an object seen through the face
    thing: np.ndarray  # [k]
    near: np.ndarray  # [k], depth: where the object begins
    first: np.ndarray  # [k, 2], tangents: where it begins and ends
    last: np.ndarray
    low: np.ndarray  # [points, 2]: where all objects of a point begin, and over what they extend
    extent: np.ndarray

    def scale(self, size: int) -> np.ndarray:
        """Return cells per tangent; 0 where there is nothing."""
        return np.divide(size, self.extent, out=np.zeros_like(self.extent), where=self.extent > 0)

    def _cells(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        low, scale = self.low[self.point], self.scale(size)[self.point]
        first = np.floor((self.first - low) * scale - _OFF_CELL)
        last = np.floor((self.last - low) * scale + _OFF_CELL)
        return tuple(np.clip(cells, 0, size - 1).astype(np.int64) for cells in (first, last))

    def areas(self, size: int) -> np.ndarray:
        """Return how many cells each object takes up."""
        first, last = self._cells(size)
        return (last - first + 1).prod(axis=1)

    def listed(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cells, objects in them, and the depths where these begin."""
        first, last = self._cells(size)
        width, areas = last[:, 0] - first[:, 0] + 1, self.areas(size)
        pair = np.repeat(np.arange(len(areas)), areas)
        within = np.arange(len(pair)) - np.repeat(np.cumsum(areas) - areas, areas)
        row, column = first[pair, 1] + within // width[pair], first[pair, 0] + within % width[pair]
        cell = ((6 * self.point[pair] + self.side) * size + row) * size + column
        return cell, self.thing[pair], self.near[pair]


def _faces(places: np.ndarray, hulls: np.ndarray, numbers: np.ndarray, extent: float) -> list[_Face]:
    """Return what is seen through each face: of x, y and z, first forwards, then backwards."""
    centers, width = hulls[..., 3], np.linalg.norm(hulls[..., :3], axis=(2, 3))  # [n, ends, 3], [n, ends]
    middle = centers.mean(axis=1)
    reach = (np.linalg.norm(centers - middle[:, None], axis=2) + width).max(axis=1)
    # The test of spheres in float32 also finds what passes by, the farther a ray starts, and is to be obeyed
    radius = width.max(axis=1) / np.sqrt(3)
    farthest = np.linalg.norm(middle - places[:, None], axis=2) + np.ptp(middle, axis=0).max()
    slack = np.sqrt(np.minimum(radius**2 + 2.0**-20 * farthest**2, 3 * radius**2)) - radius
    slack += 2 * _OFF_PLACE * extent
    return [_face(places, hulls, numbers, side, middle, reach + slack, slack) for side in range(6)]


def _face(
    places: np.ndarray, hulls: np.ndarray, numbers: np.ndarray, side: int,
    middle: np.ndarray, reach: np.ndarray, slack: np.ndarray,
) -> _Face:  # fmt: skip
    axis, backwards = divmod(side, 2)
    sign, across = -1 if backwards else 1, [a for a in range(3) if a != axis]
    c = middle - places[:, None]  # [points, n, 3]
    # A ball around the object meets the wedges between the face's sides
    beside = np.abs(c[..., across]) - sign * c[..., axis, None]
    point, thing = np.nonzero((beside <= np.sqrt(2) * reach[..., None]).all(axis=2))
    slack = slack[point, thing, None]
    intervals = []
    for a in across:
        rows = hulls[thing][:, :, [axis, a]]  # [pairs, ends, 2, 4]
        rows[..., 3] -= places[point][:, None, [axis, a]]
        rows[:, :, 0] *= sign
        square = _widened(rows[..., :3] @ rows[..., :3].swapaxes(2, 3), slack)
        intervals.append(_interval(rows[..., 3], square))
        near = (rows[..., 0, 3] - np.sqrt(square[..., 0, 0])).min(axis=1)
    first, last = np.stack(intervals, axis=2)
    edge = np.pi / 4  # a face spans as much to either side
    seen = ((first < edge) & (last > -edge)).all(axis=1)
    point, thing, near = point[seen], thing[seen], np.maximum(near[seen], 0) * (1 - 2.0**-18)
    first, last = (np.tan(np.clip(ends[seen], -edge, edge)) for ends in (first, last))
    low, high = np.full((len(places), 2), np.inf), np.full((len(places), 2), -np.inf)
    np.minimum.at(low, point, first)
    np.maximum.at(high, point, last)
    low, high = (np.where(low <= high, ends, 0).astype(np.float32).astype(float) for ends in (low, high))
    return _Face(side, point, numbers[thing], near, first, last, low, high - low)


def _widened(square: np.ndarray, slack: np.ndarray) -> np.ndarray:
    """Return the matrices [..., 2, 2] of ellipses that hold what is within ``slack`` of those of ``square``.

    An ellipse of matrix S reaches as far as √(nᵀS n) along n, and (a + b)² ≤ (1 + b/w) a² + (1 + w/b) b².
    """
    width = np.sqrt(np.trace(square, axis1=2, axis2=3))
    ratio = np.divide(slack, width, out=np.zeros_like(width), where=width > 0)[..., None, None]
    return square * (1 + ratio) + np.eye(2) * (slack * (slack + width))[..., None, None]


def _interval(c: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles [n] between which the hulls of ellipses, around ``c`` [n, ends, 2], are seen from 0.

    A line through 0 with normal n touches an ellipse of matrix S if nᵀ(c cᵀ − S)n = 0; these are as far to
    either side of the eigenvector of the larger eigenvalue.
    """
    m = c[..., None] * c[..., None, :] - square
    difference, off = m[..., 0, 0] - m[..., 1, 1], 2 * m[..., 0, 1]
    larger = 0.5 * (m[..., 0, 0] + m[..., 1, 1] + np.hypot(difference, off))
    # −det(c cᵀ − S), without what cancels
    adjugate = np.stack([square[..., 1, 1], square[..., 0, 0]], axis=-1)
    outside = (adjugate * c**2).sum(axis=-1) - 2 * square[..., 0, 1] * c.prod(axis=-1) - np.linalg.det(square)
    half = np.arctan2(np.sqrt(np.maximum(outside, 0)), larger) + _OFF_ANGLE
    size = (c**2).sum(axis=-1) + np.trace(square, axis1=2, axis2=3)
    half = np.where((outside >= 0) & (larger > 1e-9 * size), half, np.pi)
    middle = 0.5 * np.arctan2(off, difference)
    behind = c[..., 0] * np.cos(middle) + c[..., 1] * np.sin(middle) < 0
    middle += np.where(behind, np.where(middle > 0, -np.pi, np.pi), 0)
    first, last = (middle - half).min(axis=1), (middle + half).max(axis=1)
    around = last - first >= np.pi  # 0 may be inside
    return np.where(around, -np.pi, first), np.where(around, np.pi, last)
