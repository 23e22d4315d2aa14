"""Windows around the pixels of pictures [..., H, W], cut at the border."""

from __future__ import annotations

import numpy as np


def window_means(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the means over windows of ``reach`` pixels, a power of two, to each side.

    Sums of 1, 2, 4, ... neighbours are each formed of the last ones, without differences that would cancel.
    """
    for axis in (-2, -1):
        count = values.shape[axis]
        wide = np.moveaxis(values, axis, 0)
        nothing = np.zeros_like(wide[:1]).repeat(reach, 0)
        wide = sums = np.concatenate([nothing, wide, nothing])
        step = 1
        while step <= reach:
            sums, step = sums[:-step] + sums[step:], 2 * step
        sums = sums[:count] + wide[2 * reach :]
        place = np.arange(count)
        counts = np.minimum(place + reach, count - 1) - np.maximum(place - reach, 0) + 1
        sums /= counts.astype(values.dtype).reshape(-1, *[1] * (sums.ndim - 1))
        values = np.moveaxis(sums, 0, axis)
    return values


def dilated(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return where a mask is true within so many pixels along both axes."""
    for axis in (-2, -1):
        mask, near = mask.copy(), np.moveaxis(mask, axis, 0)
        wide = np.moveaxis(mask, axis, 0)  # a view
        for step in range(1, reach + 1):
            wide[step:] |= near[:-step]
            wide[:-step] |= near[step:]
    return mask
