"""Do two sets of noisy renders show the same picture? Tests with a stated error rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba.errors import UsageError

# Relative size of differences that are float32's: sums in another order and fused operations
ROUNDING = 1e-5
# Keeps black pixels, which no relative error describes, from ruling it
EPSILON = 1e-2


@dataclass(frozen=True)
class Comparison:
    """The findings of ``compare``: for each question the largest |t|, and the probability of one as large
    between equal pictures."""

    t: Mapping[str, float]
    p_values: Mapping[str, float]
    level: float
    rel_rmse: float  #: √mean((a − b)² / (b² + 0.01)) of the means

    @property
    def rejects(self) -> bool:
        """Are the pictures different?"""
        return bool(self.detected_by)

    @property
    def detected_by(self) -> tuple[str, ...]:
        """The questions whose answer is that they differ; each has its part of the level."""
        return tuple(name for name, p in self.p_values.items() if sidak(p, len(self.p_values)) < self.level)

    @property
    def p(self) -> float:
        """Probability of so much difference between equal pictures."""
        return sidak(min(self.p_values.values()), len(self.p_values))


def compare(ours: ArrayLike, theirs: ArrayLike, *, level: float = 1e-3, tile: int = 16) -> Comparison:
    """Test whether two sets of two or more independent renders [N, H, W, C] are of the same picture.

    Three questions, each with power where the others have little: does any single pixel differ (a dropped
    light, a flipped normal), does any tile of ``tile`` × ``tile`` pixels (a wrong roughness), does the whole
    (a scale of 1.02)? ``level`` is the probability to reject equal pictures, over all of them together:
    Welch's t-test with Šidák's correction. Differences of a relative size of ``ROUNDING`` do not count.
    """
    from scipy import stats

    sides = [np.asarray(renders, np.float64) for renders in (ours, theirs)]
    if any(s.ndim != 4 or len(s) < 2 or s.shape[1:] != sides[0].shape[1:] for s in sides):
        shapes = " and ".join(str(s.shape) for s in sides)
        raise UsageError(f"renders of shape {shapes}: give two or more of each, [N, H, W, C], of one size")
    if not all(np.isfinite(s).all() for s in sides):
        raise UsageError("renders hold infinite or undefined values")
    means = [s.mean(axis=0) for s in sides]
    light = np.maximum(*np.abs(means))
    largest, p_values = {}, {}
    for name, size in (("pixel", 1), ("tile", tile), ("image", max(light.shape))):
        floor = ROUNDING * cell_sums(light + light.mean(), size) + 1e-30
        sums = [cell_sums(s, size) for s in sides]
        of_each: list[Any] = []  # mean, standard deviation, count
        for s in sums:
            of_each += [s.mean(axis=0), np.sqrt(s.var(axis=0, ddof=1) + len(s) / 2 * floor**2), len(s)]
        t, p = stats.ttest_ind_from_stats(*of_each, equal_var=False)
        largest[name], p_values[name] = float(np.abs(t).max()), sidak(float(p.min()), p.size)
    relative = (means[0] - means[1]) ** 2 / (means[1] ** 2 + EPSILON)
    return Comparison(largest, p_values, level, float(np.sqrt(relative.mean())))


def sidak(p: float, count: int) -> float:
    """Return the probability 1 - (1 - p)^count that the smallest of ``count`` p values is ``p`` or less."""
    return 1.0 if p >= 1 else float(-np.expm1(count * np.log1p(-p)))


def cell_sums(values: np.ndarray, size: int) -> np.ndarray:
    """Return the sums [..., rows, columns, C] over cells of ``size`` × ``size`` pixels."""
    for axis in (-3, -2):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)
    return values
