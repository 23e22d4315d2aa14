"""Light buffers (Haines and Greenberg 1986): cube maps of the objects seen from a light or the camera.

A ray to or from the point looks up the cell that it comes through and tests the objects listed there, one or
two of hundreds, in place of a walk down a tree. Each list begins with the object nearest to the point, and a
ray leaves it where all others are beyond its end, or behind its hit. The lists are conservative: objects
count as wider by the errors of float32, and the test of each decides whether a ray meets it.
Source: Haines and Greenberg, "The Light Buffer: A Shadow-Testing Accelerator", IEEE Computer Graphics and
Applications 6(9), 1986.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from .tables import aligned

# With more cells, or more objects in all of them, lists would take more memory and time than they save
MAX_CELLS = 2**21
MAX_ENTRIES = 2**22

# Tangents of directions in float32 are off by less; so are places in cells
_TANGENT_MARGIN = 4e-6
_CELL_MARGIN = 1e-3

# Rays from a point miss it in float32 by less than this share of the coordinates
_POSITION_MARGIN = 2.0**-21

# A ray to a light may be taken for shorter than it is by less than this share
_LENGTH_MARGIN = 2.0**-9


class PointBuffer:
    """Lists of objects for each of some points, in ``size`` x ``size`` cells of each face of its cube.

    The points lie at ``places`` [m, 3]; the objects, by their ``numbers`` [n], in ``boxes`` [n, 2, 3] or,
    with ``balls``, in the balls inside these. The cells of a face divide the part of it that they cover.
    """

    def __init__(
        self, places: np.ndarray, boxes: np.ndarray, numbers: np.ndarray, balls: bool = False
    ) -> None:
        faces = 6 * len(places)
        size = 2 ** int(np.ceil(np.log2(2 * np.sqrt(len(boxes)))))
        extent = float(max(np.abs(places).max(), np.abs(boxes).max()))
        # In float32 the test of a sphere also finds rays that pass close by, the more so the farther away
        # they start; its answer counts, so the lists hold these as well
        middle = boxes.mean(axis=1)
        radius = 0.5 * np.diff(boxes, axis=1)[:, 0].min(axis=1)
        farthest = np.linalg.norm(middle - places[:, None], axis=2) + np.ptp(middle, axis=0).max()
        slack = np.sqrt(np.minimum(radius**2 + 2.0**-20 * farthest**2, 3 * radius**2)) - radius
        slack = (slack + 2 * _POSITION_MARGIN * extent)[..., None]
        low = boxes[:, 0] - places[:, None] - slack
        high = boxes[:, 1] - places[:, None] + slack
        columns = zip(*(_seen(low, high, side, balls) for side in range(6)), strict=True)
        face, thing, near, first, last = (np.concatenate(column) for column in columns)
        start = np.full((faces, 2), np.inf)
        end = -start
        np.minimum.at(start, face, first)
        np.maximum.at(end, face, last)
        start, end = (np.where(start <= end, x, 0).astype(np.float32).astype(float) for x in (start, end))
        while True:
            scale = np.divide(size, end - start, out=np.zeros_like(start), where=end > start)
            least = (first - start[face]) * scale[face] - _CELL_MARGIN
            most = (last - start[face]) * scale[face] + _CELL_MARGIN
            least, most = np.clip(np.floor([least, most]), 0, size - 1).astype(np.int64)
            width = most - least + 1
            areas = width.prod(axis=1)
            if size == 2 or (faces * size**2 <= MAX_CELLS and areas.sum() <= MAX_ENTRIES):
                break
            size //= 2
        pair = np.repeat(np.arange(len(areas)), areas)
        before = np.cumsum(areas) - areas
        row, column = np.divmod(np.arange(len(pair)) - before[pair], width[pair, 0])
        column += least[pair, 0]
        row += face[pair] * size + least[pair, 1]
        cell = row * size + column
        order = np.lexsort((near[pair], cell))
        counts = np.bincount(cell, minlength=faces * size**2)
        ends = np.cumsum(counts + (counts > 0))  # ends of the lists; each closes with an object at infinity
        lists = np.full((ends[-1] + 1, 2), np.inf, np.float32)
        listed = np.ones(len(lists), bool)
        listed[ends[counts > 0] - 1] = listed[-1] = False
        lists[listed, 0] = near[pair][order]
        lists.view(np.uint32)[listed, 1] = numbers[thing[pair]][order]
        self.lists = aligned(lists)
        self.faces = aligned(np.concatenate([start, scale], axis=1))
        starts = np.where(counts > 0, ends - counts - 1, ends[-1])
        self.starts = aligned(starts, np.uint32)
        self.size = dr.opaque(mi.UInt32, size)  # data: one kernel serves all places and sizes
        self.place = dr.opaque(mi.Point3f, places[0].tolist())
        self.off = dr.opaque(mi.Float, _POSITION_MARGIN * extent)
        dr.eval(self.starts, self.lists, self.faces)

    def any(
        self,
        light: mi.UInt32,
        to_light: mi.Vector3f,
        active: mi.Bool,
        test: Callable[[mi.UInt32], mi.Bool],
    ) -> mi.Bool:
        """True if ``test(object)`` holds of an object listed where a ray comes to ``light`` from."""

        def visit(thing: mi.UInt32, state: tuple) -> tuple:
            return (dr.select(test(thing), -1, state[0]),)

        reach = mi.Float(1 + _LENGTH_MARGIN)
        (reach,) = self._walk(light, mi.Vector3f(0), -to_light, active, visit, (reach,))
        return reach < 0

    def nearest(self, ray: mi.Ray3f, active: mi.Bool, visit: Callable, state: tuple) -> tuple[tuple, mi.Bool]:
        """Call ``visit(object, state)`` as a tree does for rays that come from the first point, wherever they
        start; return the last state, and which rays these are.
        """
        o = ray.o - self.place
        off = dr.norm(dr.cross(o, ray.d)) > self.off * dr.norm(ray.d)
        active = active & ~off & (dr.dot(o, ray.d) >= 0)
        return self._walk(mi.UInt32(0), o, ray.d, active, visit, state), active

    def _walk(
        self,
        point: mi.UInt32,
        o: mi.Vector3f,
        d: mi.Vector3f,
        active: mi.Bool,
        visit: Callable,
        state: tuple,
    ) -> tuple:
        """Visit the objects listed where a ray goes from a point, until all others are beyond its reach: the
        first of ``state``, in lengths of ``d`` from ``o``, which is relative to the point.
        """
        far = dr.abs(d)
        on_x = (far.x >= far.y) & (far.x >= far.z)
        on_y = ~on_x & (far.y >= far.z)

        def along(v: mi.Vector3f) -> mi.Float:
            return dr.select(on_x, v.x, dr.select(on_y, v.y, v.z))

        depth = along(far)
        start = dr.abs(along(o))
        inverse = 1 / depth
        face = dr.select(on_x, mi.UInt32(0), dr.select(on_y, mi.UInt32(2), 4))
        face += dr.select(along(d) < 0, mi.UInt32(1), 0) + 6 * point
        low_u, low_v, scale_u, scale_v = dr.gather(mi.Vector4f, self.faces, face)

        def cell(across: mi.Float, low: mi.Float, scale: mi.Float) -> mi.UInt32:
            number = mi.Int32((across * inverse - low) * scale)
            return mi.UInt32(dr.clip(number, 0, mi.Int32(self.size) - 1))

        def entry(k: mi.UInt32) -> tuple[mi.Float, mi.UInt32]:
            """Return the depth at which an object of the lists begins, or infinity, and the object."""
            near, thing = dr.gather(mi.Vector2f, self.lists, k)
            return near, dr.reinterpret_array(mi.UInt32, thing)

        def goes_on(k: mi.UInt32, near: mi.Float, thing: mi.UInt32, state: tuple) -> mi.Bool:
            return active & (near < dr.fma(state[0], depth, start))

        def to_next(k: mi.UInt32, near: mi.Float, thing: mi.UInt32, state: tuple) -> tuple:
            return k + 1, *entry(k + 1), visit(thing, state)

        row = cell(dr.select(on_x | on_y, d.z, d.y), low_v, scale_v)
        column = cell(dr.select(on_x, d.y, d.x), low_u, scale_u)
        number = (face * self.size + row) * self.size + column
        first = dr.gather(mi.UInt32, self.starts, number)
        begin = first, *entry(first), state
        *_, state = dr.while_loop(begin, goes_on, to_next, label="point buffer")
        return state


def _seen(low: np.ndarray, high: np.ndarray, side: int, balls: bool) -> tuple[np.ndarray, ...]:
    """Return pairs of a point and a box or ball that it sees through a face of its cube: the numbers of face
    and box, the depth where the box begins, and the tangents between which it is seen.

    Sides: those towards x, y and z, each forwards, then backwards. The corners of the boxes are ``low`` and
    ``high`` [points, n, 3] relative to each point.
    """
    axis, backwards = divmod(side, 2)
    across = [a for a in range(3) if a != axis]
    near, far = (-high, -low) if backwards else (low, high)
    near = near[..., axis, None]
    far = far[..., axis, None]
    low = low[..., across]
    high = high[..., across]
    z = (near + far) / 2
    radius = (far - near) / 2
    along = (low + high) / 2
    near = np.maximum(near, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        first = low / np.where(low < 0, near, far)
        last = high / np.where(high > 0, near, far)
        if balls:  # between the lines that touch them
            square = np.where(z > 1.001 * radius, z**2 - radius**2, np.nan)
            root = radius * np.sqrt(square + along**2)
            first = np.fmax(first, (along * z - root) / square)
            last = np.fmin(last, (along * z + root) / square)
    first -= _TANGENT_MARGIN
    last += _TANGENT_MARGIN
    seen = (far[..., 0] > 0) & ((first < 1) & (last > -1)).all(axis=2)
    point, thing = np.nonzero(seen)
    depth = near[seen][:, 0] * (1 - 2.0**-18)
    first = np.clip(first[seen], -1, 1)
    last = np.clip(last[seen], -1, 1)
    return 6 * point + side, thing, depth, first, last
