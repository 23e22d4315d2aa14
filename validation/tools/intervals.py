"""Intervals of statistics of few repeats, by bootstrap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95
RESAMPLES = 999
FAR = 1e100  # stands for infinity and NaN in resamples: scipy takes their mean


@dataclass(frozen=True)
class Estimate:
    """A value with its interval; NaN where nothing is known, infinite where it is never reached."""

    value: float
    low: float
    high: float

    def overlaps(self, other: Estimate) -> bool:
        """Return whether the intervals share a value; NaN shares all."""
        return not (self.high < other.low or other.high < self.low)

    def __str__(self) -> str:
        if np.isnan(self.low):
            return f"{self.value:.3g}"
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


def estimate(count: int, statistic: Callable[[np.ndarray], np.ndarray], *, log: bool = True) -> Estimate:
    """Return a statistic of ``count`` repeats with its 95 % interval.

    ``statistic`` gets indices [..., repeats] and returns one value for each row of them. Its standard error
    is that of a bootstrap over repeats, times √(n/(n−1)), for resamples of so few spread too little; the
    interval is Student's, so for a mean it is the classical one. ``log``: of a positive quantity, taken in
    logarithms. NaN for a single repeat. Where some resamples never reach a value, the interval is open.
    """
    from scipy import stats

    value = float(statistic(np.arange(count)[None])[0])
    if count < 2:
        return Estimate(value, np.nan, np.nan)
    found = stats.bootstrap(
        (np.arange(count),),
        lambda index, axis=-1: np.nan_to_num(statistic(index), nan=FAR, posinf=FAR),
        n_resamples=RESAMPLES,
        method="percentile",
        vectorized=True,
        random_state=np.random.default_rng(count),
    ).bootstrap_distribution
    finite = found[found < FAR]
    reach = stats.t.ppf((1 + LEVEL) / 2, count - 1) * np.sqrt(count / (count - 1))
    low, high = _around(value, finite, reach, log)
    never = log and len(finite) < (1 + LEVEL) / 2 * len(found)
    return Estimate(value, low, np.inf if never else high)


def _around(value: float, found: np.ndarray, reach: float, log: bool) -> tuple[float, float]:
    """Return the ends of an interval around a value, or around the finite ones of its resamples."""
    if len(found) == 0:
        return np.inf, np.inf
    if not log:
        return value - reach * found.std(), value + reach * found.std()
    if not (found > 0).all():
        return 0.0, float(found.max())
    logs = np.log(found)
    centre = np.log(value) if np.isfinite(value) else logs.mean()
    return float(np.exp(centre - reach * logs.std())), float(np.exp(centre + reach * logs.std()))
