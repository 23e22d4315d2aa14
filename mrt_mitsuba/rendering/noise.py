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

from mrt_mitsuba.filters.dof import REACH
from mrt_mitsuba.output.error import ErrorEstimate
from mrt_mitsuba.rendering.exposing import Exposed, Exposer, Groups, Stack, channels_last
from mrt_mitsuba.rendering.rounds import LEAST_GROWTH
from mrt_mitsuba.rendering.windows import window_means

HALVES = 2
TILE = 16  # pixels, under a filter
GROUP = 4  # rays that are traced together; two groups to a pixel begin
# Times the rays there are must be there after another round: a short one costs more than it brings
STEP = 1.5

# Candidates for the smoothing of variances: half the width of a window, and how many rays its mean is worth
_WINDOWS = ((1, 8), (1, 32), (2, 32), (2, math.inf), (4, math.inf), (8, math.inf))
_FLOORS = (0.003, 0.03, 0.2, 1.0)  # share of the picture's mean in the variance of every pixel
_JUDGES = 2**12  # pixels, about, that choose among the candidates
_REGION = 8  # half the width of the windows in which rays are compared with independent ones


class Halves(Stack):
    """Two half pictures, and the moments of the rays in each pixel, as they grow round by round."""

    def __init__(
        self, exposer: Exposer, seed: int, blurred: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        film = exposer.film
        super().__init__(film, HALVES, len(exposer.names))
        self._exposer, self._seed, self._blurred, self._step = exposer, seed, blurred, STEP
        self._total, self._square = (channels_last(np.zeros((3, HALVES, *film.shape))) for _ in range(2))

    # ------------------------------------------- Rounds ---------------------------------------------

    def first(self) -> np.ndarray:
        """Return one group for each pixel and half."""
        return np.ones_like(self.rays, np.int64)

    def cost(self, chosen: np.ndarray) -> int:
        """Return the number of rays that groups for chosen pixels take, with those around them."""
        return GROUP * int(self.widened(chosen).sum())

    def trace(self, chosen: np.ndarray, advance: Callable[[int], object]) -> None:
        """Trace numbers of groups, [2, pixels]."""
        groups = Groups.spread(GROUP, self.widened(chosen), self.rays)
        exposed = self._exposer.expose(
            groups, self._seed, pictures=HALVES, progressive=True, moments=True, advance=advance
        )
        self.add(exposed, chosen > 0)

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], and the standard error and the rays of each pixel, [H, W]."""
        image = self.mean()[..., :3]
        shown = image if self._blurred is None else self._blurred(image)
        return shown, np.sqrt(self.variance().mean(-1)), self.samples()

    def add(self, exposed: Exposed, chosen: np.ndarray) -> None:
        super().add(exposed, chosen)
        self._total += exposed.total
        self._square += exposed.square

    # ------------------------------------------- Errors ---------------------------------------------

    def _squared_error(self) -> np.ndarray:
        """Return an estimate for each pixel of the picture's squared error, mean of colours, [H, W].

        The mean of two independent values has a variance of a quarter of their expected squared difference.
        """
        return _quarter_squares(*self.pictures()[..., :3])

    def error(self) -> ErrorEstimate:
        """Return the estimated RMSE of the picture, without the border.

        The mean of squares of which each is as uncertain as it is large, correlated as the filter has it; the
        true error is a mean of as many squares, and as uncertain. The interval is that of a log-normal law,
        wider upwards the fewer squares make up the mean: there may be others that no ray has met yet.
        """
        halves, correlation = self.film.picture(self.pictures()[..., :3]), self.film.correlation
        if self._blurred is not None:
            halves = np.stack([self._blurred(half) for half in halves])
        squares = _quarter_squares(*halves)
        mean = float(squares.mean())
        if mean == 0:
            return ErrorEstimate(0.0, 0.0, 0.0)
        if self._blurred is not None:  # pixels are as good as one in a window of the blur's reach
            squares, correlation = _blocks(squares, 2 * REACH), 1.0
        spread = math.sqrt(2 * correlation * float(np.square(squares).sum())) / float(squares.sum())
        rmse, width = math.sqrt(mean), 1.96 * spread / 2
        return ErrorEstimate(rmse, rmse * math.exp(-width), rmse * math.exp(width * (1 + spread)))

    def variance(self) -> np.ndarray:
        """Return the estimated variance of each channel in the picture, [H, W, 3], without the border."""
        moments, rays = self._moments()
        each = np.moveaxis((moments / rays[..., None]).sum(0), -1, 0)
        each = _smoothed(each, window_means(each, 1), rays.mean(0), 8)
        spread = channels_last(self.film.spread_out(each))
        return self.film.picture(spread / 4 * self._better(moments.mean(-1), rays)[..., None])

    def samples(self) -> np.ndarray:
        """Return the rays of each pixel, [H, W], without the border."""
        return self._inside(self.rows(self.rays).sum(0))

    # ------------------------------------------- Sharing --------------------------------------------

    def next(self, most: float, target: float | None) -> np.ndarray | None:
        """Return numbers of further groups, [2, pixels]; None where ``most`` leaves no room.

        Enough for an RMSE of ``target``, if that takes a mean of no more than ``most`` rays a pixel in all.
        """
        deviation, most = np.sqrt(self._decisive()), most * self.film.pixels
        if target is not None:
            wanted = _quiet(self.rays, deviation, (target / self.error().rmse) ** 2)
            least = self._step * self.rays.sum()
            if least <= wanted.sum() <= most:
                return self._groups(wanted)
            if wanted.sum() < least:
                most, self._step = min(most, least), 1.5 * self._step  # that it was short may be by chance
        return self._within(most, deviation)

    def _within(self, most: float, deviation: np.ndarray) -> np.ndarray | None:
        """Return numbers of groups that make no more than so many rays in all, and not many fewer.

        Rounding, and pixels under the filter, make of a budget more or less than it is. None where it makes
        too few to be worth a round.
        """
        have, best, spent = float(self.rays.sum()), None, 0.0
        room = budget = most - have
        low, left, high, over = 0.0, room, room, 0.0  # budgets, and how far they are from filling the room
        for _ in range(6):  # the Illinois method: what stays is counted for half
            groups = self._groups(_water(self.rays, deviation, have + budget))
            cost = self.cost(groups)
            if cost <= room:
                best, spent, low, left, over = groups, cost, budget, room - cost, over / 2
            else:
                high, left, over = budget, left / 2, cost - room
            if spent >= 0.95 * room or low == high:
                break
            budget = low + 0.98 * (high - low) * left / (left + over)
        return best if spent >= (LEAST_GROWTH - 1) * have else None

    def _groups(self, due: np.ndarray) -> np.ndarray:
        """Return whole numbers of groups for what is due; one at least."""
        missing, rounding = (due - self.rays) / GROUP, self._rounding()
        groups = np.floor(missing + rounding)
        if not groups.any():
            groups = (missing > 0) & (rounding >= rounding.max())
        return np.asarray(groups, np.int64)

    def _rounding(self) -> np.ndarray:
        """Return random numbers to add before rounding down; alike in a tile, where a filter has rays traced
        around all pixels that need some."""
        tile = TILE if self.film.reach else 1
        rows, columns = (np.arange(n) // tile for n in self.film.shape)
        random = np.random.default_rng((self._seed, int(self.rays.sum())))
        return random.random((rows[-1] + 1, columns[-1] + 1))[rows[:, None], columns].ravel()

    def _decisive(self) -> np.ndarray:
        """Return the variance of a ray's value that decides in each half, [2, pixels]: the other half's."""
        moments, rays = self._moments()
        moments = moments.mean(-1)
        measured = moments * self._better(moments, rays)
        mean = measured.mean((1, 2))[:, None, None]
        candidates = [w for w in _WINDOWS if w[0] >= self.film.reach] or _WINDOWS[-1:]
        around = {width: window_means(measured, width) for width, _ in candidates}
        step = max(1, math.isqrt(measured[0].size // _JUDGES))
        some = (slice(None), slice(None, None, step), slice(None, None, step))
        other = measured[::-1][some]

        def cost(smooth: np.ndarray, floor: float) -> float:
            deviation = np.sqrt((1 - floor) * smooth + (floor * mean + 1e-30))
            return float(((other / deviation).mean((1, 2)) * deviation.mean((1, 2))).sum())

        smooth = {w: _smoothed(measured[some], around[w[0]][some], rays[some], w[1]) for w in candidates}
        width, worth = best = min(candidates, key=lambda w: cost(smooth[w], _FLOORS[1]))
        floor = min(_FLOORS, key=lambda floor: cost(smooth[best], floor))
        variance = _smoothed(measured, around[width], rays, worth)
        return ((1 - floor) * variance + (floor * mean + 1e-30))[::-1].reshape(HALVES, -1)

    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance of a ray in each half and channel, [2, H, W, 3], and its rays, [2, H, W]."""
        rays = self.rows(self.rays)
        variance = (self._square - self._total**2 / rays[..., None]) / np.maximum(rays - 1, 1)[..., None]
        return np.float32(np.maximum(variance, 0)), np.float32(rays)

    def _better(self, moments: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return the squared error over that of independent rays whose value has this variance, [H, W].

        Below 1 where rays are stratified, and where a filter averages pixels.
        """
        found = np.float32(self._squared_error())
        expected = self.film.spread_out((moments / rays).sum(0)) / 4
        few = 0.1  # windows without noise take the picture's ratio
        found, expected = (window_means(v, _REGION) + few * v.mean() for v in (found, expected))
        return np.float32(found / np.maximum(expected, 1e-30))

    def _inside(self, values: np.ndarray) -> np.ndarray:
        return self.film.picture(values[..., None])[..., 0]


def _quarter_squares(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return a quarter of the squared difference of pictures, mean of colours, [H, W]."""
    return np.asarray(np.square(first - second, dtype=np.float64).mean(-1) / 4)


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums of values [H, W] over blocks."""
    for axis, size in enumerate(values.shape):
        values = np.add.reduceat(values, np.arange(0, size, side), axis)
    return values


def _smoothed(variance: np.ndarray, around: np.ndarray, rays: np.ndarray, worth: float) -> np.ndarray:
    """Return variances [..., H, W, ...] drawn towards their means in windows, the less the more rays."""
    share = 1.0 if math.isinf(worth) else worth / (rays + worth)
    return np.asarray(variance + share * (around - variance))


def _water(have: np.ndarray, shape: np.ndarray, amount: float) -> np.ndarray:
    """Return a multiple of ``shape``, or what there is where that is more, which sums to ``amount``."""
    return np.maximum(have, _factor(np.greater, shape, have, amount) * shape)


def _quiet(have: np.ndarray, deviation: np.ndarray, share: float) -> np.ndarray:
    """Return a multiple of ``deviation``, or what there is where that is more, which leaves this share of the
    squared error."""
    now = np.square(deviation) / have
    inverse = _factor(np.less, deviation, now, share * now.sum())
    return np.maximum(have, deviation / max(inverse, 1e-30))


def _factor(chosen: np.ufunc, shape: np.ndarray, given: np.ndarray, amount: float) -> float:
    """Return the factor by which the greater, or the less, of its product with ``shape`` and what is
    ``given`` sums to ``amount``.

    By Newton's steps: the sum is convex, or concave, in the factor, and they stay on one side of the root.
    """
    factor = amount / shape.sum()
    for _ in range(20):
        scaled = chosen(factor * shape, given)
        rest = given.sum() - given[scaled].sum()
        factor, last = max(amount - rest, 0) / max(shape[scaled].sum(), 1e-30), factor
        if abs(factor - last) < 1e-3 * last:
            break
    return float(factor)
