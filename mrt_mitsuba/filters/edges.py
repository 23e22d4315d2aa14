"""Edge detectors: which pixels of a picture need further samples.

``luma_edges`` and ``sobel_edges`` are the two of the original ray tracer, number for number; they read the
picture. ``geometry_edges`` reads normals and distances instead, so it sees outlines however faint and never a
texture, shadow or reflection.

Common to all:

* The outermost rows and columns are never edges, and their value is 0.
* A pixel that is no finite number makes its 3×3 neighbourhood edges with value infinity, and nothing further
  away.
* Pictures are NumPy arrays, or what NumPy makes one of, such as Dr.Jit's tensors, and results are NumPy's.
* Arithmetic is float32 in a fixed order, so a result does not change from run to run.

Noise. A Monte Carlo picture differs from pixel to pixel without any edge. Where the variance of the pixels is
given, ``luma_edges`` and ``sobel_edges`` first take from the detector's value what noise alone explains:
three standard deviations of that value, propagated to first order. Colour channels are taken as
fully correlated, which is the upper bound for the noise of a weighted sum and close to the truth, since
samples vary in brightness above all. The variances of the neighbourhood are pooled, so a pixel whose own
estimate came out too small does no harm.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters.grid import Grid, check_numbers, finite

if TYPE_CHECKING:
    from mitsuba import Float, Mask

    from mrt_mitsuba.filters.grid import Array

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
GREY_WEIGHTS = (0.07, 0.72, 0.21)
NOISE_SIGMAS = 3.0  # standard deviations that noise explains
REACH = 1  # rows and columns of neighbours that a pixel depends on, either way


@dataclass(frozen=True)
class EdgeMap:
    """The result of a detector.

    ``mask``: [H, W] truth values, the pixels to refine. ``value``: [H, W] float32, the detector's own
    measure, in the unit that its function names; infinity next to a pixel that is not finite.
    """

    mask: np.ndarray
    value: np.ndarray


def luma_edges(
    image: Array,
    *,
    contrast_offset: float = 0.05,
    absolute_threshold: float = 0.0312,
    relative_threshold: float = 0.125,
    variance: Array | None = None,
) -> EdgeMap:
    """Find edges by the contrast of luma.

    With ``L = √(0.299 R + 0.587 G + 0.114 B)`` and the largest and smallest L of the 3×3 neighbourhood, a
    pixel's value is ``r = max − min + contrast_offset``, and it is left alone if ``r <
    max(absolute_threshold, relative_threshold · max)``. With the report's values, the defaults, every pixel
    whose neighbourhood stays below L = 0.4 is an edge, flat or not: the offset alone exceeds the threshold. A
    negative sum counts as 0.

    With ``variance``, ``max − min`` shrinks by three standard deviations of L at either end, and a
    neighbourhood where nothing remains is left alone, dark ones included. L's variance is ``σ²/(4 Y)``, at
    most σ (the change of √Y for a change σ from zero), where σ is the deviation of ``Y = L²``.

    Args:
        image: [H, W, 3], linear, top row first.
        variance: [H, W, 3], the variance of each pixel's mean; where it is NaN, nothing is an edge.

    Raises:
        UsageError: for a wrong shape, or a threshold that is NaN.
    """
    check_numbers(
        contrast_offset=contrast_offset,
        absolute_threshold=absolute_threshold,
        relative_threshold=relative_threshold,
    )
    grid = Grid(image)
    brightness = _sum(grid.planes(image, "image"), LUMA_WEIGHTS)
    luma = dr.select(dr.isfinite(brightness), dr.sqrt(dr.maximum(brightness, 0)), math.inf)
    window = _window(grid, luma)
    high = functools.reduce(dr.maximum, window)
    low = functools.reduce(dr.minimum, window)
    offset = dr.opaque(grid.Float, contrast_offset)
    value = high - low + offset
    if variance is not None:
        deviation = _deviation(grid, variance, LUMA_WEIGHTS)
        # the last term keeps 0/0 out where the pixel is black and free of noise
        slope = dr.maximum(dr.maximum(4 * brightness, deviation), 1e-30)
        luma_variance = dr.square(deviation) / slope
        noise = dr.sqrt(_sum(_window(grid, luma_variance), [1 / 9] * 9))
        # not above zero where the variance is NaN
        excess = high - low - 2 * NOISE_SIGMAS * noise
        value = dr.select(excess > 0, excess + offset, 0)
    value = dr.select(dr.isfinite(high), value, math.inf)
    absolute = dr.opaque(grid.Float, absolute_threshold)
    relative = dr.opaque(grid.Float, relative_threshold) * high
    below = value < dr.maximum(absolute, relative)
    return _edge_map(grid, ~below, value)


def sobel_edges(image: Array, *, threshold: float = 0.0, variance: Array | None = None) -> EdgeMap:
    """Find edges by the Sobel gradient of an integer grey.

    ``grey = int(255 (0.07 R + 0.72 G + 0.21 B))``, truncated towards zero as in C, also outside 0..255. A
    pixel's value is ``|Gx| + |Gy|`` with the 3×3 Sobel kernels, and it is an edge if that exceeds
    ``threshold``. Sums are exact for grey below 2²¹, a brightness of about 8000.

    With ``variance``, grey is not truncated, since noise makes truncation flicker; the value is the whole
    part of what ``|Gx| + |Gy|`` exceeds three standard deviations by. A difference of one grey
    level counts, as it does without noise. The variance of ``|Gx| + |Gy|`` is that of Gx plus that of Gy.

    Args:
        image: [H, W, 3], linear, top row first.
        variance: [H, W, 3], the variance of each pixel's mean; where it is NaN, nothing is an edge.

    Raises:
        UsageError: for a wrong shape, or a threshold that is NaN.
    """
    check_numbers(threshold=threshold)
    grid = Grid(image)
    grey = 255 * _sum(grid.planes(image, "image"), GREY_WEIGHTS)
    # both sides of a difference are summed alike, so equal sides give 0
    w = _window(grid, grey if variance is not None else dr.trunc(grey))
    left = w[0] + 2 * w[3] + w[6]
    right = w[2] + 2 * w[5] + w[8]
    top = w[0] + 2 * w[1] + w[2]
    bottom = w[6] + 2 * w[7] + w[8]
    value = dr.abs(right - left) + dr.abs(bottom - top)
    if variance is not None:
        deviation = 255 * _deviation(grid, variance, GREY_WEIGHTS)
        variances = _window(grid, dr.square(deviation))
        squares = [2, 4, 2, 4, 0, 4, 2, 4, 2]  # of Gx's and Gy's weights, summed
        noise = dr.sqrt(_sum(variances, squares))
        excess = value - NOISE_SIGMAS * noise
        value = dr.select(excess > 0, dr.trunc(excess), 0)
    value = dr.select(finite(w), value, math.inf)
    return _edge_map(grid, value > dr.opaque(grid.Float, threshold), value)


def geometry_edges(
    normal: Array, depth: Array, *, crease_angle: float = 20.0, depth_step: float = 0.02
) -> EdgeMap:
    """Find outlines and creases from the first hits.

    A pixel's value is the larger of two measures, each in units of its threshold; it is an edge above 1.

    * Crease: ``(1 − n·n') / (1 − cos crease_angle)``, the largest over the eight neighbours that hit
      something.
    * Step: the second difference of the inverse distance, ``|1/a + 1/b − 2/t|``, over the largest of the
      three inverse distances and ``depth_step``; the largest over the four pairs a, b of opposite neighbours.
      Inverse distance grows linearly over a flat surface in perspective, so a floor is no edge however
      steeply it is seen. A miss has the inverse distance 0, so a hit next to a miss is always an edge.

    Args:
        normal: [H, W, 3], unit normals in any fixed frame; ignored at a miss.
        depth: [H, W], distances along the ray; infinity, zero or negative for a miss; NaN is not finite.
        crease_angle: degrees, above 0 and at most 180.
        depth_step: relative, above 0.

    Raises:
        UsageError: for a wrong shape, or a threshold out of its range.
    """
    if not 0 < crease_angle <= 180:
        raise UsageError(f"crease_angle={crease_angle} is out of range; give degrees above 0, at most 180")
    if not depth_step > 0:
        raise UsageError(f"depth_step={depth_step} is out of range; give a relative step above 0")
    grid = Grid(normal)
    normals = grid.planes(normal, "normal")
    distance = grid.flat(depth, (), "depth")
    hit = (distance > 0) & (distance < math.inf)
    bad = dr.isnan(distance) | (hit & ~finite(normals))
    inverse = dr.select(hit, 1 / distance, 0)
    inverse = dr.select(bad, math.inf, inverse)
    dr.eval(inverse, normals)  # in one kernel
    near = _window(grid, inverse)
    windows = [_window(grid, plane) for plane in normals]
    centre = near[4]
    step = 0
    for k in range(4):  # pairs of opposite neighbours
        one = near[k]
        other = near[8 - k]
        largest = dr.maximum(dr.maximum(one, other), centre)
        difference = dr.abs((one - centre) + (other - centre))
        step = dr.maximum(step, dr.select(largest > 0, difference / largest, 0))
    crease = 0
    for k in (0, 1, 2, 3, 5, 6, 7, 8):
        dot = sum(window[4] * window[k] for window in windows)
        both = (centre > 0) & (near[k] > 0)
        crease = dr.maximum(crease, dr.select(both, 1 - dot, 0))
    step /= dr.opaque(grid.Float, depth_step)
    crease /= dr.opaque(grid.Float, 1 - math.cos(math.radians(crease_angle)))
    value = dr.select(finite(near), dr.maximum(step, crease), math.inf)
    return _edge_map(grid, value > 1, value)


def _inner(grid: Grid) -> Mask:
    """The pixels that are not on the picture's border, as a mask."""
    column, row = grid.coordinates(grid.index)
    inner_column = (column > 0) & (column < grid.width - 1)
    inner_row = (row > 0) & (row < grid.height - 1)
    return inner_column & inner_row


def _window(grid: Grid, plane: Float) -> list[Float]:
    """The 3×3 values around every pixel, row by row; zeros on the picture's border."""
    dr.eval(plane)  # computed once for each pixel, not once for each of the nine that read it
    indices = [grid.index + dx + dy * grid.width for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return [dr.gather(grid.Float, plane, index, active=_inner(grid)) for index in indices]


def _edge_map(grid: Grid, mask: Mask, value: Float) -> EdgeMap:
    """The result of a detector, with the border left out."""
    mask = mask & _inner(grid)
    value = dr.select(_inner(grid), value, 0)
    dr.eval(mask, value)  # both in one kernel
    return EdgeMap(mask=grid.output([mask]), value=grid.output([value]))


def _sum(values: Sequence[Float], weights: Sequence[float]) -> Float:
    return sum(weight * value for weight, value in zip(weights, values, strict=True) if weight)


def _deviation(grid: Grid, variance: Array, weights: Sequence[float]) -> Float:
    """The standard deviation of a weighted sum of fully correlated channels."""
    deviations = [dr.sqrt(plane) for plane in grid.planes(variance, "variance")]
    return _sum(deviations, weights)
