"""Allocation of further rays to pixels, in proportion to the standard deviation there (J. Neyman, 1934).

Pilot buffers alone decide, and so no value decides the weight with which it is averaged (D. Kirk and J. Arvo,
1991, have the bias of deciding by the values that are averaged; docs/maths.md has the proof).

An allocation is the number of ray groups in each pixel, [4, pixels]: of the halves, then of the pilots.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mrt_mitsuba.adaptive.estimate import HALVES, PILOTS, PilotEstimate, SampleStatistics
from mrt_mitsuba.filters.grid import window_means
from mrt_mitsuba.rendering.exposing import widened
from mrt_mitsuba.rendering.film import Film

PILOT_RATIO = 1 / 12  # rays of pilots over those of halves
ROUNDING_TILE = 16  # pixels that share a rounding offset under a filter, which adds rays around each of them
ALLOCATION_ITERATIONS = 16  # trials of a factor that makes whole groups use up the budget
FILLED = 0.995  # fraction of the budget that counts as used up


class Allocator:
    """Decides how many ray groups each pixel gets next."""

    def __init__(self, film: Film, sampler: mi.Sampler, seed: int) -> None:
        self.film = film
        self.gain: float = sampler.gain  #: variance falls by this power of the rays, beyond the first
        self._sampler = sampler
        self._group = sampler.group
        self._seed = seed

    def traced(self, allocation: np.ndarray) -> np.ndarray:
        """An allocation with groups around the pixels of halves as far as the filter reaches."""
        return np.concatenate([widened(self.film, allocation[HALVES]), allocation[PILOTS]])

    def allocate(
        self, stats: SampleStatistics, pilots: PilotEstimate, spp: float, floor: float = 0.0
    ) -> np.ndarray:
        """Allocation that raises the mean to ``spp`` rays of a pixel.

        No pixel counts as less noisy than ``floor`` times the mean deviation.
        """
        room = spp * self.film.pixels - float(stats.count.sum())
        rounding = self._rounding(stats)
        deviation = _smoothed(pilots.variance)
        deviation = np.maximum(deviation, floor * deviation.mean())
        half = self._shares(stats.count[0], deviation, room / 2 / (1 + PILOT_RATIO), rounding)
        wanted = PILOT_RATIO * (stats.count[0].ravel() + self._group * half)
        more = self._groups_to(wanted, stats.count[2].ravel(), rounding.ravel())
        allocation = np.stack([half, half, more, more])
        if self._group * self.traced(allocation).sum() > room:  # rounded up too often
            allocation[PILOTS] = self._groups_to(wanted, stats.count[2].ravel(), np.zeros_like(wanted))
        return allocation

    def _shares(
        self, have: np.ndarray, deviation: np.ndarray, budget: float, rounding: np.ndarray
    ) -> np.ndarray:
        """Groups for a half, [pixels], that make its rays a multiple of the deviation, within the budget.

        ``have``, ``deviation``, ``rounding``: [H, W].
        """
        have, deviation, rounding = have.ravel(), deviation.ravel(), rounding.ravel()
        known = have.sum()
        best = np.zeros(self.film.pixels, np.int64)
        if not deviation.any():
            return best
        low = 0.0
        high = float((budget + known) / deviation.sum())
        factor = high
        trials = 0
        while low == 0 or trials < ALLOCATION_ITERATIONS:
            trials += 1
            groups = self._groups_to(factor * deviation, have, rounding)
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
