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
from functools import cached_property
from typing import Protocol

import mitsuba as mi
import numpy as np

from mrt_mitsuba.adaptive.error import DOUBTFUL, ErrorEstimate, tail_shape
from mrt_mitsuba.filters.dof import REACH
from mrt_mitsuba.filters.grid import dilated, window_means
from mrt_mitsuba.plugins import plugin
from mrt_mitsuba.rendering.exposing import Exposer, FilmAccumulator, RayBatch, film_samples, widened
from mrt_mitsuba.rendering.film import Film
from mrt_mitsuba.rendering.progress import Advance

HALVES, SCOUTS = [0, 1], [2, 3]
SUSPECT = 0.5  # shape of a tail where rare rays may rule
MARGIN = 0.95  # of the target to aim at: a forecast is as often too low as too high
MARGIN_FILTERED = 0.93  # where pixels share rays, and so no field can tell what another one takes
EVENLY = 0.2  # of the pixels make up noise that is even
TILE = 16  # pixels that round alike, under a filter: it has rays traced around all that need some
WINDOWS = (1, 2, 4, 8)  # half the widths of windows that pixels borrow from
JUDGES = 2**11  # pixels, about, that choose the mixture
RANKED = 2**12  # pixels, about, by which tenths are found
LEVELS = 64  # of errors, by which a power of them is found
LUMINANCE = (0.212671, 0.715160, 0.072169)  # of linear sRGB
MISSED = 0.25  # of a pixel like those that make up the noise: it may be among the others, unseen
STATED = 2  # squared errors that a stated variance counts as much as
KEPT = 0.75  # of the power by which sequences gain: it falls with their length
LEAST_RATIO = 0.05  # of squared errors to stated variances, to be believed: rare ones may be missing
ROUND_TRIPS = 8  # for shares of whole groups to fill the room, once they fit into it
FULL = 0.995  # of the room is all of it
ALMOST = 0.9975  # of the room is aimed at, for shares to be less than it and enough

Blurred = Callable[[np.ndarray], np.ndarray]


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

    @property
    def rare(self) -> bool:
        """Is it in few pixels, and perhaps ruled by rare rays?"""
        return self.noisy <= EVENLY and self.tail >= SUSPECT


@dataclass(frozen=True)
class Sums:
    """Sums over the rays of each pixel, of one picture or of several together, float32, in ``State.unit``."""

    rays: np.ndarray  #: [H, W]
    total: np.ndarray  #: of colours, [3, H, W]
    square: np.ndarray  #: of their squares, the mean of the three, [H, W]

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.rays + other.rays, self.total + other.total, self.square + other.square)

    @cached_property
    def mean(self) -> np.ndarray:
        """Mean colours, [3, H, W]."""
        return np.asarray(self.total / self.rays)

    @cached_property
    def variance(self) -> np.ndarray:
        """Variance of a ray's value, the mean of its colours, [H, W]."""
        left = self.square - mean_square(self.mean) * self.rays
        left[left < np.float32(1e-6) * self.square] = 0  # as far as it is known
        return np.asarray(left / np.maximum(self.rays - 1, 1))


