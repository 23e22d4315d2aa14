"""Heavy tails: Pareto shapes of the largest values, which say whether a variance can be known."""

from __future__ import annotations

import math

import numpy as np

# A. Vehtari and others, 2024: above it, rays not met yet may dominate the variance
PARETO_K_THRESHOLD = 0.7
MIN_TAIL_SIZE = 20  # values to which a Pareto law is fitted
MAX_HEAVY_TAIL_SIZE = 25  # values that may share half of the squares of a heavy tail


def tail_shape(values: np.ndarray, counts: np.ndarray) -> float:
    """Return the Pareto shape k of the largest of positive values [N], of which there are ``counts`` each.

    The tail is twice as many values as make up half of the squares, or as many as A. Vehtari and others take
    ("Pareto smoothed importance sampling", 2024), if that is less. Shapes above 1/2 leave half of the squares
    to a few values; where many share it, a mixture of distributions looks like such a tail.
    """
    size = max(_tail_size(int(counts.sum())), 1)
    order = np.argpartition(-values, min(size, len(values) - 1))[: size + 1]
    order = order[np.argsort(-values[order])]
    largest = np.repeat(values[order], counts[order].astype(np.int64))[: size + 1]
    half_of_all = float((counts * values**2).sum()) / 2
    half = int(np.searchsorted(np.cumsum(np.square(largest)), half_of_all)) + 1
    size = min(max(2 * half, MIN_TAIL_SIZE), len(largest) - 1)
    if size < MIN_TAIL_SIZE or largest[0] <= largest[size]:
        return 0.0
    shape, _ = _fit_pareto(largest[size - 1 :: -1] - largest[size])
    return shape if half <= MAX_HEAVY_TAIL_SIZE else min(shape, 0.5)


def exceedance(values: np.ndarray) -> float:
    """Return the probability that the largest value lies as far above the others as it does.

    Over a threshold, a Pareto law fitted to all but the largest makes their squares exponential, and gaps
    between ordered exponential values, each times its rank, are independent and alike (A. Rényi, 1953).
    """
    ordered = np.sort(np.square(values[values > 0]), axis=None)[::-1]
    size = _tail_size(ordered.size)
    if size < MIN_TAIL_SIZE or ordered[0] == ordered[size]:
        return 1.0
    excess = ordered[:size] - ordered[size]
    shape, scale = _fit_pareto(excess[:0:-1], 0)
    shape = max(shape, 1e-3)
    level = np.append(np.log1p(shape * excess / scale) / shape, 0)
    gaps = -np.diff(level) * np.arange(1, size + 1)
    return float((1 + gaps[0] / gaps[1:].sum()) ** (1 - size))


def _tail_size(count: int) -> int:
    """Return the number of values in the tail of ``count``, as A. Vehtari and others choose it."""
    return int(min(0.2 * count, 3 * math.sqrt(count)))


def _fit_pareto(excess: np.ndarray, prior: float = 0.5) -> tuple[float, float]:
    """Return shape and scale of a generalised Pareto law fitted to sorted excesses [N] over a threshold.

    By J. Zhang and M. Stephens (Technometrics 2009), with a prior for the shape worth ten values.
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
    return (total + 10 * prior) / (size + 10), -total / size / best
