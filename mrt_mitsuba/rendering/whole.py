"""Whole pictures, of integrators that follow no camera rays, in place of rays here and there."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.filters.grid import window_means
from mrt_mitsuba.output.error import tail_shape
from mrt_mitsuba.rendering.exposing import Exposer
from mrt_mitsuba.rendering.noise import HALVES, LUMINANCE, SCOUTS, Halves, quarter_squares

_STRIDE = 0x9E3779B9  # from one seed to the next: the golden ratio in 32 bits


def whole_pictures(
    exposer: Exposer, seed: int, rays: int, advance: Callable[[int], object]
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield pictures [H, W, channels], which have so many rays a pixel in all and fit into memory, with the
    rays of each."""
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
            shader.integrator.render(shader.scene, shader.sensor, seed=seed, spp=count)
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
        seed = (seed + _STRIDE) % 2**32
        advance(count * film.pixels)
        job.rays["primary"] += count * film.pixels


class Wholes(Halves):
    """Two half pictures and two scouts, in which all pixels get the same rays.

    A picture has no single rays, so halves and scouts are compared as they are; what rules rays by their tail
    rules sums of them, too.
    """

    group = 1
    fields = 1
    begin = (2, 2, 1, 1)
    scouting = (1 / 8, 1 / 8)
    least = 64

    def trace(self, chosen: np.ndarray, advance: Callable[[int], object]) -> None:
        """Render pictures."""
        border = [(self.film.border,) * 2] * 2
        for picture, rays in enumerate(chosen[:, 0]):
            for count, found in whole_pictures(self._exposer, self._seed, int(rays), advance):
                values = np.pad(count * found, [*border, (0, 0)])
                self._seed = (self._seed + _STRIDE) % 2**32
                self._traced[picture] += count
                self._total[:, picture] += np.moveaxis(values[..., :3], -1, 0)
                if picture in HALVES:
                    self.sums[:, picture] += np.moveaxis(values, -1, 0)
                    self.weights[picture] += count
                    self.amount[picture] += count
                    self.rays[picture] += count
        self._bad = np.asarray(~np.isfinite(self._total).all((0, 1)))
        self._unfit = self._total[..., self._bad].max(initial=-np.inf)

    def variance(self) -> np.ndarray:
        squares = window_means(np.moveaxis(self._squares(HALVES), -1, 0), 4)
        return np.moveaxis(squares, 0, -1)

    def _decisive(self, *_: object) -> np.ndarray:
        """Return the variance of a pixel times its rays as the scouts have it, alike in all pixels."""
        return np.full(self.film.shape, self._squares(SCOUTS).mean() * self._traced[SCOUTS].sum(0)[0])

    def _due(self, rays: np.ndarray, have: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.asarray(np.maximum(np.ceil(rays) - have, 0), np.int64)

    def _tail(self, which: list[int]) -> float:
        values = np.sqrt(self._squares(which).mean(-1)).ravel()
        return tail_shape(values, np.ones(len(values)))

    def _squares(self, which: list[int]) -> np.ndarray:
        """Return a quarter of the squared difference of two pictures, [H, W, 3], without the border."""
        first, second = np.moveaxis(self._total / self.rows(self._traced), 0, -1)[which]
        return self.film.picture(np.where(self._bad[..., None], 0, quarter_squares(first, second)))
