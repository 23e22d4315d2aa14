"""Sampling to an error: what two half pictures say about the noise, and where further rays are worth most.

Two pictures are exposed at once, each from rays of its own. Their difference estimates the error of their
mean, whatever integrator, sampler and filter are at work. Which pixels of one get further rays is decided by
the variance in the other alone: a value never decides how many values it is averaged with, so the mean stays
unbiased. (A pixel that happened to miss a bright reflection would otherwise look quiet, and stay dark.)

Rays are shared out in proportion to the standard deviation of a pixel (J. Neyman, 1934). A few rays estimate
it badly, so it is smoothed over neighbours, and how far is decided by cross-validation: by which candidate,
formed of one half, shares out rays best for the variance that the other half measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mrt_mitsuba.output.error import ErrorEstimate
from mrt_mitsuba.rays.film import Film
from mrt_mitsuba.rendering.exposing import Exposed

HALVES = 2
GROUP = 8  # rays that are traced together; two groups to a pixel begin
GROWTH = 4  # times the rays there are may be there after another round: the variance is known better then
MARGIN = 0.97  # of the target to aim at: an estimate is as often too low as too high

# Candidates for the smoothing of variances: half the width of a window, and how many rays its mean is worth
_WINDOWS = ((1, 8), (1, 32), (2, 32), (2, math.inf), (4, math.inf), (8, math.inf))
_FLOORS = (0.003, 0.03, 0.2, 1.0)  # share of the picture's mean in the variance of every pixel
_REGION = 8  # half the width of the windows in which rays are compared with independent ones


class Halves:
    """Two half pictures, and the moments of the rays in each pixel, as they grow round by round."""

    def __init__(self, film: Film, channels: int) -> None:
        self.film, pixels = film, film.pixels
        self.rays = np.zeros((HALVES, pixels))
        self._total, self._square = np.zeros((2, HALVES, pixels, 3))
        self._sums = np.zeros((HALVES, *film.shape, channels))
        self._weights, self._amount = np.zeros((2, HALVES, *film.shape))

    def widened(self, groups: np.ndarray) -> np.ndarray:
        """Return numbers of groups [2, pixels], with one group at least wherever the filter reaches from."""
        near = np.stack([box_mean(half > 0, self.film.reach) > 0 for half in self._rows(groups)])
        return np.maximum(groups, near.reshape(groups.shape))

    def add(self, exposed: Exposed, chosen: np.ndarray) -> None:
        """Add a round whose rays went to the ``chosen`` pixels [2, pixels], and around them.

        The rays of a pixel count as one in the round; so a round counts in proportion to the number of
        independent rays that it brings to a pixel, and only where none is missing under the filter.
        """
        each = np.where(exposed.rays > 0, 1 / np.maximum(exposed.rays, 1), 1.0)
        amount = self._rows(chosen) / self.film.spread_out(self._rows(each))
        self._sums += amount[..., None] * exposed.sums
        self._weights += amount * exposed.weights
        self._amount += amount
        self.rays += exposed.rays
        self._total += exposed.total
        self._square += exposed.square

    # ------------------------------------------- Pictures -------------------------------------------

    def picture(self) -> np.ndarray:
        """Return the mean of the halves, [H, W, channels], with the border."""
        amount = np.maximum(self._amount, 1e-30)
        return _divided((self._sums / amount[..., None]).sum(0), (self._weights / amount).sum(0))

    def _squared_error(self) -> np.ndarray:
        """Return an estimate for each pixel of the picture's squared error, mean of channels, [H, W].

        The mean of two independent values has a variance of a quarter of their expected squared difference.
        """
        first, second = (
            _divided(s[..., :3], w) for s, w in zip(self._sums, self._weights, strict=True)
        )
        return np.asarray(np.square(first - second).mean(-1) / 4)

    def error(self) -> ErrorEstimate:
        """Return the estimated RMSE of the picture, without the border.

        The mean of squares of which each is as uncertain as it is large, correlated as the filter has it; the
        true error is a mean of as many squares, and as uncertain. The interval is that of a log-normal law.
        """
        squares = self._inside(self._squared_error())
        mean = float(squares.mean())
        if mean == 0:
            return ErrorEstimate(0.0, 0.0, 0.0)
        spread = math.sqrt(2 * self.film.correlation * float(np.square(squares).sum())) / float(squares.sum())
        rmse, factor = math.sqrt(mean), math.exp(1.96 * spread / 2)
        return ErrorEstimate(rmse, rmse / factor, rmse * factor)

    def variance(self) -> np.ndarray:
        """Return the estimated variance of each channel in the picture, [H, W, 3], without the border."""
        moments = self._moments()
        each = np.moveaxis((_smoothed(moments, self._rows(self.rays)[..., None], 1, 8)), -1, 1)
        each = each / self._rows(self.rays)[:, None]
        better = self._better(moments.mean(-1))
        return self.film.picture(np.moveaxis(self.film.spread_out(each.sum(0)) / 4 * better, 0, -1))

    def samples(self) -> np.ndarray:
        """Return the rays of each pixel, [H, W], without the border."""
        return self._inside(self._rows(self.rays).sum(0))

    # ------------------------------------------- Sharing --------------------------------------------

    def share_out(
        self, *, rays: float, target: float | None = None
    ) -> np.ndarray:
        """Return numbers of further groups, [2, pixels].

        Enough for the RMSE to fall to ``target``, if that takes no more than ``rays`` a pixel in all.
        """
        variance = self._decisive()
        deviation, most = np.sqrt(variance), rays * self.film.pixels
        if target is not None:
            allowed = (variance / self.rays).sum() * (target / self.error().rmse) ** 2
            wanted = _water(self.rays, deviation, lambda due: (variance / due).sum() <= allowed)
            if wanted.sum() <= most:
                return self._groups(wanted)
        return self._groups(_water(self.rays, deviation, lambda due: due.sum() >= most))

    def _groups(self, due: np.ndarray) -> np.ndarray:
        """Return whole numbers of groups for what is due; one at least."""
        missing = (due - self.rays) / GROUP
        groups = np.floor(missing + 0.5)
        if not groups.any():
            groups = (missing >= missing.max()) * 1.0
        return np.asarray(groups, np.int64)

    def _decisive(self) -> np.ndarray:
        """Return the variance of a ray's value that decides in each half, [2, pixels]: the other half's."""
        moments, rays = self._moments().mean(-1), self._rows(self.rays)
        measured = moments * self._better(moments)
        mean = measured.mean((1, 2))[:, None, None]
        best, least = measured, math.inf
        for width, worth in _WINDOWS:
            smooth = _smoothed(measured, rays, width, worth)
            for floor in _FLOORS:
                candidate = (1 - floor) * smooth + floor * mean + 1e-30
                deviation = np.sqrt(candidate)
                cost = ((measured[::-1] / deviation).mean((1, 2)) * deviation.mean((1, 2))).sum()
                if cost < least:
                    best, least = candidate, cost
        return best[::-1].reshape(HALVES, -1)

    def _moments(self) -> np.ndarray:
        """Return the variance of a ray's value in each half and channel, [2, H, W, 3]."""
        rays = self.rays[..., None]
        variance = (self._square - self._total**2 / rays) / np.maximum(rays - 1, 1)
        return self._rows(np.maximum(variance, 0))

    def _better(self, moments: np.ndarray) -> np.ndarray:
        """Return the squared error over that of independent rays whose value has this variance, [H, W].

        Below 1 where rays are stratified, and where a filter averages pixels.
        """
        found = self._squared_error()
        expected = self.film.spread_out((moments / self._rows(self.rays)).sum(0)) / 4
        few = 0.1  # windows without noise take the picture's ratio
        ratio = box_mean(found, _REGION) + few * found.mean()
        return ratio / np.maximum(box_mean(expected, _REGION) + few * expected.mean(), 1e-30)

    # -------------------------------------------- Shapes --------------------------------------------

    def _rows(self, values: np.ndarray) -> np.ndarray:
        """Return a view [2, H, W, ...] of values [2, pixels, ...]."""
        return values.reshape(HALVES, *self.film.shape, *values.shape[2:])

    def _inside(self, values: np.ndarray) -> np.ndarray:
        return self.film.picture(values[..., None])[..., 0]


