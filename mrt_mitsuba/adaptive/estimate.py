"""Statistics of the rays of four buffers, and the error that they let one estimate.

Two *half* buffers are averaged: their mean is the picture, and their difference estimates its error, whatever
integrator, sampler and filter are at work. Two *pilot* buffers of few rays are not averaged: they decide how
many further rays each pixel gets, see ``allocate.py``.

A few rays estimate a pixel's variance badly, so each pixel borrows from windows around it, in the mixture
that explains best what other rays measure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mrt_mitsuba.adaptive.error import ErrorEstimate
from mrt_mitsuba.adaptive.metric import LINEAR, Metric
from mrt_mitsuba.adaptive.tails import PARETO_K_THRESHOLD, tail_shape
from mrt_mitsuba.filters.dof import REACH
from mrt_mitsuba.filters.grid import dilated, window_means
from mrt_mitsuba.rendering.exposing import FilmAccumulator
from mrt_mitsuba.rendering.film import Film

HALVES, PILOTS = [0, 1], [2, 3]
WINDOWS = (2, 8)  # radii of the windows that pixels borrow variance from, in pixels
UNSEEN_PSEUDOCOUNT = 0.25  # noisy pixels that are assumed to be among the others, unseen
SLOPE_DEVIATIONS = 6  # standard errors of a half over which a metric's slope is taken
PRIOR_WEIGHT = 2  # squared errors that an estimated variance counts as much as
SUBSET_PIXELS = 2**12  # pixels, about, from which mixtures and quantiles are found
NOISE_FIELDS = 16  # pictures of noise that are blurred to estimate the variance after a blur
LUMINANCE = (0.212671, 0.715160, 0.072169)  # of linear sRGB

Blurred = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class PilotEstimate:
    """What the pilot buffers say of the picture so far."""

    variance: np.ndarray  #: of a ray, [H, W], in units of the squared error
    uncertainty: float  #: relative standard error of an RMSE that halves estimate


@dataclass(frozen=True)
class Sums:
    """Moments of the rays of each pixel, of one buffer or of two combined, float32, in scaled units."""

    count: np.ndarray  #: rays, [H, W]
    sum: np.ndarray  #: of colours, [3, H, W]
    sum_sq: np.ndarray  #: of their squares, the mean of the three, [H, W]

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.count + other.count, self.sum + other.sum, self.sum_sq + other.sum_sq)

    @cached_property
    def mean(self) -> np.ndarray:
        """Mean colours, [3, H, W]."""
        return np.asarray(self.sum / self.count)

    @cached_property
    def variance(self) -> np.ndarray:
        """Variance of a ray's value, the mean of its colours, [H, W]."""
        left = self.sum_sq - mean_square(self.mean) * self.count
        left[left < np.float32(1e-6) * self.sum_sq] = 0  # lost in rounding
        return np.asarray(left / np.maximum(self.count - 1, 1))


