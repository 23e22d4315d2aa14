"""Sampling to an error: where further rays are worth most, and what they leave of the noise.

Four pictures are exposed at once, each from rays of its own. Two *halves* are averaged: their mean is the
picture, and their difference estimates its error, whatever integrator, sampler and filter are at work. Two
*scouts* of few rays are not averaged: they alone decide which pixels get how many further rays, and when to
stop. So no value decides the weight with which it is averaged, and the mean is right (D. Kirk and J. Arvo,
1991, have the bias of deciding by the values that are averaged; docs/maths.md has the proof).

Rays are shared out in proportion to the standard deviation of a pixel (J. Neyman, 1934). A few rays estimate
it badly, so it is smoothed over neighbours, and how far is decided by cross-validation: by which candidate,
formed of one scout, shares out rays best for the variance that the other scout measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mrt_mitsuba.filters.dof import REACH
from mrt_mitsuba.filters.grid import dilated, window_means
from mrt_mitsuba.output.error import ErrorEstimate, tail_shape
from mrt_mitsuba.rendering.exposing import Exposer, Groups, Stack

PICTURES = 4
HALVES, SCOUTS = [0, 1], [2, 3]
# Rays of scouts over those that are averaged: in the long run, and where rare rays may rule
SCOUTING, WILD = 1 / 15, 1 / 4
SUSPECT = 0.5  # shape of a tail where they may
TILE = 16  # pixels, under a filter
GROUP = 2  # rays that are traced together; each picture begins with one group to a pixel

# Candidates for the smoothing of variances: half the width of a window, and how many rays its mean is worth
_WINDOWS = ((1, 8), (1, 32), (2, 32), (2, math.inf), (4, math.inf), (8, math.inf))
_FLOORS = (0.0, 0.01, 0.1, 0.5)  # share of a region's mean in the variance of every pixel
_REGIONS = (8, math.inf)  # half the width of such regions; all of the picture
_JUDGES = 2**12  # pixels, about, that choose among the candidates
_REGION = 8  # half the width of the windows in which rays are compared with independent ones


class Halves(Stack):
    """Two half pictures and two scouts, and the moments of the rays in each pixel, as they grow by rounds.

    What to trace in a round: the numbers of groups that each pixel gets in each picture.
    """

    least = 256  #: mean rays of a pixel that a target takes at least, in a small picture
    last = False  #: was the last round decided?

    def __init__(
        self, exposer: Exposer, seed: int, blurred: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        film = exposer.film
        super().__init__(film, 2, len(exposer.names))
        self._exposer, self._seed, self._blurred = exposer, seed, blurred
        self._traced = np.zeros((PICTURES, film.pixels))
        self._total = np.zeros((PICTURES, *film.shape, 3), np.float32)
        self._square = np.zeros((PICTURES, *film.shape))  # mean of colours, as the next
        self._peak = np.zeros((PICTURES, *film.shape), np.float32)
        self._bad, self._unfit = np.zeros(film.shape, bool), 0.0

    # ------------------------------------------- Rounds ---------------------------------------------

    def first(self) -> np.ndarray:
        """Return one group for each pixel and picture."""
        return np.ones((PICTURES, self.film.pixels), np.int64)

    def cost(self, chosen: np.ndarray) -> int:
        """Return the number of rays that groups take, with those around the chosen pixels of halves."""
        return GROUP * int(self.widened(chosen[:2]).sum() + chosen[2:].sum())

    def trace(self, chosen: np.ndarray, advance: Callable[[int], object]) -> None:
        """Trace groups of rays."""
        counts = np.concatenate([self.widened(chosen[:2]), chosen[2:]])
        groups = Groups.spread(GROUP, counts, self._traced)
        exposed = self._exposer.expose(
            groups, self._seed, pictures=PICTURES, progressive=True, moments=True, advance=advance
        )
        bad = ~np.isfinite(exposed.square).all(-1)
        if bad.any():
            self._bad |= bad.any(0)
            worst = exposed.total[bad].max()
            self._unfit = float(exposed.peak[bad].max() if np.isfinite(worst) else worst)
            for values in (exposed.total, exposed.square, exposed.peak):
                values[bad] = 0
        self._traced += exposed.rays
        self._total += exposed.total
        self._square += exposed.square.mean(-1)
        np.maximum(self._peak, exposed.peak[..., 0], out=self._peak)
        with np.errstate(invalid="ignore"):
            self.add(exposed, chosen[:2] > 0)

    def unfit(self) -> str:
        """Return what radiance has no square in float32, and where; nothing if all has."""
        bad = np.argwhere(self._inside(self._bad))
        if not len(bad):
            return ""
        where = f"{len(bad)} pixels, the first at row {bad[0, 0]}, column {bad[0, 1]}"
        return f"radiance of {self._unfit:.3g} was met in {where}: they are left out of the error"

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], and the standard error and the rays of each pixel, [H, W]."""
        image = self.mean()[..., :3]
        shown = image if self._blurred is None else self._blurred(image)
        return shown, np.sqrt(self.variance().mean(-1)), self.samples()

    def samples(self) -> np.ndarray:
        """Return the rays of each pixel, those of scouts included, [H, W], without the border."""
        return self._inside(self.rows(self._traced).sum(0))

    # ------------------------------------------- Errors ---------------------------------------------

    def rmse(self) -> float:
        """Return the estimated RMSE of the picture, without the border, by its halves alone."""
        return math.sqrt(float(self._squares().mean()))

    def _squares(self) -> np.ndarray:
        """Return the estimated squared error of each pixel, [H, W], without the border."""
        halves = self.film.picture(self.pictures()[..., :3])
        if self._blurred is not None:
            halves = np.stack([self._blurred(half) for half in halves])
        return np.where(self._inside(self._unknown), 0, _quarter_squares(*halves))

    def error(self) -> ErrorEstimate:
        """Return the estimated RMSE with its interval, and the tail of what single rays contribute.

        The mean of squares of which each is as uncertain as it is large, correlated as the filter has it; the
        true error is a mean of as many squares, and as uncertain. The interval is that of a log-normal law,
        wider upwards the fewer squares make up the mean. Where the largest contributions of single rays have
        so heavy a tail that rays not met yet may rule the error, there is no upper end.
        """
        squares, correlation = self._squares(), self.film.correlation
        mean = float(squares.mean())
        if mean == 0:
            return ErrorEstimate(0.0, 0.0, 0.0, 0.0)
        if self._blurred is not None:  # pixels are as good as one in a window of the blur's reach
            squares, correlation = _blocks(squares, 2 * REACH), 1.0
        spread = math.sqrt(2 * correlation * float(np.square(squares).sum())) / float(squares.sum())
        return ErrorEstimate.of(math.sqrt(mean), spread, self._tail(HALVES))

    def forecast(self) -> tuple[float, float]:
        """Return the RMSE of the picture, and the shape of its tail, as the scouts have them."""
        self._scouted, self._shape = self._decisive([2], [3]), self._tail(SCOUTS)
        left = self._inside(self._scouted / self.rows(self.rays).sum(0))
        return math.sqrt(float(left.mean())), self._shape

    def variance(self) -> np.ndarray:
        """Return the estimated variance of each channel in the picture, [H, W, 3], without the border."""
        each = self._smooth([0, 2], [1, 3])
        both = np.stack([self._moments(which)[0] for which in ([0, 2], [1, 3])])
        quiet = window_means(both, 1) == 0
        if not both[::-1][quiet].any():  # where one half of the rays met no noise at all, the other met none
            each[quiet.all(0)] = 0
        each = self.film.spread_out(each * (1 / self.rows(self.rays)).sum(0) / 4)
        first, second = self.pictures()[..., :3]
        each = each * _gain(np.where(self._unknown, 0, _quarter_squares(first, second)), each)
        with np.errstate(invalid="ignore", over="ignore"):
            colors = np.where(self._unknown, 0, np.square(np.moveaxis(first - second, -1, 0)))
        colors = window_means(colors, 4) + 1e-30
        variance = np.moveaxis(each * colors / colors.mean(0), 0, -1)
        rounding = np.nan_to_num(np.square(2.0**-24 * self.mean()[..., :3], dtype=np.float64), posinf=0)
        return self.film.picture(variance) + rounding

    def _decisive(self, first: list[int], second: list[int]) -> np.ndarray:
        """Return the variance of a pixel times its rays, [H, W], as two sets of pictures have it."""
        means, inverse = [], np.zeros(self.film.shape)
        for which in (first, second):
            rays = self.rows(self._traced)[which].sum(0)
            means.append(self._total[which].sum(0) / rays[..., None])
            inverse += 1 / rays
        gain = _gain(_quarter_squares(*means), self._moments(first + second)[0] * inverse / 4)
        return self._smooth(first, second) * gain * self.film.averaging

    def _smooth(self, first: list[int], second: list[int]) -> np.ndarray:
        """Return the variance of a ray's value, [H, W], by two sets of pictures.

        Pixels that met no rare bright ray look quiet. So each borrows from its neighbours, and from as many
        as make what one set says most likely by what the other says.
        """
        each, counts = zip(*(self._moments(which) for which in (first, second)), strict=True)
        both, rays = np.stack(each), np.stack(counts)
        tiny = 1e-6 * both.mean() + 1e-30
        step = max(1, math.isqrt(both[0].size // _JUDGES))
        some = (..., slice(None, None, step), slice(None, None, step))
        other = both[::-1][some] + tiny
        widths = {width: _around(both, width)[some] for width in (*_REGIONS, *(w for w, _ in _WINDOWS))}

        def unlikely(candidate: tuple[int, float, float, float]) -> float:
            width, worth, floor, region = candidate
            expected = _drawn(both[some], widths[width], rays[some], worth)
            expected = expected + floor * (widths[region] - expected) + tiny
            return float(np.mean(np.log(expected) + other / expected))

        windows = [w for w in _WINDOWS if w[0] >= self.film.reach] or _WINDOWS[-1:]
        candidates = [(*w, floor, region) for w in windows for floor in _FLOORS for region in _REGIONS]
        width, worth, floor, region = min(candidates, key=unlikely)
        values, total = self._moments(first + second)
        smooth = _drawn(values, _around(values, width), total, worth)
        return np.asarray(smooth + floor * (_around(values, region) - smooth))

    def _moments(self, which: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the variance of a ray's value, mean of colours, and the rays, [H, W]."""
        rays, total = self.rows(self._traced)[which].sum(0), self._total[which].sum(0)
        square = self._square[which].sum(0)
        variance = (square - np.square(total, dtype=np.float64).mean(-1) / rays) / np.maximum(rays - 1, 1)
        return np.where(variance * rays > 1e-6 * square, variance, 0), rays

    def _tail(self, which: list[int]) -> float:
        """Return the Pareto shape of what single rays contribute to the pixels of some pictures.

        Of each pixel the brightest ray is known; the others are taken for alike, given all squares.
        """
        rays = self.rows(self._traced)[which]
        variances = np.stack([self._moments([picture])[0] for picture in which])
        most = np.maximum(self._peak[which] - self._total[which].mean(-1) / rays, 0)
        others = np.sqrt(np.maximum(variances - most**2 / np.maximum(rays - 1, 1), 0))
        values, counts = np.stack([most, others]) / rays, np.stack([np.ones_like(rays), rays - 1])
        return tail_shape(values.ravel(), counts.ravel())

    @property
    def _unknown(self) -> np.ndarray:
        """Where the picture is no number, or one that has no square, [H, W]."""
        return dilated(self._bad, self.film.reach)

    # ------------------------------------------- Sharing --------------------------------------------

    def next(self, most: float, rays: float, target: float | None) -> np.ndarray:
        """Return numbers of further groups.

        The scouts decide until ``most`` rays a pixel are enough for an RMSE of ``target``, or are all of the
        ``rays`` to spend. The next round is the last then, and what a half gets in it is decided by the other
        half, too: that knows more, and what it makes of this half's share cannot come back to it any more.
        """
        deviation, traced = _root(self._scouted), self._traced.sum()
        room = most * self.film.pixels - traced
        self.last = most >= rays
        if target is not None:
            self.last = self.last or GROUP * self._due(0, deviation, target).sum() <= room / 2
        if not self.last:
            scouting = SCOUTING if self._shape < SUSPECT else WILD
            half = self._share(0, deviation, room / 2 / (1 + scouting), None)
            due = scouting * (self.rays[0] + GROUP * half) - self._traced[2]
            return np.stack([half, half, *2 * [self._whole(due)]])
        room = rays * self.film.pixels - traced
        views = [_root(self._decisive([1 - half], SCOUTS)) for half in HALVES]
        halves = [self._share(half, views[half], room / 2, target) for half in HALVES]
        return np.stack([*halves, *np.zeros_like(halves)])

    def _due(self, half: int, deviation: np.ndarray, target: float) -> np.ndarray:
        """Return the groups that take the picture to a target, if the other half is like this one."""
        have = self.rays[half]
        now = float(np.mean(np.square(deviation) / (2 * have)))
        if now <= target**2:
            return np.zeros(self.film.pixels, np.int64)
        return self._whole(_quiet(have, deviation, target**2 / now) - have)

    def _share(self, half: int, deviation: np.ndarray, room: float, target: float | None) -> np.ndarray:
        """Return groups for a half: what a target takes, or as many as make nearly, but no more than, so many
        rays: rounding, and pixels under the filter, make of a budget more or less than it is."""
        if target is not None:
            best = self._due(half, deviation, target)
            if GROUP * self.widened(best[None]).sum() <= room:
                return best
        have, best, budget = self.rays[half], np.zeros(self.film.pixels, np.int64), room
        low, left, high, over = 0.0, room, room, 0.0  # budgets, and how far they are from filling the room
        for _ in range(6):  # the Illinois method: what stays is counted for half
            groups = self._whole(_water(have, deviation, have.sum() + budget) - have)
            cost = GROUP * self.widened(groups[None]).sum()
            if cost <= room:
                best, low, left, over = groups, budget, room - cost, over / 2
            else:
                high, left, over = budget, left / 2, cost - room
            if 0.95 * room <= cost <= room or low == high:
                break
            budget = low + 0.98 * (high - low) * left / (left + over)
        return best

    def _whole(self, rays: np.ndarray) -> np.ndarray:
        """Return whole numbers of groups for numbers of rays."""
        return np.asarray(np.floor(np.clip(rays, 0, 2.0**40) / GROUP + self._rounding()), np.int64)

    def _rounding(self) -> np.ndarray:
        """Return random numbers to add before rounding down; alike in a tile, where a filter has rays traced
        around all pixels that need some."""
        tile = TILE if self.film.reach else 1
        rows, columns = (np.arange(n) // tile for n in self.film.shape)
        random = np.random.default_rng((self._seed, int(self._traced.sum())))
        return random.random((rows[-1] + 1, columns[-1] + 1))[rows[:, None], columns].ravel()

    def _inside(self, values: np.ndarray) -> np.ndarray:
        return self.film.picture(values[..., None])[..., 0]


def _root(variance: np.ndarray) -> np.ndarray:
    """Return the deviation by which pixels share rays out, [pixels]; alike, where none was met."""
    return np.sqrt(variance.ravel() + 1e-30)


def _gain(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return squared errors over those expected of independent rays, [H, W], in windows.

    Below 1 where rays are stratified, and where a filter averages pixels.
    """
    few = 0.1  # windows without noise take the picture's ratio
    found, expected = (window_means(v, _REGION) + few * v.mean() for v in (found, expected))
    return found / np.maximum(expected, 1e-30)


def _around(values: np.ndarray, reach: float) -> np.ndarray:
    """Return means of values [..., H, W] in windows, or of all."""
    if math.isinf(reach):
        return np.broadcast_to(values.mean((-2, -1), keepdims=True), values.shape)
    return window_means(values, int(reach))


def _drawn(variance: np.ndarray, around: np.ndarray, rays: np.ndarray, worth: float) -> np.ndarray:
    """Return variances [..., H, W] drawn towards their means in windows, the less the more rays."""
    share = 1.0 if math.isinf(worth) else worth / (rays + worth)
    return np.asarray(variance + share * (around - variance))


def _quarter_squares(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return a quarter of the squared difference of pictures, mean of colours, [H, W]."""
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number is left out later
        return np.asarray(np.square(first - second, dtype=np.float64).mean(-1) / 4)


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums of values [H, W] over blocks."""
    for axis, size in enumerate(values.shape):
        values = np.add.reduceat(values, np.arange(0, size, side), axis)
    return values


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
