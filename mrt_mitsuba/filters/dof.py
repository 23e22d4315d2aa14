"""Depth of field as a filter over a finished picture, from the distances of its first hits.

Two models share the amount of blur (``blur_amount``, the report's "height map").

``report`` is the original ray tracer's filter, number for number. With a the amount at a pixel and k =
int(a), its window is the rows [y − k, y + k) and columns [x − k, x + k) cut to the picture, rows counted from
the bottom. A neighbour weighs P[row]·P[column], with P the line of Pascal's triangle that has 2k entries,
counted from the start of the cut window. Neighbours with a = 0 are left out. Its flaws are kept: the window
has no centre, so what is blurred moves by half a pixel to the right and up; at the left and lower border the
weights belong to other pixels; the amount comes in steps; blurred foreground ends at the outline of sharp
background; background takes in foreground.

``corrected`` gathers what a lens would see: a pixel becomes a disc that is as wide as the report's Pascal
line at every whole amount, and grows continuously in between. The line has the variance (2k − 1)/4 along
each axis; below a = 1 it is continued as a²/4. A disc of radius r touches only the four nearest pixels while
r ≤ √2 − 1, where its variance is 2r/(1 + 4r); above, it is close to ((r + ½)² + 7/16)/4. Hence ``r(a) =
a²/(8 − 4a²)`` below 1 and ``√(2a − 23/16) − ½`` from there.

The discs reach a pixel and cover each other by these rules:

* Every pixel of the sharp picture is a disc, given by a signed radius r in pixels that is negative on the
  near side of the focus. The disc is whole up to ``|r|`` from its centre and fades out over one pixel more:
  its coverage at distance d is ``clip(|r| + 1 − d, 0, 1)``, so r = 0 is the pixel itself. Its light is
  spread evenly: a pixel gets coverage over the sum of coverages.
* Seen from a pixel p, a neighbour q is in front, in the same layer or behind by the difference of their
  signed radii: fully so from one pixel on, in proportion below, so that no seam shows. The radius and not the
  depth decides, since surfaces that are equally blurred need no order.
* What is in front covers p by the share of q's light that reaches p, and so does the same layer, but there
  what lies behind p spreads no wider than p. What is behind shows where the same layer leaves a gap, by the
  part of p's own disc that it fills. So sharp things neither give nor take, blurred foreground bleeds over
  its outline, and its own rim is see-through.
* Beyond the border the picture goes on as its border pixels.

In both, a pixel whose colour is no finite number gives nothing to its neighbours and stays as it is; one
whose depth is NaN counts as sharp. Results are the same bit for bit from run to run.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters.grid import Grid, check_numbers, dilated, finite

if TYPE_CHECKING:
    from mitsuba import Float, Int

    from mrt_mitsuba.filters.grid import Array

MAX_AMOUNT = 8
REACH = MAX_AMOUNT  # rows and columns of neighbours that a pixel may depend on, either way
MODES = ("report", "corrected")


def blur_amount(depth: Array, *, focal_distance: float | None, focal_range: float = 2.0) -> np.ndarray:
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
    mode: str = "report",
) -> Array:
    """The picture as a lens focused at a distance would show it, [H, W, 3] float32.

    Without a focal distance (None, zero or negative) the picture comes back as it is, the same object.

    Args:
        image: [H, W, 3], linear, top row first.
        depth: [H, W], distances along the ray (not z); infinity, zero or negative for a miss.
        focal_distance: the distance in focus, in the unit of ``depth``.
        focal_range: half the width of the sharp zone around it, in the same unit.
        mode: "report" for the original's filter, "corrected" for the one without its flaws; see the module.

    Raises:
        UsageError: for a wrong shape, a distance or range that is NaN, or an unknown mode.
    """
    if mode not in MODES:
        raise UsageError(f"unknown depth-of-field mode {mode!r}; use one of {', '.join(MODES)}")
    if focal_distance is None or focal_distance <= 0:
        return image
    grid = Grid(image)
    planes = grid.planes(image, "image")
    distance = grid.flat(depth, (), "depth")
    amount = _amount(grid, distance, focal_distance, focal_range)
    if mode == "report":
        return grid.output(_pascal(grid, planes, amount), (3,))
    radius = _radius(amount)
    near = (distance > 0) & (distance < dr.opaque(grid.Float, focal_distance))
    signed = dr.select(near, -radius, radius)
    return grid.output(_discs(grid, planes, signed), (3,))


def _amount(grid: Grid, distance: Float, focal_distance: float, focal_range: float) -> Float:
    check_numbers(focal_distance=focal_distance, focal_range=focal_range)
    if focal_distance <= 0:
        return dr.zeros(grid.Float, grid.count)
    defocus = dr.abs(dr.opaque(grid.Float, focal_distance) - distance)
    amount = defocus - dr.opaque(grid.Float, focal_range)
    amount = dr.select(amount > 0, dr.minimum(amount, MAX_AMOUNT), 0)  # NaN > 0 is false
    miss = (distance <= 0) | (distance == math.inf)
    return dr.select(miss, MAX_AMOUNT, amount)


def _radius(amount: Float) -> Float:
    small = dr.square(amount) / (8 - 4 * dr.square(dr.minimum(amount, 1)))
    large = dr.sqrt(dr.maximum(2 * amount - 23 / 16, 0)) - 0.5
    return dr.select(amount < 1, small, large)


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

    ``line``: the index of its first value, the stride to the next, their number, and k: the weights are the
    line of Pascal's triangle with 2k entries. ``place``: positions in the planes by index; None: the indices.
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


def _discs(grid: Grid, planes: Sequence[Float], radius: Float) -> list[Float]:
    """The blurred colours, three planes; pixels that no disc of another reaches are not computed.

    ``radius``: a plane of signed radii in pixels.
    """
    max_radius = _radius(MAX_AMOUNT)
    reach = math.ceil(max_radius + 1) - 1
    steps = range(-reach, reach + 1)
    # the neighbours that a disc of the largest radius covers at least in part
    offsets = [(dx, dy, math.hypot(dx, dy)) for dy in steps for dx in steps]
    offsets = [offset for offset in offsets if offset[2] < max_radius + 1]
    distances = Counter(distance for _, _, distance in offsets)
    spread = sum(number * _coverage(radius, distance) for distance, number in sorted(distances.items()))
    good = finite(planes)
    share = dr.select(good, 1 / spread, 0)  # what a covered pixel gets of a disc's light
    colours = [dr.select(good, plane, 0) for plane in planes]
    wide = dr.abs(radius) > 0
    blurred = [grid.Float(plane) for plane in planes]
    dr.eval(radius, share, colours, wide, blurred)
    near = dilated(np.array(wide).reshape(grid.rows, grid.columns), reach)
    pixels = grid.Int(dr.compress(good & grid.Bool(near.ravel())))
    if dr.width(pixels) == 0:
        return blurred

    column, row = grid.coordinates(pixels)
    own_radius = dr.gather(grid.Float, radius, pixels)
    own_share = dr.gather(grid.Float, share, pixels)
    tables = [grid.Float(list(values)) for values in zip(*offsets, strict=True)]

    def add(j: Int, totals: Sequence[Float]) -> list[Float]:
        """Add the weighted red, green, blue and 1 of a neighbour: in front, in the same layer, behind."""
        dx, dy, distance = (dr.gather(grid.Float, table, j) for table in tables)
        # the border pixels are repeated outside
        their_row = dr.clip(row + grid.Int(dy), 0, grid.height - 1)
        their_column = dr.clip(column + grid.Int(dx), 0, grid.width - 1)
        index = their_row * grid.width + their_column
        their_radius = dr.gather(grid.Float, radius, index)
        light = dr.gather(grid.Float, share, index)
        order = their_radius - own_radius
        seen = dr.select(light > 0, _coverage(own_radius, distance) * own_share, 0)
        reaching = _coverage(their_radius, distance) * light
        narrower = (order > 0) & (dr.abs(own_radius) < dr.abs(their_radius))
        alike = dr.maximum(1 - dr.abs(order), 0)
        in_front = reaching * dr.clip(-order, 0, 1)
        in_layer = dr.select(narrower, seen, reaching) * alike
        behind = seen * dr.clip(order, 0, 1)
        values = [dr.gather(grid.Float, colour, index) for colour in colours] + [1]
        terms = [weight * value for weight in (in_front, in_layer, behind) for value in values]
        return [total + term for total, term in zip(totals, terms, strict=True)]

    zero = dr.zeros(grid.Float, dr.width(pixels))
    totals = grid.accumulate(len(offsets), [zero] * 12, add)
    for target, colour in zip(blurred, _laid_over(totals[:4], totals[4:8], totals[8:]), strict=True):
        dr.scatter(target, colour, pixels)
    dr.eval(blurred)
    return blurred


def _laid_over(front: Sequence[Float], same: Sequence[Float], back: Sequence[Float]) -> list[Float]:
    """The colours of layers laid over each other, each given as weighted colours and the sum of weights.

    The same layer holds the pixel itself, so its weight is not zero.
    """
    covered = dr.minimum(front[3], 1)
    solid = dr.minimum(same[3], 1)
    gap = dr.minimum(1 - solid, back[3])
    per_front = dr.select(front[3] > 0, covered / front[3], 0)
    per_same = solid / same[3] / (solid + gap)
    per_back = dr.select(back[3] > 0, gap / back[3], 0) / (solid + gap)
    return [
        per_front * front[c] + (1 - covered) * (per_same * same[c] + per_back * back[c]) for c in range(3)
    ]


def _coverage(radius: Float, distance: Float) -> Float:
    return dr.clip(dr.abs(radius) + (1 - distance), 0, 1)
