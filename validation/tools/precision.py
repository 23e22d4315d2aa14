"""Findings about error against time: the figures of each case, what they answer, and how sure it is.

The pictures x₁ … x_R of a case and two independent halves h₁, h₂ of the reference give the matrix G[r, s] =
mean (x_r − h₁)(x_s − h₂), in which the reference's own noise cancels. The mean of its diagonal is the squared
error, that of the rest the squared bias; the difference is the variance.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from mrt_mitsuba.validation.tools.compare import Difference

RESOLVED = 2.0  # times the reference's own error from which on an error can be distinguished from it
NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?:/\d+)?"
NOTHING = 1e-15  # an RMSE of 0, as logarithms have it
LEVEL = 0.95
RESAMPLES = 999
FAR = 1e100  # stands for infinity and NaN in resamples: scipy takes their mean

Options = Mapping[str, Any]
Interval = tuple[float, float]
Panel = tuple[str, float, np.ndarray]  # name, seconds and picture of what a curve reaches in some time
Strip = tuple[float, Sequence[Panel]]  # that time, and a panel of each curve


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
    if not log:
        low, high = value - reach * finite.std(), value + reach * finite.std()
    elif not len(finite):
        low, high = np.inf, np.inf
    elif not (finite > 0).all():
        low, high = 0.0, finite.max()
    else:  # around the value, or where that is infinite around the finite resamples
        logs = np.log(finite)
        centre = np.log(value) if np.isfinite(value) else logs.mean()
        low, high = np.exp(centre - reach * logs.std()), np.exp(centre + reach * logs.std())
    never = log and len(finite) < (1 + LEVEL) / 2 * len(found)
    return Estimate(value, float(low), np.inf if never else float(high))


@dataclass(frozen=True)
class Point:
    """One case: what it costs and how far off it is."""

    name: str
    options: Options
    times: np.ndarray  #: seconds of each repeat, warm, without loading the scene
    gram: np.ndarray  #: G[r, s], see above
    cold: float  #: seconds of a first run, its kernels compiled or read from a cache
    compile: float  #: seconds of that in the compiler
    rays: Mapping[str, int]
    image: np.ndarray  #: of the first repeat
    difference: Difference  #: of it from the reference
    reference_error: float

    @property
    def family(self) -> str:
        """The name without its numbers: cases that differ in these alone are one curve."""
        bare = re.sub(rf"(\w+=)?{NUMBER}", " ", self.name).split()
        return " ".join(bare or re.sub(f"=?{NUMBER}", " ", self.name).split()) or self.name

    @cached_property
    def time(self) -> Estimate:
        return estimate(len(self.times), lambda index: np.median(self.times[index], axis=-1))

    @cached_property
    def error(self) -> Estimate:
        return estimate(len(self.times), self.rmse_of)

    @cached_property
    def bias_squared(self) -> Estimate:
        """By pairs of different repeats; of one repeat, or resamples of the same one, NaN."""

        def of(index: np.ndarray) -> np.ndarray:
            other = index[..., :, None] != index[..., None, :]
            total = np.where(other, self.gram[index[..., :, None], index[..., None, :]], 0).sum(axis=(-2, -1))
            count = other.sum(axis=(-2, -1))
            return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)

        return estimate(len(self.times), of, log=False)

    def rmse_of(self, index: np.ndarray) -> np.ndarray:
        """Return the RMSE over some repeats, [..., repeats] of them."""
        return np.sqrt(np.maximum(np.diag(self.gram)[index].mean(axis=-1), NOTHING**2))

    @property
    def seconds(self) -> float:
        return self.time.value

    @property
    def seconds_interval(self) -> Interval:
        return self.time.low, self.time.high

    @property
    def rmse(self) -> float:
        return self.error.value if self.error.value > NOTHING else 0.0

    @property
    def rmse_interval(self) -> Interval:
        return self.error.low, self.error.high

    @property
    def variance(self) -> float:
        """Mean variance of a pixel between repeats; NaN for one repeat."""
        return max(0.0, float(np.diag(self.gram).mean()) - self.bias_squared.value)

    @property
    def bias(self) -> float:
        """Absolute bias, √(MSE − variance), 0 where noise explains the whole error; NaN for one repeat."""
        return float(np.sqrt(np.maximum(self.bias_squared.value, 0)))

    @property
    def bias_interval(self) -> Interval:
        low, high = np.sqrt(np.maximum((self.bias_squared.low, self.bias_squared.high), 0))
        return float(low), float(high)

    @property
    def efficiency(self) -> float:
        """1 / (variance × seconds); NaN where nothing is random or there is one repeat."""
        product = self.variance * self.seconds
        return 1 / product if product > 1e-12 * self.rmse**2 * self.seconds else float("nan")

    @property
    def resolved(self) -> bool:
        """Return whether the error can be distinguished from the reference's own."""
        return self.rmse > RESOLVED * self.reference_error


