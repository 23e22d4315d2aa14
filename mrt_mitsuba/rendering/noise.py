"""Sampling to an error: where further rays are worth most, and what they leave of the noise.

Four pictures are exposed at once, each from rays of its own. Two *halves* are averaged: their mean is the
picture, and their difference estimates its error, whatever integrator, sampler and filter are at work. Two
*scouts* of few rays are not averaged: they alone decide which pixels get how many further rays, and when to
stop. So no value decides the weight with which it is averaged, and the mean is right (D. Kirk and J. Arvo,
1991, have the bias of deciding by the values that are averaged; docs/maths.md has the proof).

Rays are shared out in proportion to the standard deviation of a pixel (J. Neyman, 1934). A few rays estimate
it badly, so each pixel borrows from its neighbours: from windows around it, in the mixture that explains best
what other rays measure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mrt_mitsuba.filters.dof import REACH
from mrt_mitsuba.filters.grid import dilated, window_means
from mrt_mitsuba.output.error import DOUBTFUL, ErrorEstimate, tail_shape
from mrt_mitsuba.rendering.exposing import Exposer, FilmStarts, Groups, Independent, Sequences, Stack

HALVES, SCOUTS = [0, 1], [2, 3]
SUSPECT = 0.5  # shape of a tail where rare rays may rule
MARGIN = 0.95  # of the target to aim at: a forecast is as often too low as too high
MARGIN_FILTERED = 0.93  # where pixels share rays, and so no field can tell what another one takes
EVENLY = 0.2  # of the pixels make up noise that is even
TILE = 16  # pixels that round alike, under a filter: it has rays traced around all that need some
WINDOWS = (1, 2, 4, 8)  # half the widths of windows that pixels borrow from
JUDGES = 2**11  # pixels, about, that choose the mixture
LUMINANCE = (0.212671, 0.715160, 0.072169)  # of linear sRGB
MISSED = 0.25  # of a pixel like those that make up the noise: it may be among the others, unseen
STATED = 2  # squared errors that a stated variance counts as much as
KEPT = 0.75  # of the power by which sequences gain: it falls with their length
LEAST_RATIO = 0.05  # of squared errors to stated variances, to be believed: rare ones may be missing


@dataclass(frozen=True)
class Forecast:
    """What scouts foresee of a picture's error."""

    rmse: float  #: of the picture as it is
    tail: float  #: Pareto shape of what their rays contribute
    noisy: float  #: share of the pixels that make up the noise
    variance: np.ndarray  #: of a pixel times its rays, [H, W]

    @property
    def even(self) -> bool:
        """Is the noise in so many pixels that a few rays of each show it?"""
        return self.noisy > EVENLY and self.tail < SUSPECT


