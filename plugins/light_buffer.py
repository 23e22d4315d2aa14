"""Which objects may be in the way of a point light: lists of them for the cells of a cube around it.

A shadow ray looks up the cell that it comes through and tests the objects listed there, one or two of
hundreds, in place of a walk down a tree. The lists are conservative: each object is taken for a ball that
is wider by what float32 loses; what is in the way is for the test of each to say.
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


class LightBuffer:
    """Lists of objects for each light, in ``size`` x ``size`` cells of each face of its cube.

    The cells of a face divide what the objects take up of it.
    """

    def __init__(self, faces: list[_Face], lights: int, size: int) -> None:
        self.size = dr.opaque(mi.UInt32, size)  # data: one kernel serves all sizes
        cell, objects = (
            np.concatenate(column) for column in zip(*(f.listed(size) for f in faces), strict=True)
        )
        order = np.argsort(cell, kind="stable")
        ends = np.cumsum(np.bincount(cell, minlength=6 * lights * size**2))
        self.objects = mi.UInt32(objects[order].astype(np.uint32))
        self.ranges = aligned(np.stack([np.append(0, ends[:-1]), ends], axis=1), np.uint32)
        windows = [np.concatenate([f.low, f.scale(size)], axis=1) for f in faces]
        self.faces = aligned(np.stack(windows, axis=1))
        dr.eval(self.objects, self.ranges, self.faces)

    def any(self, light: Any, to_light: Any, active: Any, test: Callable[[Any], Any]) -> Any:
        """Return whether ``test(object)`` holds of an object listed where a ray comes to ``light`` from."""
        d, far = -to_light, dr.abs(to_light)
        on_x = (far.x >= far.y) & (far.x >= far.z)
        on_y = ~on_x & (far.y >= far.z)
        depth = dr.select(on_x, d.x, dr.select(on_y, d.y, d.z))
        inverse = 1 / dr.abs(depth)
        face = dr.select(on_x, mi.UInt32(0), dr.select(on_y, mi.UInt32(2), 4)) + dr.select(
            depth < 0, mi.UInt32(1), 0
        )
        face += 6 * light
        low_u, low_v, scale_u, scale_v = dr.gather(mi.Vector4f, self.faces, face)
        row = self._cell((dr.select(on_x | on_y, d.z, d.y) * inverse - low_v) * scale_v)
        column = self._cell((dr.select(on_x, d.y, d.x) * inverse - low_u) * scale_u)
        first, end = dr.gather(mi.Vector2u, self.ranges, (face * self.size + row) * self.size + column)
        return dr.while_loop(
            (first, mi.Bool(False)),
            lambda k, blocked: active & (k < end) & ~blocked,
            lambda k, blocked: (k + 1, test(dr.gather(mi.UInt32, self.objects, k))),
            label="light buffer",
        )[1]

    def _cell(self, x: Any) -> Any:
        return mi.UInt32(dr.clip(mi.Int32(x), 0, mi.Int32(self.size) - 1))


def light_buffer(places: np.ndarray, balls: np.ndarray) -> LightBuffer | None:
    """Return lists for lights at ``places`` [m, 3] of what is within ``balls`` [n, 4] (centre, radius).

    None where they would be too long.
    """
    lights, count, least = len(places), len(balls), 2
    if 6 * lights * least**2 > MOST_CELLS:
        return None
    faces = [_face(places, balls, side) for side in range(6)]
    size = 2 ** int(np.ceil(np.log2(4 * np.sqrt(count))))
    while size >= least:
        listed = sum(int(f.areas(size).sum()) for f in faces)
        if 6 * lights * size**2 <= MOST_CELLS and listed <= MOST_LISTED:
            return LightBuffer(faces, lights, size)
        size //= 2
    return None


@dataclass
class _Face:
    """What objects take up of one face of the cubes around all lights, along its two axes."""

    side: int
    light: np.ndarray  # [k], of pairs of a light and an object seen through the face
    thing: np.ndarray  # [k]
    first: np.ndarray  # [k, 2], tangents: where the object begins and ends
    last: np.ndarray
    low: np.ndarray  # [lights, 2]: where all objects of a light begin, and over what they extend
    extent: np.ndarray

    def scale(self, size: int) -> np.ndarray:
        """Return cells per tangent; 0 where there is nothing."""
        return np.divide(size, self.extent, out=np.zeros_like(self.extent), where=self.extent > 0)

    def _cells(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        low, scale = self.low[self.light], self.scale(size)[self.light]
        first = np.floor((self.first - low) * scale - _OFF_CELL)
        last = np.floor((self.last - low) * scale + _OFF_CELL)
        return tuple(np.clip(cells, 0, size - 1).astype(np.int64) for cells in (first, last))

    def areas(self, size: int) -> np.ndarray:
        """Return how many cells each object takes up."""
        first, last = self._cells(size)
        return (last - first + 1).prod(axis=1)

    def listed(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of a cell and an object in it."""
        first, last = self._cells(size)
        width, areas = last[:, 0] - first[:, 0] + 1, self.areas(size)
        pair = np.repeat(np.arange(len(areas)), areas)
        within = np.arange(len(pair)) - np.repeat(np.cumsum(areas) - areas, areas)
        row, column = first[pair, 1] + within // width[pair], first[pair, 0] + within % width[pair]
        return ((6 * self.light[pair] + self.side) * size + row) * size + column, self.thing[pair]


def _face(places: np.ndarray, balls: np.ndarray, side: int) -> _Face:
    """Return what is seen through face ``side``: of x, y and z, each first forwards, then backwards."""
    axis, backwards = divmod(side, 2)
    c = balls[None, :, :3] - places[:, None]
    # The test of spheres in float32 also finds what passes by, the farther a ray starts, and is to be obeyed
    reach = np.linalg.norm(c, axis=2) + np.ptp(balls[:, :3], axis=0).max()
    squared = balls[:, 3] ** 2 + 2.0**-20 * reach**2
    radius = np.sqrt(np.minimum(squared, 3 * balls[:, 3] ** 2)) + 2.0**-20 * np.abs(balls).max()
    depth = -c[..., axis] if backwards else c[..., axis]
    first, last = np.empty((2, *depth.shape, 2))
    for k, across in enumerate([a for a in range(3) if a != axis]):
        distance = np.hypot(depth, c[..., across])
        half = np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1)) + _OFF_ANGLE
        half[radius >= distance] = np.pi
        angle = np.arctan2(c[..., across], depth)
        first[..., k], last[..., k] = angle - half, angle + half
    edge = np.pi / 4  # a face spans as much to either side
    light, thing = np.nonzero(((first < edge) & (last > -edge)).all(axis=2))
    first, last = (np.tan(np.clip(ends[light, thing], -edge, edge)) for ends in (first, last))
    low, high = np.full((len(places), 2), np.inf), np.full((len(places), 2), -np.inf)
    np.minimum.at(low, light, first)
    np.maximum.at(high, light, last)
    low, high = (np.where(low <= high, ends, 0).astype(np.float32).astype(float) for ends in (low, high))
    return _Face(side, light, thing, first, last, low, high - low)
