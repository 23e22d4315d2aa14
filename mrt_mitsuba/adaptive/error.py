"""Estimates that a render makes of its own error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Image = NDArray[np.float32]


# Above this Pareto shape, a variance is unknown: rays not met yet may rule it (A. Vehtari and others, 2024)
DOUBTFUL = 0.7
FEWEST = 20  # values that show a shape
MANY = 25  # values that are many to share half of the squares


@dataclass(frozen=True)
class ErrorEstimate:
    """The RMSE of a picture to the converged one, linear, over pixels and colours, with a 95 % interval."""

    rmse: float
    low: float
    high: float  #: infinite where the tail is too heavy to say
    tail: float = 0.0  #: Pareto shape k of the largest contributions of rays, see ``DOUBTFUL``
    target: float | None = None  #: that the render aimed at, linear; None without one

    def __str__(self) -> str:
        return f"{self.rmse:.3g} (95 %: {self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class Round:
    """The state of a render after a round: a point of its error over its time."""

    seconds: float  #: since the render began
    spp: float  #: mean rays of a pixel
    rmse: float  #: estimated, see ``ErrorEstimate``


@dataclass(frozen=True)
class RoundPicture(Round):
    """A round with its picture, as ``on_round`` gets it."""

    image: Image  #: [H, W, 3], linear
    error: Image  #: standard error of each pixel, [H, W]
    samples: Image  #: rays of each pixel, [H, W]
    target: float | None = None  #: RMSE that the render aims at


def tail_shape(values: np.ndarray, counts: np.ndarray) -> float:
    """The Pareto shape k of the largest of some values [N], positive, each there as often as ``counts`` says.

    The largest are twice as many as make up half of the squares, or as many as A. Vehtari and others take
    ("Pareto smoothed importance sampling", 2024), if that is less: of more, most would not matter. Shapes
    above 1/2 leave half of the squares to a few; where it takes many, a mixture looks like such a tail.
    """
    size = max(_of_tail(int(counts.sum())), 1)
    order = np.argpartition(-values, min(size, len(values) - 1))[: size + 1]
    order = order[np.argsort(-values[order])]
    largest = np.repeat(values[order], counts[order].astype(np.int64))[: size + 1]
    half_of_all = float((counts * values**2).sum()) / 2
    half = int(np.searchsorted(np.cumsum(np.square(largest)), half_of_all)) + 1
    size = min(max(2 * half, FEWEST), len(largest) - 1)
    if size < FEWEST or largest[0] <= largest[size]:
        return 0.0
    shape, _ = _pareto(largest[size - 1 :: -1] - largest[size])
    return shape if half <= MANY else min(shape, 0.5)


def exceedance(values: np.ndarray) -> float:
    """The probability that the largest of some values is as far above the others as it is.

    Over a threshold, a Pareto law that all but the largest decide makes their squares exponential, and gaps
    between ordered exponential values, each times its rank, are independent and alike (A. Rényi, 1953).
    """
    ordered = np.sort(np.square(values[values > 0]), axis=None)[::-1]
    size = _of_tail(ordered.size)
    if size < FEWEST or ordered[0] == ordered[size]:
        return 1.0
    excess = ordered[:size] - ordered[size]
    shape, scale = _pareto(excess[:0:-1], 0)
    shape = max(shape, 1e-3)
    level = np.append(np.log1p(shape * excess / scale) / shape, 0)
    gaps = -np.diff(level) * np.arange(1, size + 1)
    return float((1 + gaps[0] / gaps[1:].sum()) ** (1 - size))


def _of_tail(count: int) -> int:
    """The number of values that A. Vehtari and others take for the tail of so many."""
    return int(min(0.2 * count, 3 * math.sqrt(count)))


def _pareto(excess: np.ndarray, usual: float = 0.5) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution, from the sorted excesses [N] over a threshold.

    The fit of J. Zhang and M. Stephens (Technometrics 2009), drawn to the usual shape as by ten values.
    """
    size, most = len(excess), excess[-1]
    grid = 30 + math.isqrt(size)
    quarter = max(excess[int(size / 4 + 0.5) - 1], 1e-9 * most)
    slope = (1 - np.sqrt(grid / (np.arange(grid) + 0.5))) / (3 * quarter) + 1 / most
    slope = slope[np.abs(slope) * most > 1e-9]  # 0 is the exponential law, and 0/0 below
    shape = np.log1p(-slope[:, None] * excess).mean(1)
    likelihood = size * (np.log(-slope / shape) - shape - 1)
    best = float(np.average(slope, weights=np.exp(likelihood - likelihood.max())))
    total = float(np.log1p(-best * excess).sum())
    return (total + 10 * usual) / (size + 10), -total / size / best
