"""The filters of the original ray tracer in plain float64 loops, as the truth for the fast ones.

Written to be read next to the definitions, one pixel after the other, and for finite numbers only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

SOBEL_X = ((-1, 0, 1), (-2, 0, 2), (-1, 0, 1))
SOBEL_Y = ((-1, -2, -1), (0, 0, 0), (1, 2, 1))


@dataclass(frozen=True)
class ReferenceEdges:
    """A detector's result: ``mask`` and ``value``, and by how much the decision was made.

    ``margin``: [H, W], the distance of the value from the threshold. Where it is below the rounding error of
    float32 arithmetic, a float32 detector may decide otherwise.
    """

    mask: np.ndarray
    value: np.ndarray
    margin: np.ndarray


def luma_edges(image: np.ndarray) -> ReferenceEdges:
    """Contrast of ``√(0.299 R + 0.587 G + 0.114 B)`` in the 3×3 neighbourhood."""
    red, green, blue = np.moveaxis(np.asarray(image, dtype=np.float64), -1, 0)
    luma = np.sqrt(0.299 * red + 0.587 * green + 0.114 * blue)
    result = _empty(luma.shape)
    for row, column, window in _windows(luma):
        contrast = window.max() - window.min() + 0.05
        threshold = max(0.0312, 0.125 * window.max())
        result.value[row, column] = contrast
        result.margin[row, column] = abs(contrast - threshold)
        result.mask[row, column] = not contrast < threshold
    return result


def sobel_edges(image: np.ndarray) -> ReferenceEdges:
    """Sobel gradient of ``int(255 (0.07 R + 0.72 G + 0.21 B))``.

    Here ``margin`` is the distance of the nearest grey of the window, before truncation, from a whole number.
    Next to zero that is no matter, since truncation goes to zero from both sides, and it counts as far away.
    """
    red, green, blue = np.moveaxis(np.asarray(image, dtype=np.float64), -1, 0)
    exact = 255 * (0.07 * red + 0.72 * green + 0.21 * blue)
    from_whole = np.where(np.abs(exact) < 0.5, 1.0, np.abs(exact - np.round(exact)))
    grey = np.trunc(exact)
    result = _empty(grey.shape)
    for row, column, window in _windows(grey):
        gx = sum(SOBEL_X[i][j] * window[i, j] for i in range(3) for j in range(3))
        gy = sum(SOBEL_Y[i][j] * window[i, j] for i in range(3) for j in range(3))
        result.value[row, column] = abs(gx) + abs(gy)
        result.mask[row, column] = abs(gx) + abs(gy) > 0
        result.margin[row, column] = from_whole[row - 1 : row + 2, column - 1 : column + 2].min()
    return result


def blur_amount(depth: np.ndarray, focal_distance: float, focal_range: float) -> np.ndarray:
    """The height map: ``clamp(|focal_distance − depth| − focal_range, 0, 8)``, and 8 for a miss."""
    amount = np.zeros(depth.shape)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            distance = float(depth[row, column])
            if distance <= 0 or distance == math.inf:
                amount[row, column] = 8
            else:
                amount[row, column] = min(max(abs(focal_distance - distance) - focal_range, 0), 8)
    return amount


def gaussian_dof(image: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Blur with Pascal windows; ``amount`` as from ``blur_amount``, both with the top row first."""
    buffer = np.asarray(image, dtype=np.float64)[::-1]  # row 0 at the bottom
    amount = amount[::-1]
    height, width = amount.shape
    result = buffer.copy()
    for y in range(height):
        for x in range(width):
            k = int(amount[y, x])
            pascal = [math.comb(2 * k - 1, j) for j in range(2 * k)]
            first_row, first_column = max(y - k, 0), max(x - k, 0)
            total, weights = np.zeros(3), 0
            for row in range(first_row, min(y + k, height)):
                for column in range(first_column, min(x + k, width)):
                    if amount[row, column] == 0:
                        continue
                    weight = pascal[row - first_row] * pascal[column - first_column]
                    total += weight * buffer[row, column]
                    weights += weight
            if weights > 0:
                result[y, x] = total / weights
    return result[::-1]


def _empty(shape: tuple[int, ...]) -> ReferenceEdges:
    return ReferenceEdges(np.zeros(shape, dtype=bool), np.zeros(shape), np.full(shape, np.inf))


def _windows(plane: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield row, column and 3×3 window of every pixel that is not on the border."""
    height, width = plane.shape
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            yield row, column, plane[row - 1 : row + 2, column - 1 : column + 2]
