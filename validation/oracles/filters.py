"""The filters in plain float64, as the truth for the fast ones.

Written to be read next to the definitions, and for finite numbers only: detectors by SciPy's filters,
both blurs one pixel after the other.

A detector gives [H, W] arrays: mask, value, and margin, the distance of the value from the threshold. Where
that is below the rounding error of float32, a float32 detector may decide otherwise.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, sobel
from scipy.special import comb

Array = np.ndarray
Edges = tuple[Array, Array, Array]


def luma_edges(image: Array) -> Edges:
    """The contrast of ``√(0.299 R + 0.587 G + 0.114 B)`` in the 3×3 neighbourhood."""
    luma = np.sqrt(np.float64(image) @ [0.299, 0.587, 0.114])
    largest = maximum_filter(luma, 3)
    contrast = largest - minimum_filter(luma, 3) + 0.05
    threshold = np.maximum(0.0312, 0.125 * largest)
    return _inside(~(contrast < threshold), contrast, abs(contrast - threshold))


def sobel_edges(image: Array) -> Edges:
    """The Sobel gradient of ``int(255 (0.07 R + 0.72 G + 0.21 B))``.

    The margin is the distance of the nearest grey of the window, before truncation, from a whole number. Next
    to zero, where truncation goes to zero from both sides, it counts as far away.
    """
    exact = 255 * (np.float64(image) @ [0.07, 0.72, 0.21])
    from_whole = np.where(abs(exact) < 0.5, 1.0, abs(exact - np.round(exact)))
    gradient = sum(abs(sobel(np.trunc(exact), axis)) for axis in (0, 1))
    return _inside(gradient > 0, gradient, minimum_filter(from_whole, 3))


def blur_amount(depth: Array, focal_distance: float, focal_range: float) -> Array:
    """The height map: ``clamp(|focal_distance − depth| − focal_range, 0, 8)``, and 8 for a miss."""
    amount = np.clip(abs(focal_distance - np.float64(depth)) - focal_range, 0, 8)
    return np.where((depth <= 0) | np.isinf(depth), 8, amount)


def gaussian_dof(image: Array, amount: Array) -> Array:
    """Blur with Pascal windows; ``amount`` as from ``blur_amount``, both with the top row first."""
    buffer = np.float64(image)[::-1]  # row 0 at the bottom
    amount = amount[::-1]
    result = buffer.copy()
    for place in np.ndindex(amount.shape):
        k = int(amount[place])
        pascal = comb(2 * k - 1, np.arange(2 * k))
        window = tuple(slice(max(at - k, 0), at + k) for at in place)
        rows, columns = amount[window].shape  # cut off at the border; the weights begin with the first
        weight = np.outer(pascal[:rows], pascal[:columns]) * (amount[window] != 0)
        if weight.any():
            result[place] = np.einsum("yx,yxc->c", weight, buffer[window]) / weight.sum()
    return result[::-1]


def _inside(mask: Array, value: Array, margin: Array) -> Edges:
    """A detector's result; the border, whose windows are not whole, is surely no edge."""
    inner = np.zeros(mask.shape, bool)
    inner[1:-1, 1:-1] = True
    return mask & inner, np.where(inner, value, 0), np.where(inner, margin, np.inf)