@dataclass(frozen=True)
class State:
    """What has been exposed: the moments of the rays in each pixel of four pictures, and the pictures."""

    rays: np.ndarray  #: [4, H, W]
    total: np.ndarray  #: sums of colours, [3, 4, H, W]
    square: np.ndarray  #: sums of squares, the mean of the colours, [4, H, W]
    peak: np.ndarray  #: the mean colour of the brightest ray, [4, H, W]
    halves: FilmAccumulator
    scouts: FilmAccumulator | None  #: as a filter has them; None under a box
    bad: np.ndarray  #: met a ray whose colour is no number, or has no square, [H, W]
    unfit: float  #: the largest of such colours
    earlier: np.ndarray | None  #: ``differences`` of the halves a round before, [2, H, W]
    exposures: int  #: number of them

    @classmethod
    def blank(cls, film: Film, channels: int) -> State:
        """Nothing."""
        four = (4, *film.shape)
        return cls(
            rays=np.zeros(four),
            total=np.zeros((3, *four), np.float32),
            square=np.zeros(four),
            peak=np.zeros(four, np.float32),
            halves=FilmAccumulator.blank(film, 2, channels),
            scouts=FilmAccumulator.blank(film, 2, 3) if film.reach else None,
            bad=np.zeros(film.shape, bool),
            unfit=0.0,
            earlier=None,
            exposures=0,
        )

    @cached_property
    def unit(self) -> float:
        """Mean square of a ray, in which variances are given: squares of them fit into single precision.

        As the scouts have it, so that no value in the picture decides the last bit of a share.
        """
        return float(self.square[SCOUTS].sum() / max(self.rays[SCOUTS].sum(), 1)) or 1.0

    @cached_property
    def _each(self) -> list[Sums]:
        """Those of each picture."""
        rays = self.rays.astype(np.float32)
        total = self.total * np.float32(self.unit**-0.5)
        square = (self.square / self.unit).astype(np.float32)
        return [Sums(rays[picture], total[:, picture], square[picture]) for picture in range(len(rays))]

    def sums(self, first: int, second: int | None = None) -> Sums:
        """Those of a picture, or of two together."""
        return self._each[first] if second is None else self._each[first] + self._each[second]

    @cached_property
    def differing(self) -> np.ndarray:
        """The halves' ``differences``."""
        return differences(self.sums(0), self.sums(1))

    def samples(self) -> np.ndarray:
        """The rays of each pixel, those of scouts included, [H, W], without the border."""
        return self.inside(self.rays.sum(0))

    def image(self) -> np.ndarray:
        """The mean of the halves, [H, W, channels], without the border."""
        return self.halves.mean()

    @cached_property
    def channels(self) -> np.ndarray:
        """Squared errors of the picture's channels, by the halves alone, [3, H, W], with the border."""
        sums = self.halves.sums[:3]
        weights = np.where(self.halves.weights == 0, 1, self.halves.weights)
        squares = quarter_squares(sums[:, 0] / weights[0], sums[:, 1] / weights[1])
        squares[:, self.unknown] = 0
        return squares

    def squares(self, blurred: Blurred | None) -> np.ndarray:
        """Squared errors of pixels, by the halves alone, [H, W], without the border."""
        if blurred is None:
            return self.inside(self.channels.mean(0))
        halves = [blurred(half) for half in self.halves.film.picture(self.halves.pictures()[..., :3])]
        return np.where(self.inside(self.unknown), 0, quarter_squares(*halves).mean(-1))

    def luminance(self) -> float:
        """The mean luminance of the picture, as the scouts have it, which no value in the picture decides."""
        total = self.total[:, SCOUTS].sum(1) / self.rays[SCOUTS].sum(0)
        colors = self.halves.film.picture(np.moveaxis(total, 0, -1))
        return float(colors.mean((0, 1)) @ LUMINANCE)

    def unfit_rays(self) -> str:
        """Radiance that has no square in float32, and where; nothing if all has."""
        bad = np.argwhere(self.inside(self.bad))
        if not len(bad):
            return ""
        where = f"{len(bad)} pixels, the first at row {bad[0, 0]}, column {bad[0, 1]}"
        return f"radiance of {self.unfit:.3g} was met in {where}: they are left out of the error"

    @property
    def unknown(self) -> np.ndarray:
        """Where the picture is no number, or one that has no square, [H, W]."""
        return dilated(self.bad, self.halves.film.reach)

    def inside(self, values: np.ndarray) -> np.ndarray:
        """Values [H, W] without the border."""
        return self.halves.film.picture(values[..., None])[..., 0]


