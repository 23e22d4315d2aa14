"""Denoising in adaptive rounds: when it pays, and what it makes of the two half pictures.

Denoising decides nothing that is averaged: the mean of the halves stays what it is without.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mrt_mitsuba.adaptive.estimate import SampleStatistics
from mrt_mitsuba.filters.denoising import Denoised, denoise

DENOISING_SPP = 15  # cost of denoising the two halves, in samples per pixel
EXPECTED_RATIO = 0.4  # of the mixture's error to the plain one, before it is measured
ERROR_DECAY = 0.75  # power of the plain error with which the error of the mixture falls
CLOSE_ERROR = 1.1  # times the target: predicted error from which it is measured
MIXTURE_MARGIN = 0.93  # fraction of the target that is aimed for once the mixture has been measured
CAUTION = 0.33  # weight of the upper end of the interval, against the estimate, in a squared error

Features = tuple[np.ndarray, np.ndarray]  #: albedo and shading normals of first hits, [H, W, 3] each


def cautious_error(found: Denoised) -> float:
    """Return an error which a mixture rarely exceeds: of few samples, its estimate is uncertain."""
    return math.sqrt((1 - CAUTION) * found.rmse**2 + CAUTION * found.high**2)


@dataclass
class Denoiser:
    """Denoises the pictures of adaptive rounds where that takes fewer samples than it saves."""

    features: Callable[[], Features]  #: called once, before the first picture is denoised
    left_out: str = ""  #: why denoising does not pay, ""
    _known: Features | None = None
    _measured: tuple[float, float] | None = None  #: plain error, and that of the mixture

    def mixture(self, stats: SampleStatistics, plain_error: float) -> Denoised:
        """Return the half pictures denoised and mixed with their mean, with the error in the metric."""
        if self._known is None:
            self._known = self.features()
        unknown = stats.unknown()[..., None]
        halves = [np.where(unknown, np.nan, half) for half in stats.half_pictures]
        albedo, normal = self._known
        unfiltered = None
        if stats.film.reach:
            means = np.moveaxis(stats.sum[:, :2] / stats.count[:2], 0, -1)  # [2, H, W, 3]
            unfiltered = (stats.film.picture(means[0]), stats.film.picture(means[1]))
        found = denoise(
            halves[0],
            halves[1],
            albedo,
            normal,
            encode=stats.metric.encode,
            unfiltered=unfiltered,
            refilter=stats.film.filtered_means,
            quality="fast",
        )
        plain = stats.image()[..., :3].astype(np.float32)
        more = math.sqrt(stats.curvature)
        found = replace(
            found,
            noisy=plain,
            image=np.where(unknown, plain, found.image),
            error=found.error * np.float32(more),
            rmse=found.rmse * more,
            low=found.low * more,
            high=found.high * more,
        )
        self._measured = (plain_error, cautious_error(found))
        return found

    def pays(self, spp: float, plain_error: float, target: float) -> bool:
        """True if the error of the mixture should be measured now, after ``spp`` samples per pixel."""
        saved = spp * ((plain_error / target) ** 2 - 1)
        if not self.left_out and saved < DENOISING_SPP:
            self.left_out = f"{max(saved, 0):.0f} further samples per pixel reach the target without it"
        return not self.left_out and self._predicted(plain_error) <= CLOSE_ERROR * target

    def _predicted(self, plain_error: float) -> float:
        """Return the error of the mixture, extrapolated to another plain error."""
        if self._measured is None:
            return EXPECTED_RATIO * plain_error
        before, mixed = self._measured
        return mixed * (plain_error / before) ** ERROR_DECAY

    def plain_target(self, spp: float, plain_error: float, target: float) -> float:
        """Return the error without denoising at which that of the mixture should be at its target.

        Where the samples to there are no fewer than those to the target itself, denoising is left out.
        """
        if self.left_out:
            return target
        if self._measured is None:
            return target / EXPECTED_RATIO
        wanted = plain_error * (MIXTURE_MARGIN * target / self._predicted(plain_error)) ** (1 / ERROR_DECAY)
        samples = spp * (plain_error / wanted) ** 2 + DENOISING_SPP
        if samples >= spp * (plain_error / target) ** 2:
            self.left_out = f"the mixture needs {samples:.0f} samples per pixel, as many as without it"
            return target
        return wanted
