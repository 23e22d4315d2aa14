"""Depth of field as a filter over a finished picture, from the distances of its first hits.

This is the original ray tracer's filter, number for number. With a the amount of blur at a pixel
(``blur_amount``, the report's "height map") and k = int(a), its window is the rows [y − k, y + k) and columns
[x − k, x + k) cut to the picture, rows counted from the bottom. A neighbour weighs P[row]·P[column], with P
the line of Pascal's triangle that has 2k entries, counted from the start of the cut window. Neighbours with
a = 0 are left out. Its flaws are kept: the window has no centre, so what is blurred moves by half a pixel to
the right and up; at the left and lower border the weights belong to other pixels; the amount comes in steps;
blurred foreground ends at the outline of sharp background; background takes in foreground. A lens without
them is Mitsuba's ``thinlens``.

A pixel whose colour is no finite number gives nothing to its neighbours and stays as it is; one
whose depth is NaN counts as sharp. Results are the same bit for bit from run to run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr

from mrt_mitsuba.filters.grid import Grid, check_numbers, finite

if TYPE_CHECKING:
    from mitsuba import Float, Int

    from mrt_mitsuba.filters.grid import Array

MAX_AMOUNT = 8
REACH = MAX_AMOUNT  # rows and columns of neighbours that a pixel may depend on, either way


def blur_amount(depth: Array, *, focal_distance: float | None, focal_range: float = 2.0) -> Array:
    """The amount of blur a, [H, W] float32: ``clamp(|focal_distance − depth| − focal_range, 0, 8)``.

    A miss gives 8, NaN gives 0, and without a focal distance (None, zero or negative) all is 0.

    Args:
        depth: [H, W], distances along the ray (not z); infinity, zero or negative for a miss.
        focal_distance: the distance in focus, in the unit of ``depth``.
        focal_range: half the width of the sharp zone around it, in the same unit.

    Raises:
        UsageError: for a wrong shape, or a distance or range that is NaN.
    """
    grid = Grid(depth)
    distance = grid.flat(depth, (), "depth")
    return grid.output([_amount(grid, distance, focal_distance or 0.0, focal_range)])


def gaussian_dof(
    image: Array,
    depth: Array,
    *,
    focal_distance: float | None,
    focal_range: float = 2.0,
) -> Array:
    """The picture as a lens focused at a distance would show it, [H, W, 3] float32.

    Without a focal distance (None, zero or negative) the picture comes back as it is, the same object.
    Otherwise the result is an array of the same kind: NumPy for NumPy, a Dr.Jit tensor for a tensor.

    Args:
        image: [H, W, 3], linear, top row first.
        depth: [H, W], distances along the ray (not z); infinity, zero or negative for a miss.
        focal_distance: the distance in focus, in the unit of ``depth``.
        focal_range: half the width of the sharp zone around it, in the same unit.

    Raises:
        UsageError: for a wrong shape, a distance or range that is NaN.
    """
    if focal_distance is None or focal_distance <= 0:
        return image
    grid = Grid(image)
    planes = grid.planes(image, "image")
    distance = grid.flat(depth, (), "depth")
    amount = _amount(grid, distance, focal_distance, focal_range)
    return grid.output(_pascal(grid, planes, amount), (3,))


def _amount(grid: Grid, distance: Float, focal_distance: float, focal_range: float) -> Float:
    check_numbers(focal_distance=focal_distance, focal_range=focal_range)
    if focal_distance <= 0:
        return dr.zeros(grid.Float, grid.count)
    defocus = dr.abs(dr.opaque(grid.Float, focal_distance) - distance)
    amount = defocus - dr.opaque(grid.Float, focal_range)
    amount = dr.select(amount > 0, dr.minimum(amount, MAX_AMOUNT), 0)  # NaN > 0 is false
    miss = (distance <= 0) | (distance == math.inf)
    return dr.select(miss, MAX_AMOUNT, amount)


def _pascal(grid: Grid, planes: Sequence[Float], amount: Float) -> list[Float]:
    """Blur with Pascal windows, in one pass along rows and one along columns.

    The weights of a window are the product of a row's and a column's, at the borders too, so two passes of 2k
    values replace one of 4k². The first pass runs only over what the second one reads: pixels on levels, one
    for each k.
    """
    good = finite(planes)
    gives = good & (amount > 0)
    sources = [dr.select(gives, plane, 0) for plane in planes]
    sources.append(dr.select(gives, grid.Float(1), 0))  # for the sum of the weights
    k = dr.select(good, grid.Int(amount), 0)
    blurred = [grid.Float(plane) for plane in planes]
    wide = k > 0
    dr.eval(sources, k, blurred, wide)
    pixels = grid.Int(dr.compress(wide))
    if dr.width(pixels) == 0:
        return blurred

    # what the columns of the pixels read
    k = dr.gather(grid.Int, k, pixels)
    column, row = grid.coordinates(pixels)
    height = grid.height - 1 - row  # over the bottom row
    start, count = _cut(height, k, grid.height)
    first = (k - 1) * grid.size + (grid.height - 1 - start) * grid.width + column
    read = dr.zeros(grid.Bool, MAX_AMOUNT * grid.count)

    def mark(j: Int, none: Sequence[Float]) -> Sequence[Float]:
        dr.scatter(read, grid.Bool(True), first - j * grid.width, active=j < count)
        return none

    grid.accumulate(count, [], mark)

    # along rows
    needed = grid.Int(dr.compress(read))
    level = needed // grid.size
    column, row = grid.coordinates(needed - level * grid.size)
    left, number = _cut(column, level + 1, grid.width)
    row_lines = (row * grid.width + left, 1, number, level + 1)
    along_rows = _weighted(grid, sources, row_lines)
    place = dr.empty(grid.Int, MAX_AMOUNT * grid.count)  # read below only where written here
    dr.scatter(place, dr.arange(grid.Int, dr.width(needed)), needed)
    dr.eval(along_rows, place)

    # along columns
    column_lines = (first, -grid.width, count, k)
    *sums, weights = _weighted(grid, along_rows, column_lines, place)
    for target, total in zip(blurred, sums, strict=True):
        dr.scatter(target, total / weights, pixels)  # not zero: the pixel itself gives
    dr.eval(blurred)
    return blurred


def _cut(centre: Int, k: Int, size: Int) -> tuple[Int, Int]:
    """Start and length of [centre − k, centre + k) cut to [0, size)."""
    start = dr.maximum(centre - k, 0)
    end = dr.minimum(centre + k, size)
    return start, end - start


def _weighted(
    grid: Grid, planes: Sequence[Float], line: tuple[Int, Int, Int, Int], place: Int | None = None
) -> Sequence[Float]:
    """The weighted sums of each plane's values along lines.

    ``line``: the index of its first value, the stride to the next, their number, and the k of the weights.
    ``place``: where in the planes the values are that have these indices.
    """
    first, stride, count, k = line
    pascal = grid.Float(_PASCAL)

    def add(j: Int, totals: Sequence[Float]) -> list[Float]:
        weight = dr.gather(grid.Float, pascal, (k - 1) * _MOST + j)
        active = j < count
        index = first + j * stride
        if place is not None:
            index = dr.gather(grid.Int, place, index, active=active)
        values = [dr.gather(grid.Float, plane, index, active=active) for plane in planes]
        return [total + weight * value for total, value in zip(totals, values, strict=True)]

    zero = dr.zeros(grid.Float, dr.width(first))
    return grid.accumulate(count, [zero] * len(planes), add)


_MOST = 2 * MAX_AMOUNT
# The line of Pascal's triangle with 2k entries for each k, filled up
_PASCAL = [math.comb(2 * k - 1, j) / 2 ** (2 * k - 1) for k in range(1, MAX_AMOUNT + 1) for j in range(_MOST)]