class Noise(Protocol):
    """Estimates the error of two half pictures, and decides what to trace to lessen it.

    What to trace is given as numbers of groups, [4, pixels]: of the halves, then of the scouts.
    """

    film: Film
    blurred: Blurred | None  #: what is done to the picture in the end, by which errors are judged
    margin: float  #: of a target to aim at
    gain: float  #: by what power of the rays variance may fall beyond the first
    least: float  #: mean rays of a pixel that a target takes at least, in a small picture
    begin: np.ndarray  #: what to trace first

    def blank(self) -> State:
        """What is known before anything is traced."""
        ...

    def cost(self, chosen: np.ndarray) -> int:
        """The rays that it takes."""
        ...

    def trace(self, state: State, chosen: np.ndarray, advance: Advance) -> State:
        """What is known after tracing it as well."""
        ...

    def tail(self, state: State, pictures: Sequence[int]) -> float:
        """Pareto shape of what rays contribute to some pictures."""
        ...

    def forecast(self, state: State) -> Forecast:
        """The error of the picture, as the scouts foresee it."""
        ...

    def wanted(self, state: State, forecast: Forecast, target: float) -> float:
        """Mean rays of a pixel, in all, that take the picture to an RMSE, as the scouts foresee it."""
        ...

    def shares(self, state: State, forecast: Forecast, most: float, even: float) -> np.ndarray:
        """What takes the mean rays of a pixel to ``most``, decided by the scouts alone.

        No pixel is taken for less noisy than ``even`` times the mean.
        """
        ...

    def last_shares(self, state: State, most: float, target: float | None) -> np.ndarray:
        """What takes the picture to an RMSE, or the mean rays of a pixel to ``most``, for the last round.

        The halves decide for each other: what one makes of the other's share cannot come back to it any more.
        """
        ...

    def variance(self, state: State) -> np.ndarray:
        """The estimated variance of each channel in the picture, [H, W, 3], without the border."""
        ...


def estimate(noise: Noise, state: State) -> ErrorEstimate:
    """The estimated RMSE with its interval, and the tail of what single rays contribute.

    It is a mean of squares, each as uncertain as it is large, correlated as the filter has it; the true
    error is a mean of as many squares, and as uncertain. The interval is that of a log-normal law,
    wider upwards the fewer squares make up the mean.
    """
    squares = state.squares(noise.blurred)
    correlation = noise.film.correlation
    tail = noise.tail(state, HALVES)
    rmse = math.sqrt(float(squares.mean()))
    if noise.blurred is not None:  # pixels are as good as one in a window of the blur's reach
        correlation = 1.0
        for axis in (0, 1):
            squares = np.add.reduceat(squares, range(0, squares.shape[axis], 2 * REACH), axis)
    spread = math.sqrt(2 * correlation * float(np.square(squares).sum())) / max(squares.sum(), 1e-300)
    width = 1.96 * spread / 2
    high = rmse * math.exp(width * (1 + spread)) if tail <= DOUBTFUL else math.inf
    return ErrorEstimate(rmse, rmse * math.exp(-width), high, tail)