@dataclass(frozen=True)
class SampleStatistics:
    """Moments of the rays in each pixel of four buffers, and the pictures of the buffers."""

    metric: Metric  #: by which errors are weighted
    count: np.ndarray  #: rays, [4, H, W]
    sum: np.ndarray  #: of colours, [3, 4, H, W]
    sum_sq: np.ndarray  #: of squares, the mean of the colours, [4, H, W]
    max_ray_value: np.ndarray  #: the mean colour of the brightest ray, [4, H, W]
    halves: FilmAccumulator
    pilots: FilmAccumulator | None  #: as a filter has them; None under a box
    invalid: np.ndarray  #: met a ray whose colour is NaN, or whose square overflows, [H, W]
    worst_invalid: float  #: the largest of such colours

    @classmethod
    def blank(cls, film: Film, channels: int, metric: Metric) -> SampleStatistics:
        """Statistics before any ray is traced."""
        four = (4, *film.shape)
        return cls(
            metric=metric,
            count=np.zeros(four),
            sum=np.zeros((3, *four), np.float32),
            sum_sq=np.zeros(four),
            max_ray_value=np.zeros(four, np.float32),
            halves=FilmAccumulator.blank(film, 2, channels),
            pilots=FilmAccumulator.blank(film, 2, 3) if film.reach else None,
            invalid=np.zeros(film.shape, bool),
            worst_invalid=0.0,
        )

    @property
    def film(self) -> Film:
        return self.halves.film

    @cached_property
    def _scaling(self) -> tuple[float, np.ndarray]:
        """Unit of squared errors, and factors [H, W] from linear values to values weighted by the metric.

        In this unit, squares of variances fit into single precision. Both are taken from the pilot buffers,
        so that no averaged value affects its own weight, even by rounding.
        """
        count = self.count[PILOTS].sum(0).astype(np.float32)
        sums = Sums(count, self.sum[:, PILOTS].sum(1), self.sum_sq[PILOTS].sum(0))
        weights: np.ndarray = np.ones(self.film.shape, np.float32)
        if self.metric is not LINEAR:
            # a pixel at the edge of a light may have missed it: the clipped end of the metric is in reach
            deviation = SLOPE_DEVIATIONS * np.sqrt(window_means(sums.variance, 1) / self.count[0])
            slopes = self.metric.weights(sums.mean, deviation.astype(np.float32))
            energy = np.square(sums.mean) + np.float32(1e-30)  # noise of a channel is about as large as it
            weights = (slopes * energy).sum(0) / energy.sum(0)
        unit = float((weights * sums.sum_sq).sum() / max(count.sum(), 1)) or 1.0
        return unit, np.float32(np.sqrt(weights / unit))

    @property
    def unit(self) -> float:
        """Squared error in the metric that is 1 in the units of ``sums``."""
        return self._scaling[0]

    @property
    def scale(self) -> np.ndarray:
        """Factors from linear values to those of ``sums``, [H, W]; 0 where the metric sees no error."""
        return self._scaling[1]

    @cached_property
    def _buffers(self) -> list[Sums]:
        """Sums of each buffer."""
        scale = self.scale
        count = self.count.astype(np.float32)
        total = self.sum * scale
        square = (self.sum_sq * np.square(scale, dtype=np.float64)).astype(np.float32)
        return [Sums(count[k], total[:, k], square[k]) for k in range(len(count))]

    def sums(self, first: int, second: int | None = None) -> Sums:
        """Sums of one buffer, or of two combined."""
        return self._buffers[first] if second is None else self._buffers[first] + self._buffers[second]

    def samples(self) -> np.ndarray:
        """Rays of each pixel in all buffers, [H, W], without the border."""
        return self.without_border(self.count.sum(0))

    def image(self) -> np.ndarray:
        """The mean of the half buffers, [H, W, channels], without the border."""
        return self.halves.mean()

    @cached_property
    def half_pictures(self) -> tuple[np.ndarray, np.ndarray]:
        """Colours of the half buffers, [H, W, 3], without the border; 0 where they are invalid."""
        first, second = self.halves.pictures()
        return self._masked(first), self._masked(second)

    def _masked(self, picture: np.ndarray) -> np.ndarray:
        """Colours [H, W, 3] of a picture with the border, without it; 0 where they are invalid."""
        return np.where(self.unknown()[..., None], 0, self.film.picture(picture[..., :3]))

    def squared_errors(self, metric: Metric, blurred: Blurred | None = None) -> np.ndarray:
        """Squared errors of the picture, from the difference of the half buffers, [H, W, 3], without border.

        They are 0 where the picture is invalid, as both halves are.
        """
        if metric is self.metric and blurred is None:
            return self._squared_errors * self.curvature
        first, second = self.half_pictures
        if blurred is not None:
            first, second = blurred(first), blurred(second)
        squares = metric.squared_errors(first, second)
        return squares * self.curvature if metric is self.metric else squares

    @cached_property
    def _squared_errors(self) -> np.ndarray:
        """Squared errors in the metric, without its curvature, [H, W, 3]."""
        return self.metric.squared_errors(*self.half_pictures)

    @cached_property
    def curvature(self) -> float:
        """Factor to squared errors from the difference of the halves, for the curvature of the metric.

        The difference of two noisy halves is encoded less steeply than that of their mean to the dark truth.
        Of pilots, which are noisier, the factor is known, as their mean differs from that of the halves by
        its true error; it falls about as the root of the rays grows.
        """
        metric = self.metric
        if metric is LINEAR:
            return 1.0
        if self.pilots is None:
            pilots = np.moveaxis(self.sum[:, PILOTS] / np.float32(self.count[PILOTS]), 0, -1)
        else:
            pilots = self.pilots.pictures()
        first, second = (self._masked(picture) for picture in pilots)
        halves = self.half_pictures
        found = 4 * metric.squared_errors((first + second) / 2, (halves[0] + halves[1]) / 2).mean()
        found -= self._squared_errors.mean()
        expected = metric.squared_errors(first, second).mean()
        growth = self.count[PILOTS].sum() / self.count[HALVES].sum()
        return 1 + float(np.clip(found / max(expected, 1e-300) - 1, 0, 1)) * math.sqrt(growth)

    def luminance(self) -> float:
        """Mean luminance of the picture in the pilot buffers, which no averaged value decides."""
        total = self.sum[:, PILOTS].sum(1) / self.count[PILOTS].sum(0)
        colors = self.film.picture(np.moveaxis(total, 0, -1))
        return float(colors.mean((0, 1)) @ LUMINANCE)

    def invalid_warning(self) -> str:
        """Warning that names pixels whose squared radiance overflows float32 or is NaN, else ""."""
        invalid = np.argwhere(self.without_border(self.invalid))
        if not len(invalid):
            return ""
        where = f"{len(invalid)} pixels, the first at row {invalid[0, 0]}, column {invalid[0, 1]}"
        return f"radiance of {self.worst_invalid:.3g} was met in {where}: they are left out of the error"

    @property
    def invalid_dilated(self) -> np.ndarray:
        """True where the filter spreads invalid values to, [H, W]."""
        return dilated(self.invalid, self.film.reach)

    def unknown(self) -> np.ndarray:
        """True where the picture is invalid, [H, W], without the border."""
        return self.without_border(self.invalid_dilated)

    def without_border(self, values: np.ndarray) -> np.ndarray:
        """Values [H, W] without the border."""
        return self.film.picture(values[..., None])[..., 0]


