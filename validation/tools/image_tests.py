"""Do two noisy pictures show the same? Tests with a stated error rate, and two measures of distance.

``compare`` asks three questions, each with power where the others have little: does any single pixel differ
(a dropped light, a flipped normal), does any tile (a wrong roughness), does the picture as a whole (a scale
of 1.02)? Its ``level`` is the probability to reject equal pictures, over all three questions and all pixels
together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba.errors import UsageError

# Relative size of differences that are float32's: sums in another order and fused operations
ROUNDING = 1e-5

# Keeps black pixels, which no relative error describes, from ruling relRMSE
EPSILON = 1e-2


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
        if self.mean.ndim != 3 or self.mean.shape != self.variance.shape:
            raise UsageError(
                f"mean {self.mean.shape} and variance {self.variance.shape} must both be [H, W, C]"
            )
        if not (
            np.isfinite(self.mean).all() and np.isfinite(self.variance).all() and (self.variance >= 0).all()
        ):
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
class Verdict:
    """The answer to one question: the largest |t|, and the probability of one as large between equal
    pictures."""

    name: str
    statistic: float
    p: float
    level: float

    @property
    def rejects(self) -> bool:
        return self.p < self.level


@dataclass(frozen=True)
class Comparison:
    """The findings of ``compare``. ``z`` [H, W, C]: differences over their standard deviations."""

    pixel: Verdict
    tile: Verdict
    image: Verdict
    rel_rmse: float
    z: np.ndarray

    @property
    def rejects(self) -> bool:
        """Are the pictures different?"""
        return bool(self.detected_by)

    @property
    def detected_by(self) -> tuple[str, ...]:
        """The questions whose answer is that they differ."""
        return tuple(v.name for v in (self.pixel, self.tile, self.image) if v.rejects)

    @property
    def p(self) -> float:
        """Probability of so much difference between equal pictures."""
        return sidak(min(v.p for v in (self.pixel, self.tile, self.image)), 3)


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
    if ours.mean.shape != theirs.mean.shape:
        raise UsageError(
            f"pictures of {ours.mean.shape} and {theirs.mean.shape}: their sizes must be the same"
        )
    each = 1 - (1 - level) ** (1 / 3)
    cells = {"pixel": 1, "tile": tile, "image": max(ours.mean.shape[:2])}
    answers = {name: _welch(ours, theirs, size, rounding) for name, size in cells.items()}
    verdicts = {name: _verdict(name, t, dof, each) for name, (t, dof) in answers.items()}
    distance = rel_rmse(ours.mean, theirs.mean)
    return Comparison(
        verdicts["pixel"], verdicts["tile"], verdicts["image"], rel_rmse=distance, z=answers["pixel"][0]
    )


def sidak(p: float, count: int) -> float:
    """Return the probability 1 - (1 - p)^count that the smallest of ``count`` p values is ``p`` or less."""
    return 1.0 if p >= 1 else float(-np.expm1(count * np.log1p(-p)))


def _welch(ours: Estimate, theirs: Estimate, size: int, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Welch's t and its degrees of freedom, of the sums over cells of ``size`` × ``size`` pixels."""
    difference = _cell_sums(ours.mean - theirs.mean, size)
    brightness = np.maximum(np.abs(ours.mean), np.abs(theirs.mean))
    # Rounding errors of neighbours may all have the same sign: they add up in full. Where a pixel is black,
    # the picture's brightness says what rounding is
    floor = rounding * _cell_sums(brightness + brightness.mean(), size)
    variances = [_cell_sums(e.variance, size) for e in (ours, theirs)]
    total = sum(variances) + floor**2
    # Welch and Satterthwaite: a sum of estimated variances is known as well as these degrees of freedom say
    spread = sum(_cell_sums(e.variance**2 / (e.samples - 1), size) for e in (ours, theirs))
    t = np.divide(difference, np.sqrt(total), out=np.zeros_like(difference), where=total > 0)
    return t, np.divide(total**2, spread, out=np.full_like(total, np.inf), where=spread > 0)


def _cell_sums(values: np.ndarray, size: int) -> np.ndarray:
    """Return sums [rows, columns, C] of cells; the last ones may be smaller."""
    if size == 1:
        return values
    rows = np.add.reduceat(values, np.arange(0, values.shape[0], size), axis=0)
    return np.add.reduceat(rows, np.arange(0, values.shape[1], size), axis=1)


def _verdict(name: str, t: np.ndarray, dof: np.ndarray, level: float) -> Verdict:
    from scipy import stats

    p = 2 * stats.t.sf(np.abs(t), np.maximum(dof, 1))
    return Verdict(name, float(np.abs(t).max()), sidak(float(p.min()), p.size), level)


# ------------------------------------------------ Distances ------------------------------------------------


def rel_rmse(image: ArrayLike, reference: ArrayLike, epsilon: float = EPSILON) -> float:
    """Return the relative root mean square error √mean((a - b)² / (b² + ε))."""
    a, b = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if a.shape != b.shape:
        raise UsageError(f"pictures of {a.shape} and {b.shape}: their sizes must be the same")
    return float(np.sqrt(np.mean((a - b) ** 2 / (b**2 + epsilon))))


@dataclass(frozen=True)
class Flip:
    """FLIP's perceived difference: ``map`` [H, W] in [0, 1], its mean, and the exposures it was seen at."""

    map: np.ndarray
    mean: float
    exposures: Mapping[str, float]


def flip(reference: ArrayLike, image: ArrayLike, *, exposures: Mapping[str, float] | None = None) -> Flip:
    """Return HDR-FLIP of a linear picture [H, W, 3] against a reference (Andersson et al. 2021).

    ``exposures``: those of an earlier result. FLIP derives them from the reference, so within a series they
    must be given, or its values cannot be compared.

    Raises ``UsageError`` for what cannot be compared.
    """
    import flip_evaluator

    pictures = [np.ascontiguousarray(p, np.float32) for p in (reference, image)]
    _check_for_flip(*pictures)
    parameters: dict[str, Any] = dict(exposures or {})
    try:
        found, mean, used = flip_evaluator.evaluate(*pictures, "HDR", applyMagma=False, parameters=parameters)
    except SystemExit as error:  # its answer to arguments that it does not like
        raise UsageError(f"FLIP refused its arguments: exposures={exposures}") from error
    kept = {name: used[name] for name in ("startExposure", "stopExposure", "numExposures")}
    return Flip(np.asarray(found)[..., 0] if np.ndim(found) == 3 else np.asarray(found), float(mean), kept)


def _check_for_flip(reference: np.ndarray, image: np.ndarray) -> None:
    if reference.shape != image.shape or reference.ndim != 3 or reference.shape[-1] != 3:
        raise UsageError(
            f"FLIP compares two pictures [H, W, 3] of one size, not {reference.shape} and {image.shape}"
        )
    for name, picture in (("reference", reference), ("image", image)):
        if not np.isfinite(picture).all() or (picture < 0).any():
            raise UsageError(f"FLIP needs finite values >= 0; the {name} has others")
    if not reference.any():
        raise UsageError("FLIP takes its exposures from the reference, which is black")
