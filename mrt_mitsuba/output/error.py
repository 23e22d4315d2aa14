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


@dataclass(frozen=True)
class ErrorEstimate:
    """The RMSE of a picture to the converged one, linear, over pixels and colours, with a 95 % interval."""

    rmse: float
    low: float
    high: float  #: infinite where the tail is too heavy to say
    tail: float = 0.0  #: Pareto shape k of the largest contributions of rays, see ``DOUBTFUL``

    @classmethod
    def of(cls, rmse: float, spread: float, tail: float) -> ErrorEstimate:
        """Return an error whose square has this relative deviation."""
        width = 1.96 * spread / 2
        high = rmse * math.exp(width * (1 + spread)) if tail <= DOUBTFUL else math.inf
        return cls(rmse, rmse * math.exp(-width), high, tail)

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


def tail_shape(values: np.ndarray, counts: np.ndarray) -> float:
    """Return the Pareto shape k of the largest of some values, each there so many times.

    How many of the largest, and the pull of a few towards 1/2, are those of A. Vehtari and others; the fit of
    the generalised Pareto distribution is that of J. Zhang and M. Stephens, Technometrics 2009.
    """
    count = int(counts.sum())
    size = int(min(0.2 * count, 3 * math.sqrt(count)))
    order = np.argsort(values)[::-1]
    order = order[: np.searchsorted(np.cumsum(counts[order]), size + 1) + 1]
    largest = np.repeat(values[order], counts[order].astype(np.int64))[: size + 1]
    excess = largest[-2::-1] - largest[-1]
    if size < 5 or excess[-1] <= 0:
        return 0.0
    grid = 30 + math.isqrt(size)
    quarter = max(excess[int(size / 4 + 0.5) - 1], 1e-9 * excess[-1])
    slope = (1 - np.sqrt(grid / (np.arange(grid) + 0.5))) / (3 * quarter) + 1 / excess[-1]
    shape = np.log1p(-slope[:, None] * excess).mean(1)
    likelihood = size * (np.log(-slope / shape) - shape - 1)
    weight = np.exp(likelihood - likelihood.max())
    slope = float(np.average(slope, weights=weight))
    return float((np.log1p(-slope * excess).sum() + 10 * 0.5) / (size + 10))
