"""A tree of boxes over many small objects, built with numpy and walked in Dr.Jit.

The tree is a complete binary one in heap order: node 1 is the root, 2 i and 2 i + 1 are the children of i,
the last level holds one object or nothing in each leaf. All nodes of a level are split along the same axis,
at the median. So a walk needs no stack and no links, and the nearer child comes first for each ray by its
direction alone.

Why not Mitsuba's tree, with something around each object that it can hold? It finds one thing at a time, so a
ray that starts at an object, or passes near one, queries it two or three times. With triangles that is faster
for rays that run side by side only, slower for mirror rays and for few objects, and 10⁵ objects take half as
long again to load. With the shape ``ellipsoids`` it is faster, but that computes in float32 with an error
that grows with the square of the distance in sizes of the object: from hundreds of sizes away, rays are lost.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# Box tests are wider than exact by some float32 roundings, relative to distances and to coordinates
_SLACK = 8 * 2.0**-24

# Directions nearer to an axis plane than this count as so much off it
_LEAST_SLOPE = 1e-18


_NO_LEAF = 0xFFFFFFFF


class Tree:
    """Boxes [n, 2, 3] (lower and upper corner) in a tree; ``leaf_of`` [n] is where each object is, from 0."""

    def __init__(self, boxes: np.ndarray) -> None:
        count = len(boxes)
        self.depth = max(count - 1, 0).bit_length()
        self.leaves = 1 << self.depth
        order, axes = _sort(boxes.mean(axis=1), self.depth)
        self.leaf_of = np.empty(count, np.int64)
        self.leaf_of[order] = np.arange(count) * self.leaves // count
        self.boxes = mi.Float(_heap(boxes, self.leaf_of, self.leaves).ravel())
        # For each axis, the bits of a leaf's number that say on which side it is along it. They, and the
        # sizes, are data: one kernel serves all trees
        bits = [sum(1 << (self.depth - 1 - k) for k, a in enumerate(axes) if a == axis) for axis in range(3)]
        self.axis_bits = [dr.opaque(mi.UInt32, b) for b in bits]
        self.first_leaf = dr.opaque(mi.UInt32, self.leaves)
        self.last_level = dr.opaque(mi.UInt32, self.depth)
        dr.eval(self.boxes)

    def walk(self, ray: Any, active: Any, visit: Callable[[Any, tuple], tuple], state: tuple, *,
             any_hit: bool = False) -> tuple:  # fmt: skip
        """Call ``visit(leaf, state)`` at each leaf whose box a ray meets; return the last state.

        The first of ``state`` is the reach of the ray; ``visit`` returns a new state, with the distance of a
        hit there if that is less. With ``any_hit``, a ray is done as soon as that has happened.
        """
        backwards = [c < 0 for c in ray.d]
        inverse = [1 / _off_zero(c) for c in ray.d]
        flips = mi.UInt32(0)
        for back, bits in zip(backwards, self.axis_bits, strict=True):
            flips |= dr.select(back, bits, 0)
        reach = state[0]

        def to_next_box(node: Any, leaf: Any, reach: Any) -> tuple[Any, Any, Any]:
            level = 31 - dr.lzcnt(node)
            place = node ^ (flips >> (self.last_level - level))
            enters = self._meets_box(place, ray.o, inverse, backwards, reach)
            is_leaf = node >= self.first_leaf
            after = node + 1
            after >>= dr.tzcnt(after)  # up to where this was a first child, and on to the second
            after = dr.select(after == 1, 0, after)
            leaf = dr.select(enters & is_leaf, place - self.first_leaf, leaf)
            return dr.select(enters & ~is_leaf, node << 1, after), leaf, reach

        def to_next_leaf(node: Any, state: tuple) -> tuple[Any, tuple]:
            # All rays of a packet go on to a leaf each before any is looked into: that costs ten times a box
            node, leaf, _ = dr.while_loop(
                (node, mi.UInt32(_NO_LEAF), state[0]),
                lambda node, leaf, reach: (node != 0) & (leaf == _NO_LEAF),
                to_next_box,
                label="boxes",
            )
            found = leaf != _NO_LEAF
            return node, dr.if_stmt((leaf, state), found, visit, lambda leaf, state: state, label="leaf")

        def goes_on(node: Any, state: tuple) -> Any:
            going = node != 0
            return going & (state[0] >= reach) if any_hit else going

        return dr.while_loop(
            (dr.select(active, mi.UInt32(1), 0), state), goes_on, to_next_leaf, label="tree"
        )[1]

    def _meets_box(self, place: Any, o: Any, inverse: list, backwards: list, reach: Any) -> Any:
        low = dr.gather(mi.Vector4f, self.boxes, 2 * place)
        high = dr.gather(mi.Vector4f, self.boxes, 2 * place + 1)
        near, far = mi.Float(0), reach
        for k in range(3):
            first, last = dr.select(backwards[k], high[k], low[k]), dr.select(backwards[k], low[k], high[k])
            near = dr.maximum(near, (first - o[k]) * inverse[k])
            far = dr.minimum(far, (last - o[k]) * inverse[k] * (1 + _SLACK))
        return near <= far


def _off_zero(x: Any) -> Any:
    return dr.select(dr.abs(x) >= _LEAST_SLOPE, x, dr.select(x < 0, -_LEAST_SLOPE, _LEAST_SLOPE))


def _sort(centers: np.ndarray, depth: int) -> tuple[np.ndarray, list[int]]:
    """The objects in the order of the leaves, and the axis along which each level is split."""
    order, axes = np.arange(len(centers)), []
    for level in range(depth):
        segment = (np.arange(len(centers)) << level) // len(centers)
        starts = np.flatnonzero(np.diff(segment, prepend=-1))
        sorted_centers = centers[order]
        extent = np.maximum.reduceat(sorted_centers, starts) - np.minimum.reduceat(sorted_centers, starts)
        axis = int(np.argmax(extent.mean(axis=0)))
        order = order[np.lexsort((sorted_centers[:, axis], segment))]
        axes.append(axis)
    return order, axes


def _heap(boxes: np.ndarray, leaf_of: np.ndarray, leaves: int) -> np.ndarray:
    """Boxes of all nodes, float32 [2 leaves, 2, 4]; empty ones are inside out, which no ray meets."""
    low, high = np.full((2 * leaves, 4), np.inf), np.full((2 * leaves, 4), -np.inf)
    margin = _SLACK * np.abs(boxes).max(axis=(1, 2))[:, None]
    low[leaves + leaf_of, :3] = boxes[:, 0] - margin
    high[leaves + leaf_of, :3] = boxes[:, 1] + margin
    size = leaves
    while size > 1:
        size //= 2
        low[size : 2 * size] = low[2 * size : 4 * size].reshape(size, 2, 4).min(axis=1)
        high[size : 2 * size] = high[2 * size : 4 * size].reshape(size, 2, 4).max(axis=1)
    largest = np.finfo(np.float32).max / 4
    heap = np.clip(np.stack([low, high], axis=1), -largest, largest)
    heap[:, :, 3] = 0
    return heap.astype(np.float32)
