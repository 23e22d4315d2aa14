"""A tree of boxes over many small objects, built with numpy and walked in Dr.Jit.

The tree is a complete binary one in heap order: node 1 is the root, 2 i and 2 i + 1 are the children of i,
the last level holds one object or nothing in each leaf; nodes are split at the median of their longest side.
So a walk needs no links, and instead of a stack one bit for each level: does a child wait there whose sibling
came first? A node holds the boxes of both children, so that one look decides where to go.

Why not Mitsuba's tree, with something around each object that it can hold? It finds one thing at a time, so a
ray that starts at an object, or passes near one, queries it two or three times, and 10⁵ objects take half as
long again to load. The shape ``ellipsoids`` computes in float32 with an error that grows with the square of
the distance in sizes of the object: from hundreds of sizes away, rays are lost.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..intersect import off_zero
from .tables import aligned

# Box tests are wider than exact by some float32 roundings, relative to distances and to coordinates
_BOX_MARGIN = 8 * 2.0**-24

# Directions nearer to an axis plane than this count as so much off it
_MIN_SLOPE = 1e-18


class Tree:
    """Boxes [n, 2, 3] (lower and upper corner) in a tree; ``leaf_of`` [n] is where each object is, from 0."""

    def __init__(self, boxes: np.ndarray) -> None:
        count = len(boxes)
        depth = max(count - 1, 1).bit_length()  # the root has two children, if of nothing
        self.leaves = 1 << depth
        self.leaf_of = np.empty(count, np.int64)
        order = _sort(boxes.mean(axis=1), depth)
        self.leaf_of[order] = np.arange(count) * self.leaves // count
        self.boxes = aligned(_heap(boxes, self.leaf_of, self.leaves))
        self.first_leaf = dr.opaque(mi.UInt32, self.leaves)  # data: one kernel serves all trees

    def walk(
        self,
        ray: mi.Ray3f,
        active: mi.Bool,
        visit: Callable[[mi.UInt32, tuple], tuple],
        state: tuple,
        *,
        any_hit: bool = False,
    ) -> tuple:
        """Call ``visit(leaf, state)`` at each leaf whose box a ray meets; return the last state.

        The first of ``state`` is the reach of the ray; ``visit`` returns a new state, with the distance of a
        hit there if that is less. With ``any_hit``, a ray is done as soon as that has happened.
        """
        # Distance to a plane across an axis: plane * inverse + shift
        inverse = [1 / off_zero(c, _MIN_SLOPE) for c in ray.d]
        shift = [-c * i for c, i in zip(ray.o, inverse, strict=True)]
        rows = [mi.UInt32(2 * axis) + dr.select(ray.d[axis] < 0, mi.UInt32(1), 0) for axis in range(3)]
        reach = state[0]

        def down(node: mi.UInt32, waiting: mi.UInt32, reach: mi.Float) -> tuple:
            near, far = self._children(node, inverse, shift, rows)
            meets = [(n <= f) & (n <= reach) for n, f in zip(near, far, strict=True)]
            second_first = meets[1] & (~meets[0] | (near[1] < near[0]))
            child = (node << 1) | dr.select(second_first, mi.UInt32(1), 0)
            waiting_below = (waiting << 1) | dr.select(meets[0] & meets[1], mi.UInt32(1), 0)
            next_node, next_waiting = _to_next(node, waiting)
            deeper = meets[0] | meets[1]
            node = dr.select(deeper, child, next_node)
            waiting = dr.select(deeper, waiting_below, next_waiting)
            return node, waiting, reach

        def above_leaves(node: mi.UInt32, *_: object) -> mi.Bool:
            return (node != 0) & (node < self.first_leaf)

        def pass_by(leaf: mi.UInt32, state: tuple) -> tuple:
            return state

        def to_next_leaf(node: mi.UInt32, waiting: mi.UInt32, state: tuple) -> tuple:
            # All rays of a packet go on to a leaf each before any is looked into: that costs ten times a box
            start = node, waiting, state[0]
            node, waiting, _ = dr.while_loop(start, above_leaves, down, label="boxes")
            leaf = node - self.first_leaf
            state = dr.if_stmt((leaf, state), node != 0, visit, pass_by, label="leaf")
            return *_to_next(node, waiting), state

        def goes_on(node: mi.UInt32, waiting: mi.UInt32, state: tuple) -> mi.Bool:
            going = node != 0
            return going & (state[0] >= reach) if any_hit else going

        known = active & ~dr.any(dr.isnan(mi.Vector3f(shift)))  # NaN would go everywhere
        start = dr.select(known, mi.UInt32(1), 0), mi.UInt32(0), state
        return dr.while_loop(start, goes_on, to_next_leaf, label="tree")[2]

    def _children(self, node: mi.UInt32, inverse: list, shift: list, rows: list) -> tuple[list, list]:
        """Return the distances at which a ray enters and leaves the boxes of both children."""
        near = [mi.Float(0), mi.Float(0)]
        far = [mi.Float(dr.inf), mi.Float(dr.inf)]
        for axis in range(3):
            first0, first1, last0, last1 = dr.gather(mi.Vector4f, self.boxes, 6 * node + rows[axis])
            for child, (first, last) in enumerate(((first0, last0), (first1, last1))):
                enter = dr.fma(first, inverse[axis], shift[axis])
                leave = dr.fma(last, inverse[axis], shift[axis])
                # One instruction each, where dr.maximum and dr.minimum take more to pass on NaN
                near[child] = dr.select(enter > near[child], enter, near[child])
                far[child] = dr.select(leave < far[child], leave, far[child])
        return near, [f * (1 + _BOX_MARGIN) for f in far]


def _to_next(node: mi.UInt32, waiting: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Return the next child that waits, and the bits of those that wait after it; node 0 if none does."""
    levels = dr.tzcnt(waiting)
    done = waiting == 0
    node = dr.select(done, 0, (node >> levels) ^ 1)
    waiting = dr.select(done, 0, (waiting >> levels) ^ 1)
    return node, waiting


