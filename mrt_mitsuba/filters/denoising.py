"""Denoising of two independent renders of one picture, with an estimate of the error that remains.

Each half picture is denoised apart by Intel's Open Image Denoise. A denoised half is independent of the other
half's noise, so their squared difference, less the variance of that noise, estimates the squared error of the
denoised half without bias (F. Rousselle, C. Knaus and M. Zwicker, Adaptive sampling and reconstruction using
greedy error minimization, 2011; Adaptive rendering with non-local means filtering, 2012). The result is the
mixture of the denoised picture and the plain mean with the least estimated error (A. Firmino, J. R. Frisvad
and H. W. Jensen, Progressive denoising of Monte Carlo rendered images, 2022; S. Zheng and others, Ensemble
denoising for Monte Carlo renderings, 2021).

A denoised half gets back the low frequencies of the noisy one, in which noise is small: what a denoiser
leaves there are blotches, which a viewer sees first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mrt_mitsuba.errors import UsageError, needs_extra
from mrt_mitsuba.filters.grid import window_counts, window_means

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Image = NDArray[np.float32]
    Encode = Callable[[np.ndarray], np.ndarray]

Quality = Literal["fast", "balanced", "high"]

REACH = 8  # pixels to each side of the windows in which squared errors and differences are averaged
DARK = 0.1  # radiance below which differences count in absolute terms, above it in relative ones
OUTLIER = 10  # difference, relative to the picture, from which a value is that of a rare bright sample
BLOCK = 8  # side, in pixels, of the blocks whose spread gives the interval of the error
CORRELATED = 0.1  # correlation of the noise of two pixels above which they are not taken for independent
MIN_SHARE = 0.3  # of the error that a pixel's noise makes typical: windows of few pixels may show none
NORMAL_95 = 1.96


@dataclass(frozen=True)
class Denoised:
    """A mixture of a denoised picture and the plain mean of two renders."""

    image: Image  #: the mixture, linear, [H, W, 3]
    noisy: Image  #: the mean of the two renders, [H, W, 3]
    weight: Image  #: of the denoised picture in the mixture, from 0 to 1, [H, W]
    error: Image  #: estimated root of the mixture's squared error, bias included, [H, W]
    rmse: float  #: of the mixture
    low: float  #: lower end of its 95 % interval
    high: float  #: upper end of its 95 % interval


def denoise(
    first: Image,
    second: Image,
    albedo: Image | None = None,
    normal: Image | None = None,
    *,
    encode: Encode | None = None,
    unfiltered: tuple[Image, Image] | None = None,
    refilter: Callable[[Image], Image] | None = None,
    quality: Quality = "balanced",
) -> Denoised:
    """Denoise two independent renders of a picture, and mix the result with their mean where that errs less.

    Args:
        first: linear values of the first render, [H, W, 3].
        second: the same of the second one, with random numbers of its own and as many samples.
        albedo: of first hits, [H, W, 3] in [0, 1].
        normal: shading normals of first hits, [H, W, 3] in [-1, 1].
        encode: function of linear values whose differences count as errors, such as the sRGB curve; None: the
            values themselves.
        unfiltered: the means of the samples in each pixel of the two renders, [H, W, 3] each, which are
            denoised in their place; noise that a reconstruction filter has spread over pixels hardly is.
        refilter: what the reconstruction filter makes of pixel means; for ``unfiltered`` ones, denoised.
        quality: of Open Image Denoise; "fast" takes half the time of "balanced", and loses fine detail.

    Low frequencies, in which noise is small, stay those of the renders. Pixels that are not finite in a
    render are taken from the mean as they are, and count in no error.

    Raises:
        UsageError: for pictures of different shapes, or of another shape than [H, W, 3].
        MrtError: without the extra ``denoise``.
    """
    pictures = {"first": first, "second": second, "albedo": albedo, "normal": normal}
    for name, picture in pictures.items():
        if picture is not None and (np.ndim(picture) != 3 or np.shape(picture) != (*np.shape(first)[:2], 3)):
            raise UsageError(f"{name} has shape {np.shape(picture)}; expected one [H, W, 3] for all pictures")
    if np.size(first) == 0:
        raise UsageError("first has no pixels")
    halves = [np.asarray(half, np.float32) for half in (first, second)]
    with np.errstate(over="ignore", invalid="ignore"):
        noisy = (halves[0] + halves[1]) / 2
        valid = np.isfinite(noisy).all(-1) & np.isfinite(halves[0] - halves[1]).all(-1)
    halves = [np.where(valid[..., None], half, 0) for half in halves]
    inputs = halves if unfiltered is None else [np.asarray(half, np.float32) for half in unfiltered]
    denoised = [_open_image_denoise(half, albedo, normal, quality) for half in inputs]
    if refilter is not None:
        denoised = [refilter(half) for half in denoised]
    denoised = [_with_low_frequencies(*pair) for pair in zip(denoised, halves, strict=True)]
    estimates = _Estimates.of(halves, denoised, encode or np.asarray, valid)
    weight = estimates.best_weight()
    share = weight[..., None]
    mixed = (share * (denoised[0] + denoised[1]) + (1 - share) * (halves[0] + halves[1])) / 2
    squares = estimates.mixture(weight)
    rmse, low, high = _interval(squares)
    typical = window_means(estimates.variance, REACH) * (
        rmse**2 / max(float(estimates.variance.mean()), 1e-300)
    )
    variance = np.maximum(window_means(squares, REACH), MIN_SHARE * typical)
    return Denoised(
        image=np.where(valid[..., None], mixed, noisy).astype(np.float32),
        noisy=noisy.astype(np.float32),
        weight=weight.astype(np.float32),
        error=np.sqrt(variance).astype(np.float32),
        rmse=rmse,
        low=low,
        high=high,
    )


def _open_image_denoise(color: Image, albedo: Image | None, normal: Image | None, quality: Quality) -> Image:
    """Return a picture denoised by Open Image Denoise; negative values count as 0."""
    with needs_extra("denoise"):
        import pyoidn
    features: dict[str, Any] = {}
    if albedo is not None:
        features["albedo"] = np.ascontiguousarray(np.clip(np.nan_to_num(albedo), 0, 1), np.float32)
        if normal is not None:  # which the library takes next to an albedo only
            features["normal"] = np.ascontiguousarray(np.clip(np.nan_to_num(normal), -1, 1), np.float32)
    positive = np.ascontiguousarray(np.maximum(color, 0))
    return np.asarray(pyoidn.denoise(positive, **features, hdr=True, quality=quality))


def _with_low_frequencies(denoised: Image, noisy: Image) -> Image:
    """Return a denoised picture, 0 or more, whose low frequencies are those of the noisy one.

    Differences are relative to the picture, so that bright pixels do not spill into dark ones. What a rare
    bright sample adds stays out.
    """
    unit = np.maximum(denoised, 0) + np.float32(DARK)
    with np.errstate(over="ignore"):
        missing = np.moveaxis(np.minimum((noisy - denoised) / unit, OUTLIER), -1, 0)
    for _ in range(2):
        missing = window_means(missing, REACH)
    return np.maximum(denoised + unit * np.moveaxis(missing, 0, -1), 0)


@dataclass(frozen=True)
class _Estimates:
    """Unbiased estimates at single pixels, [H, W], mean of the channels.

    ``reach``: distance, in pixels, up to which the noise of pixels is correlated.
    """

    variance: np.ndarray  #: of the plain mean
    error: np.ndarray  #: squared error of the denoised picture
    covariance: np.ndarray  #: of the errors of both
    reach: int

    @classmethod
    def of(
        cls, halves: list[np.ndarray], denoised: list[np.ndarray], encode: Encode, valid: np.ndarray
    ) -> _Estimates:
        """Estimates from two halves A, B and what they become when denoised, F(A) and F(B).

        As F(A) is independent of B: E[(F(A) − B)²] = E[(F(A) − µ)²] + Var B, and E[(F(A) − F(B))(A − B)] is
        the sum of the covariances of F(A) with A and of F(B) with B.
        """
        a, b = (np.asarray(encode(half), np.float64) for half in halves)
        fa, fb = (np.asarray(encode(half), np.float64) for half in denoised)
        noise = a - b
        change = fa - fb
        plain = _mean_product(noise, noise)
        error = (_mean_product(fa - b, fa - b) + _mean_product(fb - a, fb - a) - plain) / 2
        return cls(
            variance=np.where(valid, plain / 4, 0),
            error=np.where(valid, error - _mean_product(change, change) / 4, 0),
            covariance=np.where(valid, _mean_product(change, noise) / 4, 0),
            reach=_correlated_reach(np.where(valid, noise.mean(-1), 0)),
        )

    def best_weight(self) -> np.ndarray:
        """Weight of the denoised picture with the least squared error, [H, W].

        That of a pixel comes from its neighbours only, and not from those whose noise goes along with its
        own: so no noise decides the weight with which it counts in the error of the mixture.
        """
        counts = [window_counts(self.error.shape, reach) for reach in (REACH, self.reach)]

        def around(values: np.ndarray) -> np.ndarray:
            inner = window_means(values, self.reach) if self.reach else values
            total = window_means(values, REACH) * counts[0] - inner * counts[1]
            return np.asarray(total / np.maximum(counts[0] - counts[1], 1))

        variance = around(self.variance)
        covariance = around(self.covariance)
        error = np.maximum(around(self.error), 0)
        spread = variance + error - 2 * covariance
        best = np.divide(variance - covariance, spread, out=np.zeros_like(spread), where=spread > 0)
        return np.clip(best, 0, 1)

    def mixture(self, weight: np.ndarray) -> np.ndarray:
        """Squared error of a mixture, [H, W]; of a single pixel, it may be negative."""
        plain = 1 - weight
        return weight**2 * self.error + plain**2 * self.variance + 2 * weight * plain * self.covariance


def _mean_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the mean of products over the channels, [H, W]."""
    return np.einsum("hwc,hwc->hw", first, second) / first.shape[-1]


