"""Allocation of further rays to pixels, in proportion to the standard deviation there (J. Neyman, 1934).

Pilot buffers alone decide all rounds but the last ones, and so no value decides the weight with which it is
averaged: the mean is right (D. Kirk and J. Arvo, 1991, have the bias of deciding by the values that are
averaged; docs/maths.md has the proof). In the end the half buffers decide for each other.

An allocation is the number of ray groups in each pixel, [4, pixels]: of the halves, then of the pilots.
"""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mrt_mitsuba.adaptive.estimate import (
    HALVES,
    PILOTS,
    SUBSET_PIXELS,
    WINDOWS,
    Forecast,
    SampleStatistics,
    calibration,
    nearby,
    ray_variance,
)
from mrt_mitsuba.filters.grid import window_means
from mrt_mitsuba.rendering.exposing import widened
from mrt_mitsuba.rendering.film import Film

HEAVY_TAIL_SHAPE = 0.5  # Pareto shape from which the variance itself has no variance
PILOT_RATIO = (1 / 15, 1 / 4)  # rays of pilots over those of halves; with a heavy tail
GAIN_DAMPING = 0.75  # factor on the measured gain of a sequence: it falls with the length
ROUNDING_TILE = 16  # pixels that share a rounding offset under a filter, which adds rays around each of them
ERROR_BINS = 64  # histogram bins of errors, by which a power of them is found
ALLOCATION_ITERATIONS = 8  # trials of a factor that makes whole groups use up the budget
FILLED = 0.995  # fraction of the budget that counts as used up


