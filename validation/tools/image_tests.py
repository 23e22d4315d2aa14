"""Do two noisy pictures show the same? Tests with a stated error rate, and two measures of distance.

``compare`` asks three questions, each with power where the others have little: does any single pixel differ
(a dropped light, a flipped normal), does any tile (a wrong roughness), does the picture as a whole (a scale
of 1.02)? Its ``level`` is the probability to reject equal pictures, over all three questions and all pixels
together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba.errors import UsageError

# Relative size of differences that are float32's: sums in another order and fused operations
ROUNDING = 1e-5
# Keeps black pixels, which no relative error describes, from ruling relRMSE
EPSILON = 1e-2
QUESTIONS = ("pixel", "tile", "image")


@dataclass(frozen=True)
class Estimate:
    """A picture with noise: mean and variance *of the mean*, both [H, W, C].

    ``samples``: how many independent renders the variance was estimated from, for all pixels or [H, W, 1];
    infinite if it is known, as for a picture without noise, whose variance is 0.
    """

    mean: np.ndarray
    variance: np.ndarray
    samples: np.ndarray | float = np.inf

    def __post_init__(self) -> None:
        mean, variance = self.mean, self.variance
        if mean.ndim != 3 or mean.shape != variance.shape:
            raise UsageError(f"mean {mean.shape} and variance {variance.shape} must both be [H, W, C]")
        if not (np.isfinite(mean).all() and np.isfinite(variance).all() and (variance >= 0).all()):
            raise UsageError("an estimate holds infinite or undefined values, or a negative variance")
        if np.min(self.samples) < 2:
            raise UsageError(f"samples={self.samples}: a variance needs at least two independent renders")


def estimate(renders: ArrayLike) -> Estimate:
    """Return the mean of N ≥ 2 independent renders [N, H, W, C] of equal sample count, with its variance."""
    stack = np.asarray(renders, np.float64)
    if stack.ndim != 4 or len(stack) < 2:
        raise UsageError(f"renders of shape {stack.shape}: give two or more pictures as [N, H, W, C]")
    return Estimate(stack.mean(axis=0), stack.var(axis=0, ddof=1) / len(stack), len(stack))


def exact(image: ArrayLike) -> Estimate:
    """Return a picture [H, W, C] without noise."""
    mean = np.asarray(image, np.float64)
    return Estimate(mean, np.zeros_like(mean))


@dataclass(frozen=True)
class Comparison:
    """The findings of ``compare``, by question: the largest |t|, and the probability of one as large between
    equal pictures. ``z`` [H, W, C]: differences over their standard deviations."""

    t: Mapping[str, float]
    p_values: Mapping[str, float]
    level: float
    rel_rmse: float
    z: np.ndarray

    @property
    def rejects(self) -> bool:
        """Are the pictures different?"""
        return bool(self.detected_by)

    @property
    def detected_by(self) -> tuple[str, ...]:
        """The questions whose answer is that they differ; each has its part of the level."""
        each = 1 - (1 - self.level) ** (1 / len(QUESTIONS))
        return tuple(name for name, p in self.p_values.items() if p < each)

    @property
    def p(self) -> float:
        """Probability of so much difference between equal pictures."""
        return sidak(min(self.p_values.values()), len(QUESTIONS))


def compare(
    ours: Estimate, theirs: Estimate, *, level: float = 1e-3, tile: int = 16, rounding: float = ROUNDING
) -> Comparison:
    """Test whether two estimates are of the same picture.

    Welch's t-test with Šidák's correction for the number of values, on single pixels, on means of ``tile`` ×
    ``tile`` pixels and on the mean of the picture, each channel by itself. Noise must be independent between
    pixels. Means of few very skewed samples (fireflies) are not normal: average enough samples in each render
    first. ``rounding``: relative differences that are none.

    Raises ``UsageError`` for estimates of different shapes.
    """
    from scipy import stats

    distance = rel_rmse(ours.mean, theirs.mean)
    brightness = np.maximum(np.abs(ours.mean), np.abs(theirs.mean))
    largest, p_values, by_question = {}, {}, []
    for name, size in zip(QUESTIONS, (1, tile, max(ours.mean.shape[:2])), strict=True):
        difference = _cell_sums(ours.mean - theirs.mean, size)
        # Rounding errors of neighbours may all have the same sign: they add up in full. Where a pixel is
        # black, the picture's brightness says what rounding is
        floor = rounding * _cell_sums(brightness + brightness.mean(), size)
        total = sum(_cell_sums(e.variance, size) for e in (ours, theirs)) + floor**2
        # Welch and Satterthwaite: a sum of estimated variances is known as well as these degrees of freedom
        spread = sum(_cell_sums(e.variance**2 / (e.samples - 1), size) for e in (ours, theirs))
        t = np.divide(difference, np.sqrt(total), out=np.zeros_like(difference), where=total > 0)
        freedom = np.divide(total**2, spread, out=np.full_like(total, np.inf), where=spread > 0)
        p = 2 * stats.t.sf(np.abs(t), np.maximum(freedom, 1))
        largest[name], p_values[name] = float(np.abs(t).max()), sidak(float(p.min()), p.size)
        by_question.append(t)
    return Comparison(largest, p_values, level, distance, z=by_question[0])


def p_of_means(difference: np.ndarray, size: int) -> float:
    """Return the probability of the differences [H, W] between equal pictures, by Student's test of the means
    over cells of ``size`` × ``size`` pixels, whose noise is independent and as often positive as negative."""
    from scipy import stats

    values = np.stack([np.ones_like(difference), difference, difference**2], axis=-1)
    count, total, square = np.moveaxis(_cell_sums(values, size), -1, 0)
    spread = np.sqrt(np.maximum(count * square - total**2, 0) / np.maximum(count - 1, 1))
    t = np.divide(total, spread, out=np.where(total == 0, 0, np.inf), where=spread > 0)
    p = 2 * stats.t.sf(np.abs(t), count - 1)[(count > 1) & (square > 0)]
    return sidak(float(p.min(initial=1)), p.size)


def sidak(p: float, count: int) -> float:
    """Return the probability 1 - (1 - p)^count that the smallest of ``count`` p values is ``p`` or less."""
    return 1.0 if p >= 1 else float(-np.expm1(count * np.log1p(-p)))


def _cell_sums(values: np.ndarray, size: int) -> np.ndarray:
    """Return sums [rows, columns, C] of cells of ``size`` × ``size`` pixels; the last ones may be smaller."""
    if size == 1:
        return values
    rows = np.add.reduceat(values, np.arange(0, values.shape[0], size), axis=0)
    return np.add.reduceat(rows, np.arange(0, values.shape[1], size), axis=1)


# ------------------------------------------------ Distances ------------------------------------------------


def rel_rmse(image: ArrayLike, reference: ArrayLike) -> float:
    """Return the relative root mean square error √mean((a - b)² / (b² + ε))."""
    a, b = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if a.shape != b.shape:
        raise UsageError(f"pictures of {a.shape} and {b.shape}: their sizes must be the same")
    return float(np.sqrt(np.mean((a - b) ** 2 / (b**2 + EPSILON))))


def flip(reference: ArrayLike, image: ArrayLike) -> float:
    """Return HDR-FLIP of a linear picture [H, W, 3] against a reference (Andersson et al. 2021): the mean of
    the perceived difference, from 0 to 1.

    It derives exposures from the reference. Raises ``UsageError`` for what cannot be compared.
    """
    import flip_evaluator

    a, b = (np.ascontiguousarray(p, np.float32) for p in (reference, image))
    if a.shape != b.shape or a.ndim != 3 or a.shape[-1] != 3:
        raise UsageError(f"FLIP compares two pictures [H, W, 3] of one size, not {a.shape} and {b.shape}")
    for name, picture in (("reference", a), ("image", b)):
        if not np.isfinite(picture).all() or (picture < 0).any():
            raise UsageError(f"FLIP needs finite values >= 0; the {name} has others")
    if not a.any():
        raise UsageError("FLIP takes its exposures from the reference, which is black")
    return float(flip_evaluator.evaluate(a, b, "HDR", applyMagma=False, parameters={})[1])