@dataclass(frozen=True)
class Findings:
    """The findings about several cases."""

    scene: str
    points: Mapping[str, Point]
    failed: Mapping[str, str]  #: why, by case
    reference: np.ndarray
    reference_error: float  #: RMSE of the reference itself, below which nothing is claimed; 0: exact
    repeats: int
    errors: Sequence[float]  #: for which the time is given
    strips: Sequence[Strip] = field(default_factory=list)
    took: float = 0.0

    @property
    def families(self) -> dict[str, list[Point]]:
        """The points of each curve, fastest first."""
        groups: dict[str, list[Point]] = {}
        for point in sorted(self.points.values(), key=lambda p: p.seconds):
            groups.setdefault(point.family, []).append(point)
        return {name: groups[name] for name in dict.fromkeys(p.family for p in self.points.values())}

    def time_to(self, error: float) -> dict[str, Estimate]:
        """Return the seconds in which each curve comes down to an RMSE; infinite where it never does.

        Between measured cases the curve is a straight line in logarithms; beyond them nothing is assumed.
        """
        error *= 1 + 1e-9  # an error that is met to rounding is met

        def crossing(points: Sequence[Point], index: np.ndarray) -> np.ndarray:
            seconds = np.stack([np.median(p.times[index], axis=-1) for p in points])  # [points, ...]
            rmse = np.stack([p.rmse_of(index) for p in points])
            found = np.where(rmse[0] <= error, seconds[0], np.inf)
            for i in range(1, len(points)):
                ends = np.log([rmse[i - 1], rmse[i]])
                steps = np.where(ends[0] > ends[1], ends[0] - ends[1], 1)
                share = np.clip((ends[0] - np.log(error)) / steps, 0, 1)
                between = seconds[i - 1] ** (1 - share) * seconds[i] ** share
                found = np.where(np.isinf(found) & (rmse[i] <= error), between, found)
            return found

        return {
            name: estimate(self.repeats, partial(crossing, points)) for name, points in self.families.items()
        }

    @cached_property
    def times(self) -> dict[float, dict[str, Estimate]]:
        """``time_to`` of each of ``errors``."""
        return {error: self.time_to(error) for error in self.errors}

    @cached_property
    def verdicts(self) -> list[str]:
        """A sentence for each of ``errors``; it names a winner only if its interval meets no other."""
        if self.repeats < 2:
            return ["No verdict on time: a single repeat has no interval."]
        sentences = []
        for error, times in self.times.items():
            reached = sorted((time.value, name) for name, time in times.items() if np.isfinite(time.value))
            best = reached[0][1] if reached else ""
            like = [name for _, name in reached[1:] if times[name].overlaps(times[best])]
            if not reached:
                verdict = "no case comes so low"
            elif like:
                verdict = f"no winner, for the intervals overlap: {', '.join([best, *like])}"
            elif len(reached) == 1:
                verdict = f"only {best} comes so low, in {times[best]} s"
            else:
                verdict = f"{best} is the fastest, {times[best]} s; {reached[1][1]} takes "
                verdict += f"{reached[1][0] / reached[0][0]:.2g} times as long"
            sentences.append(f"RMSE of {error:g}: {verdict}.")
        return sentences

    def __str__(self) -> str:
        width = max(map(len, [*self.points, *self.failed]), default=0)
        lines = [f"{p.name:<{width}}  {p.time} s, RMSE {p.error}" for p in self.points.values()]
        lines += [f"{name:<{width}}  FAILED {why}" for name, why in self.failed.items()]
        own = f"{self.reference_error:.2g}" if self.reference_error else "not known"
        return "\n".join([*lines, f"the reference's own error: {own}", *self.verdicts])
