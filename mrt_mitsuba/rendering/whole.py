"""Whole pictures, of integrators that follow no camera rays, in place of rays here and there."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrt_mitsuba.adaptive.estimate import LUMINANCE
from mrt_mitsuba.errors import SceneError, UsageError, one_line
from mrt_mitsuba.machine import wavefront_size
from mrt_mitsuba.plugins.signals import left_to_other_threads
from mrt_mitsuba.rendering.exposing import Exposer
from mrt_mitsuba.rendering.film import derived_seed
from mrt_mitsuba.rendering.progress import Advance


def whole_picture(exposer: Exposer, seed: int, rays: int, advance: Advance) -> tuple[int, np.ndarray]:
    """Return the spp traced, about ``rays``, and the picture [H, W, channels].

    It is the mean of parts that fit into memory, with the spp that the scene's sampler allows.
    """
    job = exposer.job
    film = exposer.film
    shader = exposer.shader
    if film.bands:
        raise UsageError(
            f"the integrator {shader.name} gives whole pictures, which this film keeps as "
            f"{', '.join(film.bands)}: use an hdrfilm"
        )
    total: Any = 0
    traced = 0
    most = max(1, wavefront_size(job.workspace, len(exposer.names)) // film.pixels)
    for done in range(0, rays, most):
        count = film.rays_near(min(most, rays - done))
        try:
            with left_to_other_threads():
                part = derived_seed(seed, wavefront=done)
                shader.integrator.render(shader.scene, shader.sensor, seed=part, spp=count)
        except RuntimeError as error:  # such as an emitter that cannot be sampled
            why = one_line(str(error))
            raise SceneError(f"the integrator {shader.name} cannot render this scene: {why}") from error
        raw = np.array(shader.sensor.film().develop(raw=True), np.float64)  # whatever its pixel format
        place = 4 if film.alpha else 3
        weight = raw[..., place]
        found = np.delete(raw, place, -1) / np.where(weight == 0, 1, weight)[..., None]
        if film.grey:
            found[..., :3] = (found[..., :3] @ LUMINANCE)[..., None]
        total = total + count * found
        traced += count
        advance(count * film.pixels)
        job.rays["primary"] += count * film.pixels
    return traced, total / traced