# ----------------------------------------- Error of the picture -----------------------------------------


def estimate_error(stats: SampleStatistics, blurred: Blurred | None) -> ErrorEstimate:
    """Return the estimated RMSE with its interval, and the tail of what single rays contribute.

    It is a mean of squares, each as uncertain as it is large, correlated by the filter; the true error is a
    mean of as many squares, and as uncertain. The interval is that of a log-normal law, wider upwards the
    fewer squares make up the mean.
    """
    squares = stats.squared_errors(stats.metric, blurred).mean(-1)
    correlation = stats.film.correlation
    tail = contribution_tail(stats, HALVES)
    rmse = math.sqrt(float(squares.mean()))
    if blurred is not None:  # a window of the blur's reach is as good as one independent pixel
        correlation = 1.0
        for axis in (0, 1):
            squares = np.add.reduceat(squares, range(0, squares.shape[axis], 2 * REACH), axis)
    spread = math.sqrt(2 * correlation * float(np.square(squares).sum())) / max(squares.sum(), 1e-300)
    width = 1.96 * spread / 2
    high = rmse * math.exp(width * (1 + spread)) if tail <= PARETO_K_THRESHOLD else math.inf
    return ErrorEstimate(rmse, rmse * math.exp(-width), high, tail, metric=stats.metric.name)


def contribution_tail(stats: SampleStatistics, buffers: Sequence[int]) -> float:
    """Return the Pareto shape of what rays contribute to some buffers.

    The brightest ray of each pixel is known; the others are taken to be alike, with the remaining variance.
    """
    each = [stats.sums(buffer) for buffer in buffers]
    count = np.stack([sums.count for sums in each])
    variance = np.stack([sums.variance for sums in each])
    means = np.stack([sums.mean.mean(0) for sums in each])
    peak = stats.max_ray_value[list(buffers)] * stats.scale
    most = np.maximum(peak - means, 0)
    others = np.sqrt(np.maximum(variance - most**2 / np.maximum(count - 1, 1), 0))
    values = np.stack([most / count, others / count])
    counts = np.stack([np.ones_like(count), count - 1])
    return tail_shape(values.ravel(), counts.ravel())