def _correlated_reach(noise: np.ndarray) -> int:
    """Return the distance in pixels, 0, 1, 2 or 4, up to which the noise [H, W] is correlated.

    Noise under a box filter is not; wider reconstruction filters share samples among pixels.
    """
    power = float(np.square(noise).mean())
    if power == 0:
        return 0
    for reach in (4, 2, 1):
        lags = [reach, reach // 2 + 1]
        pairs = [(noise[:, lag:], noise[:, :-lag]) for lag in lags] + [
            (noise[lag:], noise[:-lag]) for lag in lags
        ]
        if any(one.size and float((one * other).mean()) > CORRELATED * power for one, other in pairs):
            return reach
    return 0


def _interval(squares: np.ndarray) -> tuple[float, float, float]:
    """Return the RMSE and the ends of its 95 % interval, by squared errors [H, W] and spread of blocks."""
    rows, columns = squares.shape
    sums = np.add.reduceat(squares, range(0, rows, BLOCK), 0)
    sums = np.add.reduceat(sums, range(0, columns, BLOCK), 1)
    mean = float(squares.mean())
    spread = math.sqrt(float(np.square(sums - mean * BLOCK**2).sum())) / squares.size
    width = NORMAL_95 * spread * (1 + spread / max(abs(mean), spread, 1e-300))
    middle = max(mean, spread / 2)
    return math.sqrt(middle), math.sqrt(max(mean - width, 0)), math.sqrt(max(mean, 0) + width)
