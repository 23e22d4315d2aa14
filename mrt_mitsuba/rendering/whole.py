"""Whole pictures, of integrators that follow no camera rays, in place of rays here and there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mrt_mitsuba.adaptive.error import tail_shape
from mrt_mitsuba.adaptive.noise import (
    HALVES,
    LUMINANCE,
    MARGIN,
    SCOUTS,
    Blurred,
    Forecast,
    State,
    number_of,
    quarter_squares,
)
from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.filters.grid import window_means
from mrt_mitsuba.plugins.signals import left_to_other_threads
from mrt_mitsuba.rendering.exposing import Exposer
from mrt_mitsuba.rendering.film import Film
from mrt_mitsuba.rendering.progress import Advance
from mrt_mitsuba.rendering.seeds import derived_seed


def whole_pictures(
    exposer: Exposer, seed: int, rays: int, advance: Advance
) -> Iterator[tuple[int, np.ndarray]]:
    """Pictures [H, W, channels], which have so many rays a pixel in all and fit into memory, with the rays of
    each."""
    job, film, shader = exposer.job, exposer.film, exposer.shader
    if film.bands:
        raise UsageError(
            f"the integrator {shader.name} gives whole pictures, which this film keeps as "
            f"{', '.join(film.bands)}: use an hdrfilm"
        )
    most = max(1, job.workspace.rays_at_once(len(exposer.names)) // film.pixels)
    for done in range(0, rays, most):
        count = film.rays_near(min(most, rays - done))
        try:
            with left_to_other_threads():
                part = derived_seed(seed, wavefront=done)
                shader.integrator.render(shader.scene, shader.sensor, seed=part, spp=count)
        except RuntimeError as error:  # such as a lamp that no ray can start at
            text = " ".join(str(error).split())
            raise SceneError(f"the integrator {shader.name} cannot render this scene: {text}") from error
        raw = np.array(shader.sensor.film().develop(raw=True), np.float64)  # whatever its pixel format
        place = 4 if film.alpha else 3
        weight = raw[..., place]
        found = np.delete(raw, place, -1) / np.where(weight == 0, 1, weight)[..., None]
        if film.grey:
            found[..., :3] = (found[..., :3] @ LUMINANCE)[..., None]
        yield count, found
        advance(count * film.pixels)
        job.rays["primary"] += count * film.pixels


class PictureNoise:
    """The noise of whole pictures, in which all pixels get the same rays. See ``Noise``.

    A picture has no single rays, so halves and scouts are compared as they are; what rules rays by their tail
    rules sums of them, too.
    """

    margin = MARGIN
    gain = 0.0
    least = 64.0
    scouting = 1 / 8  #: rays of scouts over those of halves

    def __init__(self, exposer: Exposer, seed: int, blurred: Blurred | None = None) -> None:
        self.film: Film = exposer.film
        self.blurred = blurred
        self._exposer = exposer
        self._seed = seed
        self.begin = self._everywhere(2, 1)

    def _everywhere(self, half: int, scout: int) -> np.ndarray:
        """Rays of each half and each scout, [4, pixels]."""
        return np.repeat([[half], [half], [scout], [scout]], self.film.pixels, 1)

    def blank(self) -> State:
        return State.blank(self.film, len(self._exposer.names))

    def cost(self, chosen: np.ndarray) -> int:
        return int(chosen.sum())

    def trace(self, state: State, chosen: np.ndarray, advance: Advance) -> State:
        border = [(self.film.border,) * 2] * 2
        rays = state.rays.copy()
        total = state.total.copy()
        sums = state.halves.sums.copy()
        for picture, number in enumerate(chosen[:, 0]):
            seed = derived_seed(self._seed, round=state.exposures, picture=picture)
            for count, found in whole_pictures(self._exposer, seed, int(number), advance):
                values = np.moveaxis(np.pad(count * found, [*border, (0, 0)]), -1, 0)
                rays[picture] += count
                total[:, picture] += values[:3]
                if picture in HALVES:
                    sums[:, picture] += values
        weights = rays[HALVES].astype(np.float32)
        bad = np.asarray(~np.isfinite(total).all((0, 1)))
        return replace(
            state,
            rays=rays,
            total=total,
            halves=replace(state.halves, sums=sums, weights=weights, amount=weights),
            bad=bad,
            unfit=float(total[:, :, bad].max(initial=-np.inf)),
            exposures=state.exposures + 1,
        )

    def tail(self, state: State, pictures: Sequence[int]) -> float:
        values = np.sqrt(self._squares(state, pictures).mean(-1)).ravel()
        return tail_shape(values, np.ones(len(values)))

    def forecast(self, state: State) -> Forecast:
        squares = self._squares(state, SCOUTS)
        scouts, halves = (float(state.rays[which].sum(0)[0, 0]) for which in (SCOUTS, HALVES))
        variance = np.full(self.film.shape, float(squares.mean()) * scouts)
        noisy = number_of(squares.mean(-1)) / self.film.pixels
        return Forecast(math.sqrt(variance[0, 0] / halves), self.tail(state, SCOUTS), noisy, variance)

    def wanted(self, state: State, forecast: Forecast, target: float) -> float:
        halves = max(forecast.variance[0, 0] / target**2, state.rays[HALVES].sum(0)[0, 0])
        return float(halves + state.rays[SCOUTS].sum(0)[0, 0])

    def shares(self, state: State, forecast: Forecast, most: float, even: float) -> np.ndarray:
        half = math.floor(most / 2 / (1 + self.scouting))
        have = state.rays[:, 0, 0].astype(np.int64)
        scout = math.ceil(self.scouting * half)
        return self._everywhere(max(half - have[0], 0), max(scout - have[2], 0))

    def last_shares(self, state: State, most: float, target: float | None) -> np.ndarray:
        have = state.rays[:, 0, 0].astype(np.int64)
        half = (most - have[2] - have[3]) / 2
        if target is not None:
            wanted = self.forecast(state).variance[0, 0] / (2 * target**2)
            half = min(half, math.ceil(wanted))
        return self._everywhere(max(math.floor(half) - have[0], 0), 0)

    def variance(self, state: State) -> np.ndarray:
        squares = window_means(np.moveaxis(self._squares(state, HALVES), -1, 0), 4)
        return np.moveaxis(squares, 0, -1)

    def _squares(self, state: State, pictures: Sequence[int]) -> np.ndarray:
        """A quarter of the squared difference of two pictures, [H, W, 3], without the border."""
        first, second = np.moveaxis(state.total / state.rays, 0, -1)[list(pictures)]
        return self.film.picture(np.where(state.bad[..., None], 0, quarter_squares(first, second)))