def pixel_variance(stats: SampleStatistics, blurred: Blurred | None) -> np.ndarray:
    """Return the estimated variance of each channel of the picture, linear, [H, W, 3], without the border."""
    linear = replace(stats, metric=LINEAR)
    first = linear.sums(0, 2)
    second = linear.sums(1, 3)
    each = ray_variance(linear, first, second, unseen=2 * UNSEEN_PSEUDOCOUNT)
    quiet, also = window_means(np.stack([first.variance, second.variance]), 1) == 0
    if not (second.variance[quiet].any() or first.variance[also].any()):
        each[quiet & also] = 0  # where one met no noise, the other met none: a sky has none
    each *= linear.unit * (1 / stats.count[HALVES]).sum(0) / 4
    squares = stats.squared_errors(LINEAR)
    total = _calibrated(stats.without_border(stats.film.filtered_variance(each)), squares.mean(-1))
    near = np.moveaxis(window_means(np.moveaxis(squares, -1, 0), WINDOWS[-1]), 0, -1) + 1e-30
    variance = total[..., None] * near / near.mean(-1, keepdims=True)
    if blurred is not None:
        variance = _blurred_variance(variance, stats.squared_errors(LINEAR, blurred), blurred)
    rounding = np.square(2.0**-24 * stats.image()[..., :3], dtype=np.float64)
    return variance + np.nan_to_num(rounding, posinf=0)


def _blurred_variance(variance: np.ndarray, squares: np.ndarray, blurred: Blurred) -> np.ndarray:
    """Return variances [H, W, 3] after a blur, from blurred fields of noise, calibrated by squared errors."""
    random = np.random.default_rng(0)
    deviation = np.sqrt(variance)
    after = np.zeros(variance.shape)
    for _ in range(NOISE_FIELDS):
        field = blurred(deviation * random.standard_normal(variance.shape))
        after += np.square(field, dtype=np.float64) / NOISE_FIELDS
    mean = after.mean(-1)
    return after * (_calibrated(mean, squares.mean(-1)) / np.maximum(mean, 1e-300))[..., None]


def pixel_error(stats: SampleStatistics, variance: np.ndarray, blurred: Blurred | None) -> np.ndarray:
    """Return the standard error of each pixel in the metric, [H, W], given variances of its channels."""
    if stats.metric is not LINEAR:
        image = np.nan_to_num(stats.image()[..., :3])
        image = image if blurred is None else blurred(image)
        squares = (variance * stats.metric.weights(image, np.sqrt(variance))).mean(-1)
        measured = stats.squared_errors(stats.metric, blurred).mean(-1)
        return np.sqrt(_calibrated(squares, measured))
    return np.sqrt(variance.mean(-1))


# ------------------------------------------- Variance of rays -------------------------------------------


def pilot_estimate(stats: SampleStatistics) -> PilotEstimate:
    """Return the variance per ray, by the pilot buffers, and how uncertain an RMSE of the halves is."""
    variance = ray_variance(stats, stats.sums(2), stats.sums(3)) * np.float32(stats.unit)
    squares, _ = differences(stats.sums(2), stats.sums(3))
    number = effective_number(squares) / stats.film.correlation
    return PilotEstimate(
        variance=variance,
        uncertainty=0.5 / math.sqrt(max(number, 1)),
    )


def ray_variance(
    stats: SampleStatistics, first: Sums, second: Sums, unseen: float = UNSEEN_PSEUDOCOUNT
) -> np.ndarray:
    """Return the variance of a pixel times its rays, [H, W], in the unit of the sums of two buffers.

    Pixels that met no rare bright ray look quiet, so each borrows from windows around it, and from the
    picture: in the mixture of the first buffer that explains best what the second measures. Rays of a
    sequence err less than independent ones: by that much, the buffers differ less than their rays do.
    ``unseen``: see ``UNSEEN_PSEUDOCOUNT``; errors that are stated count it twice.
    """
    film = stats.film
    seen = first.variance
    measured = second.variance
    both = (first + second).variance
    parts, more = _around(film, np.stack([seen, both]))
    weights = _mixture(parts, measured)
    weights[0] = max(weights[0], unseen / max(effective_number(both), 1))
    mixed = np.tensordot(weights.astype(np.float32), more, 1)
    mixed[..., stats.scale == 0] = 0
    every = differences(first, second)
    found, expected = window_means(every, WINDOWS[-1]) + 0.2 * every.mean((-2, -1), keepdims=True)
    ratio = film.between_pixel_share * found / np.maximum(expected, 1e-30) + _between_pixels(stats)
    return np.asarray(mixed * ratio * np.float32(film.filter_variance_ratio))