class Halves(Stack):
    """Two half pictures and two scouts, and the moments of the rays in each pixel, as they grow by rounds.

    What to trace in a round: the numbers of groups that each pixel gets in each picture, [4, pixels].
    """

    group = 2  #: rays that are traced together
    begin = (1, 1, 1, 1)  #: groups in each pixel of the first round
    scouting = (1 / 15, 1 / 4)  #: rays of scouts over those of halves; where rare rays may rule
    fields = 2  #: of a chessboard of pixels whose rays are independent
    least = 256  #: mean rays of a pixel that a target takes at least, in a small picture
    last = False  #: was the last round decided?

    def __init__(
        self, exposer: Exposer, seed: int, blurred: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        film = exposer.film
        super().__init__(film, 2, len(exposer.names))
        self._exposer, self._seed, self._blurred = exposer, seed, blurred
        self.margin = MARGIN_FILTERED if film.reach else MARGIN  #: of a target to aim at
        self._tile = TILE if film.reach else 1
        self._board = np.indices(film.shape).sum(0) % (1 if film.reach else self.fields)
        self._traced = np.zeros((4, film.pixels))
        self._total = np.zeros((3, 4, *film.shape), np.float32)
        self._square = np.zeros((4, *film.shape))  # mean of colours, as the next
        self._peak = np.zeros((4, *film.shape), np.float32)
        self._scouts = Stack(film, 2, 3) if film.reach else None  # as the filter has them
        self._earlier: tuple[float, np.ndarray] | None = None
        self._bad, self._unfit = np.zeros(film.shape, bool), 0.0

    # ------------------------------------------- Rounds ---------------------------------------------

    def first(self) -> np.ndarray:
        """Return what to trace in the first round."""
        return np.repeat([self.begin], self.film.pixels, 0).T

    def cost(self, chosen: np.ndarray) -> int:
        """Return the number of rays that groups take, with those around the chosen pixels of halves."""
        return self.group * int(self.widened(chosen[:2]).sum() + chosen[2:].sum())

    def trace(self, chosen: np.ndarray, advance: Callable[[int], object]) -> None:
        """Trace groups of rays."""
        if self.rays.all():
            _, halves = _compared(self._gathered([0]), self._gathered([1]))
            self._earlier = self.rays.mean(), halves
        counts = np.concatenate([self.widened(chosen[:2]), chosen[2:]])
        groups = Groups.spread(self.group, counts, self._traced)
        scalar = mi.variant().startswith("scalar")
        sampling = Independent(self._seed, 2**24) if scalar else Sequences(self._seed)
        starts = FilmStarts(self.film, sampling)
        exposed = self._exposer.expose(groups, starts, pictures=4, moments=True, advance=advance)
        total, peak = exposed.total, exposed.peak  # [3, 4, H, W], [4, H, W]
        square = exposed.square.mean(0)
        bad = ~np.isfinite(square)
        if bad.any():
            self._bad |= bad.any(0)
            worst = total[:, bad].max()
            self._unfit = float(peak[bad].max() if np.isfinite(worst) else worst)
            for values in (*total, square, peak):
                values[bad] = 0
        self._traced += exposed.rays
        self._total += total
        self._square += square
        np.maximum(self._peak, peak, out=self._peak)
        with np.errstate(invalid="ignore"):
            self.add(exposed, chosen[:2] > 0)
            if self._scouts:
                self._scouts.add(exposed, chosen[2:] > 0, first=2)

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

    def squares(self) -> np.ndarray:
        """Return the squared errors of pixels, by the halves alone, [H, W], without the border."""
        halves = self.film.picture(self.pictures()[..., :3])
        if self._blurred is not None:
            halves = np.stack([self._blurred(half) for half in halves])
        return np.where(self._inside(self._unknown), 0, quarter_squares(*halves).mean(-1))

    def error(self) -> ErrorEstimate:
        """Return the estimated RMSE with its interval, and the tail of what single rays contribute.

        It is a mean of squares, each as uncertain as it is large, correlated as the filter has it; the true
        error is a mean of as many squares, and as uncertain. The interval is that of a log-normal law,
        wider upwards the fewer squares make up the mean.
        """
        squares, correlation, tail = self.squares(), self.film.correlation, self._tail(HALVES)
        rmse = math.sqrt(float(squares.mean()))
        if self._blurred is not None:  # pixels are as good as one in a window of the blur's reach
            correlation = 1.0
            for axis in (0, 1):
                squares = np.add.reduceat(squares, range(0, squares.shape[axis], 2 * REACH), axis)
        spread = math.sqrt(2 * correlation * float(np.square(squares).sum())) / max(squares.sum(), 1e-300)
        width = 1.96 * spread / 2
        high = rmse * math.exp(width * (1 + spread)) if tail <= DOUBTFUL else math.inf
        return ErrorEstimate(rmse, rmse * math.exp(-width), high, tail)

    def luminance(self) -> float:
        """The mean luminance of the picture, as the scouts have it, which no value in the picture decides."""
        rays, total, _ = self._gathered(SCOUTS)
        colors = self.film.picture(np.moveaxis(total / rays, 0, -1))
        return float(colors.mean((0, 1)) @ LUMINANCE)

    def forecast(self) -> Forecast:
        """The error of the picture as the scouts foresee it."""
        variance = self._decisive([2], [3])
        left = self._inside(variance / self.rows(self.rays).sum(0))
        noisy = _number(_variance(self._gathered(SCOUTS))) / self.film.pixels
        return Forecast(math.sqrt(float(left.mean())), self._tail(SCOUTS), noisy, variance)

    def variance(self) -> np.ndarray:
        """Return the estimated variance of each channel in the picture, [H, W, 3], without the border."""
        each = self._decisive([0, 2], [1, 3], missed=2 * MISSED) * (1 / self.rows(self.rays)).sum(0) / 4
        colors = np.where(self._unknown[..., None], 0, quarter_squares(*self.pictures()[..., :3]))
        total = _calibrated(self.film.spread_out(each), colors.mean(-1))
        colors = window_means(np.moveaxis(colors, -1, 0), 4) + 1e-30
        variance = np.moveaxis(total * colors / colors.mean(0), 0, -1)
        rounding = np.nan_to_num(np.square(2.0**-24 * self.mean()[..., :3], dtype=np.float64), posinf=0)
        return self.film.picture(variance) + rounding

    def _decisive(
        self,
        first: list[int],
        second: list[int],
        near: np.ndarray | None = None,
        missed: float = MISSED,
    ) -> np.ndarray:
        """Return the variance of a pixel times its rays, [H, W], as two sets of pictures have it.

        Pixels that met no rare bright ray look quiet, so each borrows from windows around it, and from the
        picture: in the mixture of the first set that explains best what the second measures. Rays of a
        sequence err less than independent ones: by that much, the sets differ less than their rays do.
        ``near``: these differences of other sets, which show it better, [..., 2, H, W], for as many results.
        ``missed``: see ``MISSED``; what is stated counts it twice.
        """
        one, another = self._gathered(first), self._gathered(second)
        (both, own), seen, measured = _compared(one, another), _variance(one), _variance(another)
        parts, more = self._around(np.stack([seen, both]))
        shares = _mixture(parts, measured)
        shares[0] = max(shares[0], missed / max(_number(both), 1))
        mixed = np.tensordot(shares, more, 1)
        quiet, also = window_means(np.stack([seen, measured]), 1) == 0
        if not (measured[quiet].any() or seen[also].any()):  # where one met no noise, the other met none
            mixed[quiet & also] = 0
        near = _near(own, WINDOWS[3:]) if near is None else near
        # where there is no noise near, all of the picture
        found, expected = np.moveaxis(near + 1e-3 * own.mean((-2, -1), keepdims=True), -3, 0)
        ratio = self.film.even * found / np.maximum(expected, 1e-30) + self._uneven()
        return np.asarray(mixed * ratio * self.film.averaging)

    def _uneven(self) -> float:
        """What the filter's change within a pixel adds to the ratio of a pixel's variance to that of
        independent rays, as the scouts have it.

        Values that depend on other dimensions gain nothing there by an even sequence, edges do.
        """
        if self._scouts is None:
            return 0.0
        rest = 1 - self.film.even
        _, (found, expected) = _compared(self._gathered([2]), self._gathered([3]))
        squares = np.where(self._unknown, 0, quarter_squares(*self._scouts.pictures()).mean(-1)).mean()
        added = squares / self.film.averaging - self.film.even * found.mean()
        return float(np.clip(added / max(expected.mean(), 1e-300), 0, rest))

    def _around(self, values: np.ndarray) -> np.ndarray:
        """Return values [..., H, W], their means in windows, and the mean of all, [..., parts, H, W]."""
        parts = [values * 0 + values.mean((-2, -1), keepdims=True)] + ([] if self.film.reach else [values])
        parts += [window_means(values, width) for width in WINDOWS if width >= self.film.reach]
        return np.stack(parts, -3)

    def _gathered(self, which: list[int]) -> list[np.ndarray]:
        """Return the rays of some pictures together, [H, W], the sums of their colours, [3, H, W], and those
        of squares, [H, W]."""
        return [v[..., which, :, :].sum(-3) for v in (self.rows(self._traced), self._total, self._square)]

    def _tail(self, which: list[int]) -> float:
        """Return the Pareto shape of what single rays contribute to the pixels of some pictures.

        Of each pixel the brightest ray is known; the others are taken for alike, given all squares.
        """
        sums = self.rows(self._traced)[which], self._total[:, which], self._square[which]
        rays, total, _ = sums
        most = np.maximum(self._peak[which] - total.mean(0) / rays, 0)
        others = np.sqrt(np.maximum(_variance(sums) - most**2 / np.maximum(rays - 1, 1), 0))
        values, counts = np.stack([most, others]) / rays, np.stack([np.ones_like(rays), rays - 1])
        return tail_shape(values.ravel(), counts.ravel())

    @property
    def _unknown(self) -> np.ndarray:
        """Where the picture is no number, or one that has no square, [H, W]."""
        return dilated(self._bad, self.film.reach)

    # ------------------------------------------- Sharing --------------------------------------------

    def next(
        self,
        forecast: Forecast | None,
        most: float,
        rays: float,
        target: float | None = None,
        even: float = 0,
    ) -> np.ndarray:
        """Numbers of further groups; without a forecast, of the last round.

        The scouts decide until ``most`` rays a pixel are enough for an RMSE of ``target``, or are all of the
        ``rays`` to spend. The next round is the last then, and what a half gets in it is decided by the other
        half, too: that knows more, and what it makes of this half's share cannot come back to it any more.
        How much less a sequence errs, the halves show best: in pixels of the other colour of a chessboard,
        so that no value moves its own weight. Before the last round, no pixel is taken for less noisy than
        ``even`` times the mean.
        """
        room = most * self.film.pixels - self._traced.sum()
        self.last = forecast is None or most >= rays
        if forecast is not None and target is not None:
            deviation = np.sqrt(forecast.variance.ravel())
            wanted = np.maximum(deviation * deviation.mean() / (2 * target**2) - self.rays[0], 0)
            self.last = self.last or wanted.sum() <= room / 2
        if forecast is not None and not self.last:
            scouting = self.scouting[forecast.tail >= SUSPECT]
            room, everywhere = room / 2 / (1 + scouting), np.ones(self.film.shape, bool)
            half = self._share(0, forecast.variance, room, None, everywhere, even)
            wanted = scouting * (self.rays[0] + self.group * half)
            scouts = self._due(wanted, self._traced[2], self._rounding())
            return np.stack([half, half, scouts, scouts])
        room += (rays - most) * self.film.pixels
        fields = np.stack([self._board == field for field in range(self._board.max() + 1)])
        _, halves = _compared(self._gathered([0]), self._gathered([1]))
        near = _near(halves * ~fields[:, None], WINDOWS[2:]) if len(fields) > 1 else None
        each = (1 / self.rows(self.rays)).sum(0) / 4  # of a ray's variance is in the squares of halves
        chosen = np.zeros((4, self.film.pixels), np.int64)
        for index in HALVES:
            views = self._decisive([1 - index], SCOUTS, near).reshape(fields.shape)
            for field, variance in zip(fields, views, strict=True):
                gain = 0.0
                if near is not None:
                    variance = _calibrated(variance * each, halves[0], ~field) / each
                    gain = self._gain(~field, halves)
                chosen[index] += self._share(index, variance, room / 2 * field.mean(), target, field, 0, gain)
        return chosen

    def _gain(self, among: np.ndarray, halves: np.ndarray) -> float:
        """By what power of the rays, beyond the first, variance falls in some pixels [H, W].

        ``halves``: their squares, and what these are for independent rays, [2, H, W]; the same is known of
        the round before.
        """
        if self._earlier is None:
            return 0.0
        rays, earlier = self._earlier
        now, then = (values[:, among].sum(1) for values in (halves, earlier))
        if min(*now, *then) <= 0:
            return 0.0
        power = math.log(then[0] / then[1] * now[1] / now[0]) / math.log(self.rays.mean() / rays)
        return KEPT * min(max(power, 0.0), 0.5)

    def _share(
        self,
        half: int,
        variance: np.ndarray,
        room: float,
        target: float | None,
        among: np.ndarray,
        even: float,
        gain: float = 0.0,
    ) -> np.ndarray:
        """Return groups for a half: what a target takes, if the other half is like this one, or nearly, but
        no more than, what there is room for. Rays are a multiple of the deviation, or what there is."""
        deviation = window_means(np.sqrt(variance + 1e-30), 1)[among]  # single pixels are known badly
        deviation = np.maximum(deviation, even * deviation.mean())
        have, rounding, variance = (
            v.reshape(among.shape)[among] for v in (self.rays[half], self._rounding(), variance)
        )
        low, high, best = 0.0, (room + have.sum()) / deviation.sum(), np.zeros(len(have), np.int64)
        if target is not None:
            high = min(high, deviation.mean() / (2 * target**2))
        factor = high
        for _ in range(12):
            groups = self._due(factor * deviation, have, rounding)
            fits = self.group * self.widened(groups[None]).sum() <= room
            best = groups if fits else best
            rays = have + self.group * groups
            left = variance / rays * (have / rays) ** gain
            if fits and (target is None or left.mean() > 2 * target**2):
                low = factor
            else:
                high = factor
            factor = (low + high) / 2
        shares = np.zeros(among.shape, np.int64)
        shares[among] = best
        return shares.ravel()

    def _rounding(self) -> np.ndarray:
        """Return random numbers to add before rounding down, alike in a tile."""
        rows, columns = (np.arange(n) // self._tile for n in self.film.shape)
        random = np.random.default_rng((self._seed, int(self._traced.sum())))
        return random.random((rows[-1] + 1, columns[-1] + 1))[rows[:, None], columns].ravel()

    def _due(self, rays: np.ndarray, have: np.ndarray, rounding: np.ndarray) -> np.ndarray:
        """Return the groups that make of the rays there are so many.

        Or a multiple of a power of two near it, an eighth to a quarter of it: a sequence errs less then.
        """
        rays = np.minimum(rays, 2.0**40)
        step = np.ldexp(0.125, np.maximum(np.frexp(rays)[1], 4))
        due = np.floor(rays / step + rounding) * step - have
        return np.asarray(np.maximum(due, 0) / self.group, np.int64)

    def _inside(self, values: np.ndarray) -> np.ndarray:
        return self.film.picture(values[..., None])[..., 0]


def quarter_squares(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return a quarter of the squared difference of pictures; what is no number is left out later."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.square(first - second, dtype=np.float64) / 4)


def _compared(one: Sequence[np.ndarray], another: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the variance of the rays of two sets, given sums as of ``_gathered``; and a quarter of their
    squared difference, and what it is for independent rays, [2, H, W]."""
    variance = _variance([a + b for a, b in zip(one, another, strict=True)])
    found = quarter_squares(*(total / rays for rays, total, _ in (one, another))).mean(0)
    return variance, np.stack([found, variance * (1 / one[0] + 1 / another[0]) / 4])


def _near(values: np.ndarray, widths: Sequence[int]) -> np.ndarray:
    """Return what values [..., H, W] are around each pixel, a little of the mean of all among it."""
    return np.asarray(
        np.mean([window_means(values, width) for width in widths], 0)
        + 0.2 * values.mean((-2, -1), keepdims=True)
    )


def _variance(sums: Sequence[np.ndarray]) -> np.ndarray:
    """Return the variance of a ray's value, the mean of its colours, given sums as of ``_gathered``."""
    rays, total, square = sums
    variance = (square - np.square(total, dtype=np.float64).mean(0) / rays) / np.maximum(rays - 1, 1)
    return np.where(variance * rays > 1e-6 * square, variance, 0)


def _mixture(parts: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the shares, 0 or more, in which parts [parts, H, W] add up to what is nearest to values [H, W].

    By W. Richardson's and L. Lucy's steps (1972, 1974), in which a value weighs the less the more is expected
    of it, since a variance is as uncertain as it is large.
    """
    step, tiny = max(1, math.isqrt(measured.size // JUDGES)), 1e-6 * measured.mean() + 1e-30
    known = parts[:, ::step, ::step].reshape(len(parts), -1) + tiny
    values, shares = measured[::step, ::step].ravel() + tiny, np.full(len(parts), 1 / len(parts))
    for _ in range(30):
        expected = shares @ known
        weights = 1 / np.sqrt(expected)
        shares *= known @ (weights * values / expected) / (known @ weights)
    return shares


def _calibrated(variance: np.ndarray, squares: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
    """Return variances [H, W], each tenth of them, as they sort, drawn to the mean of its squared errors.

    The more squares make up that mean, the more: a tenth in which both halves missed the same rare rays has
    none, and keeps what was stated. ``among``: the pixels whose squares count, [H, W]; None: all.
    """
    noisy = variance > 0
    if not noisy.any():
        return variance.copy()
    edges = np.quantile(variance[noisy], np.arange(1, 10) / 10)
    tenth = np.searchsorted(edges, variance)  # of each pixel, 0 to 9
    judging = noisy if among is None else noisy & among
    judged = tenth[judging]
    errors = squares[judging]
    stated = np.bincount(judged, variance[judging], 10)
    measured = np.bincount(judged, errors, 10)
    number = measured**2 / np.maximum(np.bincount(judged, np.square(errors), 10), 1e-300)
    ratio = np.maximum(measured / np.maximum(stated, 1e-300), LEAST_RATIO)
    drawn = ratio ** (number / (number + STATED))
    return np.asarray(variance * drawn[tenth])


def _number(values: np.ndarray) -> float:
    """Return how many values make up their sum: all if they are equal, one if it rules."""
    return float(values.sum() ** 2 / max(np.square(values).sum(), 1e-300))