class RayNoise:
    """The noise of rays, each in a pixel that is chosen for it. See ``Noise``."""

    least = 256.0
    scouting = (1 / 15, 1 / 4)  #: rays of scouts over those of halves; where rare rays may rule

    def __init__(self, exposer: Exposer, seed: int, blurred: Blurred | None = None) -> None:
        self.film: Film = exposer.film
        self.blurred = blurred
        self.margin = MARGIN_FILTERED if self.film.reach else MARGIN
        self._exposer = exposer
        self._seed = seed
        samplers = plugin("samplers", "mrt_mitsuba.adaptive")
        self._sampler = mi.load_dict({"type": samplers.ADAPTIVE})
        self._group = self._sampler.group
        self.gain: float = self._sampler.gain
        self.begin = np.ones((4, self.film.pixels), np.int64)
        # under a filter, pixels share rays
        fields = 1 if self.film.reach else self._sampler.fields
        board = np.indices(self.film.shape).sum(0) % fields
        self._fields = [board == field for field in range(fields)]

    # ------------------------------------------- Tracing --------------------------------------------

    def blank(self) -> State:
        return State.blank(self.film, len(self._exposer.names))

    def cost(self, chosen: np.ndarray) -> int:
        return self._group * int(self._traced(chosen).sum())

    def _traced(self, chosen: np.ndarray) -> np.ndarray:
        """What is chosen, with groups around the chosen pixels of halves as far as the filter reaches."""
        return np.concatenate([widened(self.film, chosen[:2]), chosen[2:]])

    def trace(self, state: State, chosen: np.ndarray, advance: Advance) -> State:
        groups = RayBatch.from_counts(self._group, self._traced(chosen), state.rays)
        samples = film_samples(self.film, self._seed, self._sampler)
        exposed = self._exposer.expose(groups, samples, pictures=4, moments=True, advance=advance)
        total, peak = exposed.total, exposed.peak
        square = exposed.square.mean(0)
        bad, unfit = state.bad, state.unfit
        new = ~np.isfinite(square)
        if new.any():
            bad = bad | new.any(0)
            worst = total[:, new].max()
            unfit = float(peak[new].max() if np.isfinite(worst) else worst)
            for values in (*total, square, peak):
                values[new] = 0
        scouts = state.scouts
        earlier = None
        if state.rays.all():
            earlier = state.differing
        with np.errstate(invalid="ignore"):
            halves = state.halves.accumulate(exposed, chosen[:2] > 0)
            if scouts is not None:
                scouts = scouts.accumulate(exposed, chosen[2:] > 0, first=2)
        return State(
            rays=state.rays + exposed.rays.reshape(state.rays.shape),
            total=state.total + total,
            square=state.square + square,
            peak=np.maximum(state.peak, peak),
            halves=halves,
            scouts=scouts,
            bad=bad,
            unfit=unfit,
            earlier=earlier,
            exposures=state.exposures + 1,
        )

    # ------------------------------------------- Errors ---------------------------------------------

    def tail(self, state: State, pictures: Sequence[int]) -> float:
        """Of each pixel the brightest ray is known; the others are taken for alike, given all squares."""
        each = [state.sums(picture) for picture in pictures]
        rays = np.stack([sums.rays for sums in each])
        variance = np.stack([sums.variance for sums in each])
        means = np.stack([sums.mean.mean(0) for sums in each])
        peak = state.peak[list(pictures)] * np.float32(state.unit**-0.5)
        most = np.maximum(peak - means, 0)
        others = np.sqrt(np.maximum(variance - most**2 / np.maximum(rays - 1, 1), 0))
        values = np.stack([most / rays, others / rays])
        counts = np.stack([np.ones_like(rays), rays - 1])
        return tail_shape(values.ravel(), counts.ravel())

    def forecast(self, state: State) -> Forecast:
        variance = self._variance_of_rays(state, state.sums(2), state.sums(3))
        left = state.inside(variance / state.rays[:2].sum(0))
        noisy = number_of(state.sums(*SCOUTS).variance) / self.film.pixels
        return Forecast(math.sqrt(float(left.mean())), self.tail(state, SCOUTS), noisy, variance)

    def variance(self, state: State) -> np.ndarray:
        each = self._variance_of_rays(state, state.sums(0, 2), state.sums(1, 3), missed=2 * MISSED)
        each *= (1 / state.rays[:2]).sum(0) / 4
        total = _calibrated(self.film.filtered_variance(each), state.channels.mean(0))
        near = window_means(state.channels, 4) + 1e-30
        variance = np.moveaxis(total * near / near.mean(0), 0, -1)
        rounding = np.square(2.0**-24 * state.image()[..., :3], dtype=np.float64)
        return self.film.picture(variance) + np.nan_to_num(rounding, posinf=0)

    def _variance_of_rays(
        self,
        state: State,
        first: Sums,
        second: Sums,
        near: np.ndarray | None = None,
        missed: float = MISSED,
    ) -> np.ndarray:
        """The variance of a pixel times its rays, [H, W], as two sets of rays have it.

        Pixels that met no rare bright ray look quiet, so each borrows from windows around it, and from the
        picture: in the mixture of the first set that explains best what the second measures. Rays of a
        sequence err less than independent ones: by that much, the sets differ less than their rays do.
        ``near``: the ``differences`` of other sets around each pixel, which show it better, [..., 2, H, W],
        for as many results. ``missed``: see ``MISSED``; what is stated counts it twice.
        """
        seen = first.variance
        measured = second.variance
        both = (first + second).variance
        parts, more = self._around(np.stack([seen, both]))
        shares = _mixture(parts, measured)
        shares[0] = max(shares[0], missed / max(number_of(both), 1))
        mixed = np.tensordot(shares.astype(np.float32), more, 1)
        quiet, also = window_means(np.stack([seen, measured]), 1) == 0
        if not (measured[quiet].any() or seen[also].any()):  # where one met no noise, the other met none
            mixed[quiet & also] = 0
        if near is None:
            near = _nearby(differences(first, second), WINDOWS[3:])
        found, expected = np.moveaxis(near, -3, 0)
        ratio = self.film.between_pixel_share * found / np.maximum(expected, 1e-30) + self._uneven(state)
        return np.asarray(mixed * ratio * np.float32(self.film.filter_variance_ratio * state.unit))

    def _uneven(self, state: State) -> float:
        """What the filter's change within a pixel adds to the ratio of a pixel's variance to that of
        independent rays, as the scouts have it.

        Values that depend on other dimensions gain nothing there by an even sequence, edges do.
        """
        if state.scouts is None:
            return 0.0
        rest = 1 - self.film.between_pixel_share
        found, expected = differences(state.sums(2), state.sums(3)).mean((1, 2), dtype=np.float64)
        squares = quarter_squares(*state.scouts.pictures()).mean(-1)
        seen = np.where(state.unknown, 0, squares).mean() / state.unit
        added = seen / self.film.filter_variance_ratio - self.film.between_pixel_share * found
        return float(np.clip(added / max(expected, 1e-300), 0, rest))

    def _around(self, values: np.ndarray) -> np.ndarray:
        """Values [..., H, W], their means in windows, and the mean of all, [parts, ..., H, W] of the last
        but two axes first."""
        parts = [values * 0 + values.mean((-2, -1), keepdims=True)]
        if not self.film.reach:
            parts.append(values)
        parts += [window_means(values, width) for width in WINDOWS if width >= self.film.reach]
        return np.stack(parts, -3)

    # ------------------------------------------- Sharing --------------------------------------------

    def wanted(self, state: State, forecast: Forecast, target: float) -> float:
        deviation = np.sqrt(forecast.variance, dtype=np.float64)
        half = np.maximum(deviation * (deviation.mean() / (2 * target**2)), state.rays[0])
        return float(2 * (half - state.rays[0]).mean() + state.rays.sum(0).mean())

    def shares(self, state: State, forecast: Forecast, most: float, even: float) -> np.ndarray:
        scouting = self.scouting[forecast.tail >= SUSPECT]
        room = self._room(state, most) / 2 / (1 + scouting)
        rounding = self._rounding(state)
        deviation = _smoothed(forecast.variance)
        deviation = np.maximum(deviation, even * deviation.mean())
        half = self._share(state.rays[0], deviation, room, rounding)
        wanted = scouting * (state.rays[0].ravel() + self._group * half)
        scouts = self._due(wanted, state.rays[2].ravel(), rounding.ravel())
        return np.stack([half, half, scouts, scouts])

    def last_shares(self, state: State, most: float, target: float | None) -> np.ndarray:
        """A half's own rays show best how unequal errors are, and the halves' difference how much less a
        sequence errs: both in pixels of the other colour of a chessboard, so that no value moves its own
        weight."""
        room = self._room(state, most) / 2
        rounding = self._rounding(state)
        scouts = state.sums(*SCOUTS)
        alone = len(self._fields) == 1
        near = None if alone else np.stack([_nearby(state.differing * ~f, WINDOWS[2:]) for f in self._fields])
        # of a ray's variance in the squares of the halves' difference
        weight = np.float32((1 / state.rays[HALVES]).sum(0) / (4 * state.unit))
        own = [] if alone else [_own_errors(state, index) for index in HALVES]
        chosen = np.zeros((4, self.film.pixels), np.int64)
        for index in HALVES:
            have = state.rays[index]
            views = self._variance_of_rays(state, state.sums(1 - index), scouts, near)
            for field, variance in zip(self._fields, views.reshape(-1, *self.film.shape), strict=True):
                gain = 0.0
                if near is not None:
                    errors = _levelled(variance * weight, own[index], ~field)
                    drawn = _drawn(errors[~field], state.differing[0][~field])
                    variance = errors * drawn / weight
                    gain = self._gain(state, ~field)
                deviation = _smoothed(variance)
                part = room * field.mean()
                factor = math.inf
                if target is not None:
                    some = deviation[field], variance[field], have[field]
                    factor = _factor(*some, part, 2 * target**2, gain)
                chosen[index] += self._share(have, deviation, part, rounding, factor, field)
        return chosen

    def _gain(self, state: State, among: np.ndarray) -> float:
        """By what power of the rays, beyond the first, variance falls in some pixels [H, W]: since the round
        before, it has fallen by one power of what it would have done with independent rays."""
        if state.earlier is None:
            return 0.0
        weights = among.ravel().astype(np.float32)
        now, then = (values.reshape(2, -1) @ weights for values in (state.differing, state.earlier))
        if min(*now, *then) <= 0:
            return 0.0
        found, expected = np.log(then / now)
        if expected < math.log(1.5):  # fewer tell nothing
            return 0.0
        power = float(found / expected) - 1
        return KEPT * min(max(power, 0.0), self.gain)

    def _room(self, state: State, most: float) -> float:
        return most * self.film.pixels - float(state.rays.sum())

    def _share(
        self,
        have: np.ndarray,
        deviation: np.ndarray,
        room: float,
        rounding: np.ndarray,
        factor: float = math.inf,
        among: np.ndarray | None = None,
    ) -> np.ndarray:
        """Groups for a half that has some rays, [pixels]: what makes of them a multiple of the deviation, but
        no more than there is room for.

        ``have``, ``deviation``, ``rounding``: [H, W]. ``among``: the pixels that share, [H, W]; None: all.
        """
        some = slice(None) if among is None else np.flatnonzero(among)
        deviation = deviation.ravel()[some]
        have = have.ravel()[some]
        rounding = rounding.ravel()[some]
        known = have.sum()
        best = np.zeros(self.film.pixels, np.int64)
        if not deviation.any():
            return best
        low = 0.0
        high = min(factor, (room + known) / deviation.sum())
        factor = min(factor, _factor(deviation, None, have, room, 0.0))
        trips = 0
        while low == 0 or trips < ROUND_TRIPS:
            trips += 1
            groups = np.zeros(self.film.pixels, np.int64)
            groups[some] = self._due(factor * deviation, have, rounding)
            cost = self._group * float(widened(self.film, groups[None]).sum())
            if cost <= room:
                best = groups
                low = factor
                if cost > FULL * room or factor == high:
                    break
            else:
                high = factor
            factor *= (ALMOST * room + known) / (cost + known)
            if trips > ROUND_TRIPS or not low < factor < high:
                factor = (low + high) / 2
        return best

    def _rounding(self, state: State) -> np.ndarray:
        """Random numbers to add before rounding down, alike in a tile, [H, W]."""
        tile = TILE if self.film.reach else 1
        rows, columns = (np.arange(n) // tile for n in self.film.shape)
        random = np.random.default_rng((self._seed, int(state.rays.sum())))
        return random.random((rows[-1] + 1, columns[-1] + 1), np.float32)[rows[:, None], columns]

    def _due(self, rays: np.ndarray, have: np.ndarray, rounding: np.ndarray) -> np.ndarray:
        """Groups that make a number of rays of what there is: one near it that suits the sampler."""
        rays = np.minimum(rays, 2.0**40)
        step = self._sampler.spacing(rays)
        due = np.floor(rays / step + rounding) * step - have
        return np.asarray(np.maximum(due, 0) / self._group, np.int64)


def quarter_squares(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """A quarter of the squared difference of pictures; what is no number is left out later."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.square(first - second, dtype=np.float64) / 4)


def differences(one: Sums, another: Sums) -> np.ndarray:
    """A quarter of the squared difference of two pictures, the mean of its colours, and what it is for
    independent rays, [2, H, W]."""
    found = mean_square(one.mean - another.mean) / 4
    return np.stack([found, (one + another).variance * (1 / one.rays + 1 / another.rays) / 4])


def mean_square(colors: np.ndarray) -> np.ndarray:
    """The mean of the squares of three channels, [H, W]."""
    return np.asarray((colors[0] ** 2 + colors[1] ** 2 + colors[2] ** 2) / 3)


def number_of(values: np.ndarray) -> float:
    """How many values make up their sum: all if they are equal, one if it rules."""
    flat = values.ravel()
    return float(flat.sum(dtype=np.float64) ** 2 / max(float(flat @ flat), 1e-300))


def _smoothed(variance: np.ndarray) -> np.ndarray:
    """Deviations around each pixel, [H, W]: those of single pixels are known badly."""
    return window_means(np.sqrt(variance + 1e-30), 1)


def _nearby(values: np.ndarray, widths: Sequence[int]) -> np.ndarray:
    """Means of values [..., H, W] around each pixel, with a little of the mean of all."""
    near = sum(window_means(values, width) for width in widths) / len(widths)
    return np.asarray(near + 0.2 * values.mean((-2, -1), keepdims=True))


def _mixture(parts: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """The shares, 0 or more, in which parts [parts, H, W] add up to what is nearest to values [H, W].

    By W. Richardson's and L. Lucy's steps (1972, 1974), in which a value weighs the less the more is expected
    of it, since a variance is as uncertain as it is large.
    """
    step = max(1, math.isqrt(measured.size // JUDGES))
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
    """Variances [H, W], each tenth of them, as they sort, drawn to the mean of its squared errors.

    The more squares make up that mean, the more: a tenth in which both halves missed the same rare rays has
    none, and keeps what was stated.
    """
    noisy = variance > 0
    if not noisy.any():
        return variance.copy()
    step = max(1, variance.size // RANKED)
    edges = np.quantile(variance[noisy][::step], np.arange(1, 10) / 10)
    tenth = np.searchsorted(edges, variance)  # of each pixel, 0 to 9
    of_noisy = tenth[noisy]
    errors = squares[noisy].astype(np.float64)
    stated = np.bincount(of_noisy, variance[noisy], 10)
    measured = np.bincount(of_noisy, errors, 10)
    number = measured**2 / np.maximum(np.bincount(of_noisy, np.square(errors), 10), 1e-300)
    ratio = np.maximum(measured / np.maximum(stated, 1e-300), LEAST_RATIO)
    drawn = ratio ** (number / (number + STATED))
    return np.asarray(variance * drawn[tenth])


def _own_errors(state: State, index: int) -> np.ndarray:
    """Squared errors of a half by its own rays, [H, W], which the other half has not met, unlike what their
    difference holds; less what a sequence gains by that difference."""
    found, expected = state.differing
    own = state.sums(index).variance * np.float32((1 / state.rays[HALVES]).sum(0) / 4)
    return own * np.divide(found, expected, out=np.zeros_like(own), where=expected > 0)


def _levelled(stated: np.ndarray, measured: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Squared errors [H, W], taken to the power that makes them as unequal as errors measured independently.

    Pixels that met a rare bright ray are less noisy than they look, and those that met none are noisier.
    The mean logarithm of an error, weighted by the errors, says how unequal they are. ``among``: the pixels
    that are compared, [H, W]; the sum over them stays.
    """
    compared = among & (stated > 0)
    logs = np.log(stated[compared], dtype=np.float64)
    weights = measured[compared].astype(np.float64)
    if not weights.any():
        return stated
    counts, edges = np.histogram(logs, LEVELS)
    middles = (edges[1:] + edges[:-1]) / 2
    powers = np.linspace(0.1, 1.5, 29)
    each = counts * np.exp(np.outer(powers, middles - edges[-1]))  # weights, by power
    power = np.interp(np.average(logs, weights=weights), each @ middles / each.sum(1), powers)
    levelled = stated ** np.float32(power)
    return np.asarray(levelled * (stated[among].sum() / max(levelled[among].sum(), 1e-30)))


def _drawn(stated: np.ndarray, measured: np.ndarray) -> float:
    """By what to multiply squared errors that are stated, for their sum to be nearer to the measured one.

    The more squares make up that sum, the nearer.
    """
    whole = stated.sum(dtype=np.float64)
    if whole == 0:
        return 1.0
    number = number_of(measured)
    ratio = measured.sum(dtype=np.float64) / whole
    return float(max(ratio, LEAST_RATIO) ** (number / (number + STATED)))


def _factor(
    deviation: np.ndarray,
    variance: np.ndarray | None,
    have: np.ndarray,
    room: float,
    allowed: float,
    gain: float = 0.0,
) -> float:
    """By what to multiply deviations for rays that leave a mean variance that is allowed; or, if that is
    less, for those that there is room for.

    Pixels keep the rays they have. ``variance``: of a ray; None: nothing is allowed. It falls by a power of
    the rays that is greater than 1 by the ``gain``. Found without rounding, in every so many pixels.
    """
    step = max(1, deviation.size // RANKED)
    every = deviation.ravel()[::step]
    there = have.ravel()[::step].astype(np.float32)
    total = deviation.sum()
    if total == 0:  # no pixels, or none with noise
        return 0.0
    low = 0.0
    high = float((room + have.sum()) / total)
    for _ in range(24):
        factor = (low + high) / 2
        rays = np.maximum(factor * every, there)
        enough = step * float((rays - there).sum()) > room
        if variance is not None and not enough:
            left = variance.ravel()[::step] / rays
            left = left * (there / rays) ** gain if gain else left
            enough = float(left.mean()) <= allowed
        low, high = (low, factor) if enough else (factor, high)
    return high