class Allocator:
    """Decides how many ray groups each pixel gets next."""

    def __init__(self, film: Film, sampler: mi.Sampler, seed: int) -> None:
        self.film = film
        self.gain: float = sampler.gain  #: variance falls by this power of the rays, beyond the first
        self._sampler = sampler
        self._group = sampler.group
        self._seed = seed
        # a chessboard, unless pixels share rays under a filter
        fields = 1 if film.reach else sampler.fields
        board = np.indices(film.shape).sum(0) % fields
        self._fields = [board == field for field in range(fields)]

    def traced(self, allocation: np.ndarray) -> np.ndarray:
        """An allocation with groups around the pixels of halves as far as the filter reaches."""
        return np.concatenate([widened(self.film, allocation[HALVES]), allocation[PILOTS]])

    def required_spp(self, stats: SampleStatistics, forecast: Forecast, rmse: float) -> float:
        """Mean rays of a pixel, in all, that reach an RMSE, as the pilots foresee it."""
        deviation = np.sqrt(forecast.variance, dtype=np.float64)
        half = np.maximum(deviation * (deviation.mean() / (2 * rmse**2)), stats.count[0])
        return float(2 * (half - stats.count[0]).mean() + stats.count.sum(0).mean())

    def allocate(self, stats: SampleStatistics, forecast: Forecast, spp: float, floor: float) -> np.ndarray:
        """Allocation that raises the mean to ``spp`` rays of a pixel, from pilot statistics only.

        No pixel counts as less noisy than ``floor`` times the mean deviation.
        """
        ratio = PILOT_RATIO[forecast.tail >= HEAVY_TAIL_SHAPE]
        budget = self._budget(stats, spp) / 2 / (1 + ratio)
        rounding = self._rounding(stats)
        deviation = _smoothed(forecast.variance)
        deviation = np.maximum(deviation, floor * deviation.mean())
        half = self._shares(stats.count[0], deviation, budget, rounding)
        wanted = ratio * (stats.count[0].ravel() + self._group * half)
        pilots = self._groups_to(wanted, stats.count[2].ravel(), rounding.ravel())
        return np.stack([half, half, pilots, pilots])

    def allocate_final(self, stats: SampleStatistics, spp: float, rmse: float | None) -> np.ndarray:
        """Allocation that reaches an RMSE, or raises the mean to ``spp``, decided by halves for each other.

        A half's own rays show best how unequal errors are, and the halves' difference how much less a
        sequence errs: both in pixels of the other colour of a chessboard, so that no value moves its own
        weight.
        """
        budget = self._budget(stats, spp) / 2
        rounding = self._rounding(stats)
        pilots = stats.sums(*PILOTS)
        alone = len(self._fields) == 1
        near = None
        if not alone:
            near = np.stack([nearby(stats.half_differences * ~field, WINDOWS[2:]) for field in self._fields])
        # from per-ray variance to the expected squared half difference
        weight = np.float32((1 / stats.count[HALVES]).sum(0) / 4)
        allocation = np.zeros((4, self.film.pixels), np.int64)
        for index in HALVES:
            have = stats.count[index]
            views = ray_variance(stats, stats.sums(1 - index), pilots, near)
            for field, variance in zip(self._fields, views.reshape(-1, *self.film.shape), strict=True):
                gain = 0.0
                if not alone:
                    errors = _spread_like(variance * weight, _own_errors(stats, index), ~field)
                    factor = calibration(errors[~field], stats.half_differences[0][~field])
                    variance = errors * factor / weight
                    gain = self._measured_gain(stats, ~field)
                deviation = _smoothed(variance)
                part = budget * field.mean()
                factor = math.inf
                if rmse is not None:
                    allowed = 2 * rmse**2 / stats.unit
                    factor = _factor(deviation[field], variance[field], have[field], part, allowed, gain)
                allocation[index] += self._shares(have, deviation, part, rounding, factor, field)
        return allocation

    def _measured_gain(self, stats: SampleStatistics, among: np.ndarray) -> float:
        """Excess convergence rate in some pixels, damped: variance ∝ n^−(1 + gain), from the last rounds."""
        if stats.previous_differences is None:
            return 0.0
        weights = among.ravel().astype(np.float32)
        sums = (stats.half_differences, stats.previous_differences)
        now, then = (values.reshape(2, -1) @ weights for values in sums)
        if min(*now, *then) <= 0:
            return 0.0
        found, expected = np.log(then / now)
        if expected < math.log(1.5):  # too few new rays to tell
            return 0.0
        return GAIN_DAMPING * min(max(float(found / expected) - 1, 0.0), self.gain)

    def _budget(self, stats: SampleStatistics, spp: float) -> float:
        return spp * self.film.pixels - float(stats.count.sum())

    def _shares(
        self,
        have: np.ndarray,
        deviation: np.ndarray,
        budget: float,
        rounding: np.ndarray,
        factor: float = math.inf,
        among: np.ndarray | None = None,
    ) -> np.ndarray:
        """Groups for a half, [pixels], that make its rays a multiple of the deviation, within the budget.

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
        high = min(factor, (budget + known) / deviation.sum())
        factor = min(factor, _factor(deviation, None, have, budget, 0.0))
        trials = 0
        while low == 0 or trials < ALLOCATION_ITERATIONS:
            trials += 1
            groups = np.zeros(self.film.pixels, np.int64)
            groups[some] = self._groups_to(factor * deviation, have, rounding)
            cost = self._group * float(widened(self.film, groups[None]).sum())
            if cost <= budget:
                best = groups
                low = factor
                if cost > FILLED * budget or factor == high:
                    break
            else:
                high = factor
            factor *= ((1 + FILLED) / 2 * budget + known) / (cost + known)
            if trials > ALLOCATION_ITERATIONS or not low < factor < high:
                factor = (low + high) / 2
        return best

    def _rounding(self, stats: SampleStatistics) -> np.ndarray:
        """Random offsets to add before rounding down, [H, W]."""
        tile = ROUNDING_TILE if self.film.reach else 1
        rows, columns = (np.arange(n) // tile for n in self.film.shape)
        random = np.random.default_rng((self._seed, int(stats.count.sum())))
        return random.random((rows[-1] + 1, columns[-1] + 1), np.float32)[rows[:, None], columns]

    def _groups_to(self, count: np.ndarray, have: np.ndarray, rounding: np.ndarray) -> np.ndarray:
        """Further groups that raise rays to ``count``, rounded to numbers that suit the sampler."""
        count = np.minimum(count, 2.0**40)
        step = self._sampler.spacing(count)
        due = np.floor(count / step + rounding) * step - have
        return np.asarray(np.maximum(due, 0) / self._group, np.int64)


def _smoothed(variance: np.ndarray) -> np.ndarray:
    """Return standard deviations [H, W], box-filtered: per-pixel estimates are too noisy."""
    return window_means(np.sqrt(variance + 1e-30), 1)


def _own_errors(stats: SampleStatistics, index: int) -> np.ndarray:
    """Return squared errors [H, W] by a half's own rays, less what a sequence gains by their difference.

    The other half has not met those rays, unlike what the halves differ by.
    """
    found, expected = stats.half_differences
    own = stats.sums(index).variance * np.float32((1 / stats.count[HALVES]).sum(0) / 4)
    return own * np.divide(found, expected, out=np.zeros_like(own), where=expected > 0)


def _spread_like(estimated: np.ndarray, measured: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return squared errors [H, W] to the power that makes them as unequal as independently measured ones.

    Pixels that met a rare bright ray are less noisy than they look, and those that met none are noisier.
    The mean logarithm of an error, weighted by the errors, says how unequal they are. ``among``: the pixels
    that are compared, [H, W]; the sum over them stays.
    """
    compared = among & (estimated > 0)
    logs = np.log(estimated[compared], dtype=np.float64)
    weights = measured[compared].astype(np.float64)
    if not weights.any():
        return estimated
    counts, edges = np.histogram(logs, ERROR_BINS)
    middles = (edges[1:] + edges[:-1]) / 2
    powers = np.linspace(0.1, 1.5, 29)
    each = counts * np.exp(np.outer(powers, middles - edges[-1]))  # weights, by power
    power = np.interp(np.average(logs, weights=weights), each @ middles / each.sum(1), powers)
    spread = estimated ** np.float32(power)
    return np.asarray(spread * (estimated[among].sum() / max(spread[among].sum(), 1e-30)))


def _factor(
    deviation: np.ndarray,
    variance: np.ndarray | None,
    have: np.ndarray,
    budget: float,
    allowed: float,
    gain: float = 0.0,
) -> float:
    """Return rays per unit deviation that meet the allowed mean variance, or use up the budget if less.

    Pixels keep the rays they have. ``variance``: of a ray; None: nothing is allowed. It falls by a power of
    the rays that is greater than 1 by the ``gain``. Found without rounding, from a subset of the pixels.
    """
    step = max(1, deviation.size // SUBSET_PIXELS)
    every = deviation.ravel()[::step]
    there = have.ravel()[::step].astype(np.float32)
    total = deviation.sum()
    if total == 0:  # no pixels, or none with noise
        return 0.0
    low = 0.0
    high = float((budget + have.sum()) / total)
    for _ in range(24):
        factor = (low + high) / 2
        rays = np.maximum(factor * every, there)
        enough = step * float((rays - there).sum()) > budget
        if variance is not None and not enough:
            left = variance.ravel()[::step] / rays
            left = left * (there / rays) ** gain if gain else left
            enough = float(left.mean()) <= allowed
        low, high = (low, factor) if enough else (factor, high)
    return high
