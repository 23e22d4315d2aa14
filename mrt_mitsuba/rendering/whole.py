"""Whole pictures, of integrators that follow no camera rays, in place of rays here and there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.filters.grid import window_means
from mrt_mitsuba.output.error import ErrorEstimate, tail_shape
from mrt_mitsuba.rendering.exposing import Exposer

PICTURES = 4  # two halves, whose mean is the picture, and two scouts, which decide when to stop
SCOUTING = 1 / 8  # rays of scouts over those of halves
REACH = 4  # half the width of windows over which squared differences are averaged
_STRIDE = 0x9E3779B9  # from one seed to the next: the golden ratio in 32 bits


class Wholes:
    """Two half pictures and two scouts, as they grow by rounds; see ``noise.Halves``.

    What to trace in a round: the rays of a pixel in each picture.
    """

    least = 64  #: mean rays of a pixel that a target takes at least, in a small picture
    last = False  #: was the last round decided?

    def __init__(self, exposer: Exposer, seed: int) -> None:
        film = exposer.film
        if film.bands:
            raise UsageError(
                f"the integrator {exposer.shader.name} gives whole pictures, which this film keeps as "
                f"{', '.join(film.bands)}: use an hdrfilm"
            )
        self.film, self._exposer, self._seed, self._runs = film, exposer, seed, 0
        height, width = (n - 2 * film.border for n in film.shape)
        self._sums = np.zeros((PICTURES, height, width, len(exposer.names)))
        self._rays = np.zeros(PICTURES, np.int64)

    def first(self) -> Sequence[int]:
        """Return the rays of the first round."""
        return 2, 2, 1, 1

    def cost(self, chosen: Sequence[int]) -> int:
        """Return the number of rays that pictures take."""
        return sum(chosen) * self.film.pixels

    def trace(self, chosen: Sequence[int], advance: Callable[[int], object]) -> None:
        """Render pictures, in parts that fit into memory."""
        job, channels = self._exposer.job, self._sums.shape[-1]
        most = max(1, job.workspace.rays_at_once(channels) // self.film.pixels)
        for picture, rays in enumerate(chosen):
            for done in range(0, rays, most):
                count = self.film.rays_near(min(most, rays - done))
                self._sums[picture] += count * self._rendered(count)
                self._rays[picture] += count
                advance(count * self.film.pixels)
                job.rays["primary"] += count * self.film.pixels

    def _rendered(self, rays: int) -> np.ndarray:
        """Return the channels of a picture, [H, W, channels], by seeds of its own."""
        shader, sensor = self._exposer.shader, self._exposer.shader.sensor
        seed, self._runs = (self._seed + self._runs * _STRIDE) % 2**32, self._runs + 1
        try:
            shader.integrator.render(shader.scene, sensor, seed=seed, spp=rays)
        except RuntimeError as error:  # such as a lamp that no ray can start at
            text = " ".join(str(error).split())
            raise SceneError(f"the integrator {shader.name} cannot render this scene: {text}") from error
        raw = np.array(sensor.film().develop(raw=True), np.float64)  # whatever its pixel format
        place = 4 if self.film.alpha else 3
        weight = raw[..., place]
        found = np.delete(raw, place, -1) / np.where(weight == 0, 1, weight)[..., None]
        if self.film.grey:
            found[..., :3] = (found[..., :3] @ [0.212671, 0.715160, 0.072169])[..., None]
        return found

    def mean(self) -> np.ndarray:
        """Return the picture, [H, W, channels]."""
        return np.asarray(self._sums[:2].sum(0) / self._rays[:2].sum())

    def samples(self) -> np.ndarray:
        """Return the rays of each pixel, those of scouts included, [H, W]."""
        return np.full(self._sums.shape[1:3], float(self._rays.sum()))

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], and the standard error and the rays of each pixel, [H, W]."""
        return self.mean()[..., :3], np.sqrt(self.variance().mean(-1)), self.samples()

    def unfit(self) -> str:
        """Return where the picture is no number; nothing if it is one everywhere."""
        bad = np.argwhere(~np.isfinite(self._sums[..., :3]).all((0, -1)))
        if not len(bad):
            return ""
        where = f"{len(bad)} pixels, the first at row {bad[0, 0]}, column {bad[0, 1]}"
        return f"radiance that is no number was met in {where}: they are left out of the error"

    def variance(self) -> np.ndarray:
        """Return the estimated variance of each channel in the picture, [H, W, 3]."""
        return np.moveaxis(window_means(np.moveaxis(self._squares(0), -1, 0), REACH), 0, -1)

    def rmse(self) -> float:
        """Return the estimated RMSE of the picture."""
        return math.sqrt(float(self._squares(0).mean(-1).mean()))  # summed as in ``error``

    def error(self) -> ErrorEstimate:
        """Return the estimated RMSE of the picture, by the difference of its halves; see ``Halves.error``.

        Its tail is that of the differences: what rules rays by their tail rules sums of them, too.
        """
        squares = self._squares(0).mean(-1)
        mean = float(squares.mean())
        if mean == 0:
            return ErrorEstimate(0.0, 0.0, 0.0, 0.0)
        spread = math.sqrt(2 * self.film.correlation * float(np.square(squares).sum())) / float(squares.sum())
        return ErrorEstimate.of(math.sqrt(mean), spread, self._tail(0))

    def forecast(self) -> tuple[float, float]:
        """Return the RMSE of the picture, and the shape of its tail, as the scouts have them."""
        share = self._rays[2:].sum() / self._rays[:2].sum()
        return math.sqrt(float(self._squares(2).mean() * share)), self._tail(2)

    def next(self, most: float, rays: float, target: float | None) -> Sequence[int]:
        """Return further rays of each picture; see ``Halves.next``."""
        done, halves = int(self._rays.sum()), int(self._rays[:2].sum())
        wanted = math.inf if target is None else halves * ((self.forecast()[0] / target) ** 2 - 1)
        self.last = most >= rays or wanted <= most - done
        if self.last:
            half = int(
                min(math.ceil(max(wanted, 0) / 2) if wanted < math.inf else math.inf, (rays - done) // 2)
            )
            return half, half, 0, 0
        half = int((most - done) / 2 / (1 + SCOUTING))
        due = max(0, int(SCOUTING * (halves / 2 + half)) - int(self._rays[2]))
        return half, half, due, due

    def _squares(self, first: int) -> np.ndarray:
        """Return a quarter of the squared difference of two pictures, [H, W, 3]; 0 where it is no number."""
        with np.errstate(invalid="ignore", over="ignore"):
            one, other = (self._sums[i, ..., :3] / self._rays[i] for i in (first, first + 1))
            found = np.square(one - other) / 4
        return np.where(np.isfinite(found), found, 0)

    def _tail(self, first: int) -> float:
        values = np.sqrt(self._squares(first).mean(-1)).ravel()
        return tail_shape(values, np.ones(len(values)))