def _between_pixels(stats: SampleStatistics) -> float:
    """Return what the filter's change within a pixel adds to the ratio of a pixel's variance to that of
    independent rays, from the pilot buffers.

    Values that depend on other dimensions gain nothing there by a stratified sequence, edges do.
    """
    film = stats.film
    if stats.pilots is None:
        return 0.0
    found, expected = differences(stats.sums(2), stats.sums(3)).mean((1, 2), dtype=np.float64)
    first, second = (half * stats.scale[..., None] for half in stats.pilots.pictures())
    squares = LINEAR.squared_errors(first, second).mean(-1)
    seen = np.where(stats.invalid_dilated, 0, squares).mean()
    added = seen / film.filter_variance_ratio - film.between_pixel_share * found
    return float(np.clip(added / max(expected, 1e-300), 0, 1 - film.between_pixel_share))


def _around(film: Film, values: np.ndarray) -> np.ndarray:
    """Return means of all values [..., H, W], values, and means in windows, [..., parts, ..., H, W]."""
    parts = [values * 0 + values.mean((-2, -1), keepdims=True)]
    if not film.reach:
        parts.append(values)
    parts += [window_means(values, width) for width in WINDOWS if width >= film.reach]
    return np.stack(parts, -3)


def differences(one: Sums, another: Sums) -> np.ndarray:
    """Return the squared error of the mean of two buffers, by their difference, and what it would be for
    independent rays, [2, H, W]."""
    found = mean_square(one.mean - another.mean) / 4
    return np.stack([found, (one + another).variance * (1 / one.count + 1 / another.count) / 4])


def mean_square(colors: np.ndarray) -> np.ndarray:
    """Return the mean of the squares of three channels, [H, W]."""
    return np.asarray((colors[0] ** 2 + colors[1] ** 2 + colors[2] ** 2) / 3)


def effective_number(values: np.ndarray) -> float:
    """Return the effective number of values, (Σv)² / Σv²."""
    flat = values.ravel()
    return float(flat.sum(dtype=np.float64) ** 2 / max(float(flat @ flat), 1e-300))


def _mixture(parts: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return weights, 0 or more, with which parts [parts, H, W] add up to what is nearest to values [H, W].

    By W. Richardson's and L. Lucy's steps (1972, 1974), in which a value weighs the less the more is expected
    of it, since a variance is as uncertain as it is large.
    """
    step = max(1, math.isqrt(measured.size // SUBSET_PIXELS))
    tiny = 1e-6 * measured.mean() + 1e-30
    known = parts[:, ::step, ::step].reshape(len(parts), -1).astype(np.float64) + tiny
    values = measured[::step, ::step].ravel() + tiny
    shares = np.full(len(parts), 1 / len(parts))
    for _ in range(30):
        expected = shares @ known
        weights = 1 / np.sqrt(expected)
        shares *= known @ (weights * values / expected) / (known @ weights)
    return shares


def _calibrated(variance: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Return variances [H, W], each tenth of them, as they sort, pulled to the mean of its squared errors.

    The more squares make up that mean, the more: a tenth in which both halves missed the same rare rays has
    none, and keeps its estimate.
    """
    noisy = variance > 0
    if not noisy.any():
        return variance.copy()
    step = max(1, variance.size // SUBSET_PIXELS)
    edges = np.quantile(variance[noisy][::step], np.arange(1, 10) / 10)
    tenth = np.searchsorted(edges, variance)  # of each pixel, 0 to 9
    factors = np.array([_calibration(variance[tenth == k], squares[tenth == k]) for k in range(10)])
    return np.asarray(variance * factors[tenth])


def _calibration(estimated: np.ndarray, measured: np.ndarray) -> float:
    """Return the factor that pulls estimated squared errors towards the measured sum.

    The more measured errors make up that sum, the farther.
    """
    whole = estimated.sum(dtype=np.float64)
    if whole == 0:
        return 1.0
    number = effective_number(measured)
    ratio = measured.sum(dtype=np.float64) / whole
    return float(ratio ** (number / (number + PRIOR_WEIGHT)))
