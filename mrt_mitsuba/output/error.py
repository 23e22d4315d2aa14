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
RULING = 0.25  # share of the squares that the largest have at least, if they are that heavy


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

    How many are the largest is given by A. Vehtari and others, "Pareto smoothed importance sampling" (2024).
    A few rare ones are lost among so many; so it is the shape of the largest 1/16 or 1/4 where that is more.
    Values without a variance leave most of the sum of squares to the largest. Where those have little of it, a
    shape above 1/2 is that of a mixture (some pixels are noisier than others), and says nothing.
    """
    count, total = int(counts.sum()), float((counts * values**2).sum())
    size = int(min(0.2 * count, 3 * math.sqrt(count)))
    order = np.argsort(values)[::-1]
    order = order[: np.searchsorted(np.cumsum(counts[order]), size + 1) + 1]
    largest = np.repeat(values[order], counts[order].astype(np.int64))[: size + 1]
    found = [0.0]
    for n in (size // 16, size // 4, size):
        if n >= 10 and largest[0] > largest[n]:
            ruling = float(np.square(largest[:n]).sum()) > RULING * total
            shape = _shape(largest[n - 1 :: -1] - largest[n])
            found.append(shape if ruling else min(shape, 0.5))
    return max(found)


def _shape(excess: np.ndarray) -> float:
    """Return the shape of a generalised Pareto distribution, given what exceeds its threshold, ascending.

    The fit of J. Zhang and M. Stephens (Technometrics 2009), drawn to 1/2 by as much as ten values weigh.
    """
    size, most = len(excess), excess[-1]
    grid = 30 + math.isqrt(size)
    quarter = max(excess[int(size / 4 + 0.5) - 1], 1e-9 * most)
    slope = (1 - np.sqrt(grid / (np.arange(grid) + 0.5))) / (3 * quarter) + 1 / most
    shape = np.log1p(-slope[:, None] * excess).mean(1)
    likelihood = size * (np.log(-slope / shape) - shape - 1)
    best = float(np.average(slope, weights=np.exp(likelihood - likelihood.max())))
    return float((np.log1p(-best * excess).sum() + 10 * 0.5) / (size + 10))
