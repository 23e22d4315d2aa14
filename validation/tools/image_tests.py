"""Do two sets of noisy renders show the same picture? Tests with a stated error rate."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba.errors import UsageError

# Relative size of differences that are float32's: sums in another order and fused operations
ROUNDING = 1e-5


def p_values(ours: ArrayLike, theirs: ArrayLike, *, tile: int = 16) -> dict[str, float]:
    """Compare two sets of two or more independent renders [N, H, W, C].

    Return the p values of three questions, each with power where the others have little: does any single
    "pixel" differ (a dropped light, a flipped normal), does any "tile" of ``tile`` × ``tile`` pixels (a wrong
    roughness), does the whole "image" (a scale of 1.02)? By Welch's t-test with Šidák's correction for
    all that is asked: of equal pictures, the least of the three is below a level as often as the level says.
    Differences of a relative size of ``ROUNDING`` do not count.
    """
    from scipy import stats

    sides = [np.asarray(renders, np.float64) for renders in (ours, theirs)]
    if any(s.ndim != 4 or len(s) < 2 or s.shape[1:] != sides[0].shape[1:] for s in sides):
        shapes = " and ".join(str(s.shape) for s in sides)
        raise UsageError(f"renders of shape {shapes}: give two or more of each, [N, H, W, C], of one size")
    if not all(np.isfinite(s).all() for s in sides):
        raise UsageError("renders hold infinite or undefined values")
    light = np.maximum(*(np.abs(s.mean(axis=0)) for s in sides))
    sizes, found = {"pixel": 1, "tile": tile, "image": max(light.shape)}, {}
    for name, size in sizes.items():
        floor = ROUNDING * cell_sums(light + light.mean(), size) + 1e-30
        of_each: list[Any] = []  # mean, standard deviation, count
        for s in (cell_sums(side, size) for side in sides):
            of_each += [s.mean(axis=0), np.sqrt(s.var(axis=0, ddof=1) + len(s) / 2 * floor**2), len(s)]
        p = stats.ttest_ind_from_stats(*of_each, equal_var=False).pvalue
        found[name] = sidak(float(p.min()), p.size * len(sizes))
    return found


def sidak(p: float, count: int) -> float:
    """Return the probability 1 - (1 - p)^count that the smallest of ``count`` p values is ``p`` or less."""
    return 1.0 if p >= 1 else float(-np.expm1(count * np.log1p(-p)))


def cell_sums(values: np.ndarray, size: int) -> np.ndarray:
    """Return the sums [..., rows, columns, C] over cells of ``size`` × ``size`` pixels."""
    for axis in (-3, -2):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)
    return values