def _divided(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sums [..., channels] over weights [...], as Mitsuba's films divide them."""
    return np.asarray(sums / np.where(weights == 0, 1, weights)[..., None])


def _smoothed(variance: np.ndarray, rays: np.ndarray, width: int, worth: float) -> np.ndarray:
    """Return variances [2, H, W, ...] drawn towards their mean in a window, the less the more rays."""
    around = np.stack([box_mean(half, width) for half in variance])
    share = 1.0 if math.isinf(worth) else worth / (rays + worth)
    return np.asarray(variance + share * (around - variance))


def _water(have: np.ndarray, shape: np.ndarray, enough: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Return the least multiple of ``shape`` that is ``enough``, where there is not more already."""
    low, high = 0.0, float((have.max() + 1) / max(shape.mean(), 1e-30))
    while not enough(np.maximum(have, high * shape)) and high < 1e30:
        low, high = high, 4 * high
    while high - low > 1e-3 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if enough(np.maximum(have, middle * shape)) else (middle, high)
    return np.maximum(have, high * shape)


def box_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the means [H, W, ...] over windows of 2 reach + 1 rows and columns, cut at the border."""
    for axis in (0, 1):
        values = np.moveaxis(values, axis, 0)
        size = len(values)
        sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, 0, dtype=np.float64)])
        first = np.maximum(np.arange(size) - reach, 0)
        last = np.minimum(np.arange(size) + reach + 1, size)
        counts = (last - first).reshape(-1, *([1] * (values.ndim - 1)))
        values = np.moveaxis((sums[last] - sums[first]) / counts, 0, axis)
    return values