def _sort(centers: np.ndarray, depth: int) -> np.ndarray:
    """Return the objects in the order of the leaves: segments of them, halved along their longest side."""
    order = np.arange(len(centers))
    for level in range(depth):
        segment = (np.arange(len(centers)) << level) // len(centers)
        starts = np.flatnonzero(np.diff(segment, prepend=-1))
        inside = centers[order]
        extent = np.maximum.reduceat(inside, starts) - np.minimum.reduceat(inside, starts)
        axis = np.repeat(extent.argmax(axis=1), np.diff(starts, append=len(centers)))
        place = inside[np.arange(len(centers)), axis]
        order = order[np.lexsort((place, segment))]
    return order


def _heap(boxes: np.ndarray, leaf_of: np.ndarray, leaves: int) -> np.ndarray:
    """Return the boxes of the children of all nodes, float32 [leaves, 3, 2, 4].

    Along each axis both lower ends and both upper ends; then, for rays that run backwards, the upper ends
    first. Empty boxes are inside out, which no ray meets.
    """
    low = np.full((2 * leaves, 3), np.inf)
    high = -low
    margin = _BOX_MARGIN * np.abs(boxes).max(axis=(1, 2))[:, None]
    low[leaves + leaf_of] = boxes[:, 0] - margin
    high[leaves + leaf_of] = boxes[:, 1] + margin
    size = leaves
    while size > 1:
        size //= 2
        own = slice(size, 2 * size)
        below = slice(2 * size, 4 * size)
        low[own] = low[below].reshape(size, 2, 3).min(axis=1)
        high[own] = high[below].reshape(size, 2, 3).max(axis=1)
    largest = np.finfo(np.float32).max / 4
    ends = np.stack([low, high]).clip(-largest, largest).reshape(2, leaves, 2, 3)  # end, node, child, axis
    forwards = ends.transpose(1, 3, 0, 2)  # node, axis, end, child
    backwards = forwards[:, :, ::-1]
    heap = np.stack([forwards, backwards], axis=2).reshape(leaves, 3, 2, 4)
    return heap.astype(np.float32)
