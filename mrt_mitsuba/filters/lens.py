"""Lens blur by gathering: which discs reach a pixel, and in which order they cover each other.

The model:

* Every pixel of the sharp picture is a disc, given by a signed radius r in pixels that is negative on the
  near side of the focus. The disc is whole up to |r| from its centre and fades out over one pixel more: its
  coverage at distance d is ``clip(|r| + 1 − d, 0, 1)``, so r = 0 is the pixel itself. Its light is spread
  evenly: a pixel gets coverage over the sum of coverages.
* Seen from a pixel p, a neighbour q is in front, in the same layer or behind by the difference of their
  signed radii: fully so from one pixel on, in proportion below, so that no seam shows. The radius and not the
  depth decides, since surfaces that are equally blurred need no order.
* What is in front covers p by the share of q's light that reaches p, and so does the same layer, but there
  what lies behind p spreads no wider than p. What is behind shows where the same layer leaves a gap, by the
  part of p's own disc that it fills. So sharp things neither give nor take, blurred foreground bleeds over
  its outline, and its own rim is see-through.
* Beyond the border the picture goes on as its border pixels.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr

from mrt_mitsuba.filters.grid import Grid, finite


def gather_discs(grid: Grid, planes: Sequence[Any], radius: Any, *, max_radius: float) -> list[Any]:
    """Return the blurred colours, three planes; pixels that no disc of another reaches are not computed.

    A pixel whose colour is no finite number gives nothing to its neighbours and stays as it is.

    Args:
        planes: red, green and blue.
        radius: a plane of signed radii in pixels, at most ``max_radius`` either way.
    """
    reach = math.ceil(max_radius + 1) - 1
    steps = range(-reach, reach + 1)
    # the neighbours that a disc of the largest radius covers at least in part
    offsets = [(dx, dy) for dy in steps for dx in steps if math.hypot(dx, dy) < max_radius + 1]
    distances = sorted(Counter(math.hypot(dx, dy) for dx, dy in offsets).items())
    spread = sum(number * _coverage(dr.abs(radius), distance) for distance, number in distances)
    good = finite(planes)
    share = dr.select(good, 1 / spread, 0)  # what a covered pixel gets of a disc's light
    colours = [dr.select(good, plane, 0) for plane in planes]
    wide = dr.abs(radius) > 0
    blurred = [grid.Float(plane) for plane in planes]
    dr.eval(radius, share, colours, wide, blurred)
    pixels = grid.Int(dr.compress(good & _near_any(grid, wide, max(dx for dx, _ in offsets))))
    if dr.width(pixels) == 0:
        return blurred

    totals = _gather_layers(grid, colours, radius, share, pixels, offsets)
    front, same, behind = totals[:4], totals[4:8], totals[8:]
    # the layers laid over each other; the same layer holds the pixel itself, so its weight is not zero
    covered, solid = dr.minimum(front[3], 1), dr.minimum(same[3], 1)
    gap = dr.minimum(1 - solid, behind[3])
    per_front = dr.select(front[3] > 0, covered / front[3], 0)
    per_same = solid / same[3] / (solid + gap)
    per_behind = dr.select(behind[3] > 0, gap / behind[3], 0) / (solid + gap)
    values = [
        per_front * front[c] + (1 - covered) * (per_same * same[c] + per_behind * behind[c]) for c in range(3)
    ]
    for target, value in zip(blurred, values, strict=True):
        dr.scatter(target, value, pixels)
    dr.eval(blurred)
    return blurred


def _coverage(radius: Any, distance: Any) -> Any:
    return dr.clip(radius + (1 - distance), 0, 1)


def _clamped(grid: Grid, column: Any, row: Any, dx: Any, dy: Any) -> Any:
    """Return the index of a neighbour, with the border pixels repeated outside."""
    return dr.clip(row + dy, 0, grid.height - 1) * grid.width + dr.clip(column + dx, 0, grid.width - 1)


def _near_any(grid: Grid, mask: Any, reach: int) -> Any:
    """Return where the mask is set within ``reach`` columns and rows, in a pass along either."""
    column, row = grid.coordinates(grid.index)
    steps = range(-reach, reach + 1)

    def any_of(mask: Any, neighbour: Callable[[int], Any]) -> Any:
        result = grid.Bool(False)
        for step in steps:
            result |= dr.gather(grid.Bool, mask, neighbour(step))
        return result

    along_rows = any_of(mask, lambda step: _clamped(grid, column, row, step, 0))
    dr.eval(along_rows)
    return any_of(along_rows, lambda step: _clamped(grid, column, row, 0, step))


def _gather_layers(
    grid: Grid,
    colours: Sequence[Any],
    radius: Any,
    share: Any,
    pixels: Any,
    offsets: Sequence[tuple[int, int]],
) -> Sequence[Any]:
    """Return the weighted sums of red, green, blue and 1: in front, in the same layer, behind."""
    column, row = grid.coordinates(pixels)
    own_radius = dr.gather(grid.Float, radius, pixels)
    own_share = dr.gather(grid.Float, share, pixels)
    triples = [(dx, dy, math.hypot(dx, dy)) for dx, dy in offsets]
    steps = [grid.Float(list(step)) for step in zip(*triples, strict=True)]

    def add(j: Any, totals: Sequence[Any]) -> list[Any]:
        dx, dy, distance = (dr.gather(grid.Float, table, j) for table in steps)
        index = _clamped(grid, column, row, grid.Int(dx), grid.Int(dy))
        their_radius = dr.gather(grid.Float, radius, index)
        light = dr.gather(grid.Float, share, index)
        order = their_radius - own_radius
        seen = dr.select(light > 0, _coverage(dr.abs(own_radius), distance) * own_share, 0)
        reaching = _coverage(dr.abs(their_radius), distance) * light
        narrower = (order > 0) & (dr.abs(own_radius) < dr.abs(their_radius))
        weights = (
            reaching * dr.clip(-order, 0, 1),
            dr.select(narrower, seen, reaching) * dr.maximum(1 - dr.abs(order), 0),
            seen * dr.clip(order, 0, 1),
        )
        values = [dr.gather(grid.Float, colour, index) for colour in colours] + [1]
        terms = [weight * value for weight in weights for value in values]
        return [total + term for total, term in zip(totals, terms, strict=True)]

    return grid.accumulate(len(offsets), [dr.zeros(grid.Float, dr.width(pixels))] * 12, add)
