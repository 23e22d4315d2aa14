"""Tracing bundles of camera rays: means over the rays of each pixel, and the layers of the first hit.

In vectorised variants a bundle is one wavefront, split where it would not fit into memory; in scalar variants
a loop in Python.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrt_mitsuba.memory import Workspace
from mrt_mitsuba.output.layers import AVERAGED, FIRST_HIT, TABLE
from mrt_mitsuba.output.layers import channels as channel_count
from mrt_mitsuba.rays.bundle import Bundle, Samples
from mrt_mitsuba.rays.sampler import ray_sampler
from mrt_mitsuba.rendering.shading import Shader, components
from mrt_mitsuba.rendering.view import View

log = logging.getLogger(__name__)

# By layer, one array for each channel: [pixels] float32
Channels = Mapping[str, Sequence[np.ndarray]]


@dataclass
class Tracer:
    """A shader seen through a view; ``rays`` counts those traced, by kind."""

    shader: Shader
    view: View
    workspace: Workspace
    rays: dict[str, int] = field(default_factory=lambda: {"primary": 0})

    def trace(
        self, bundle: Bundle, layers: frozenset[str], *, seed: int = 0
    ) -> Iterator[tuple[slice, Channels]]:
        """Trace a bundle, in parts that fit into the workspace or of one pixel.

        Yields which of the bundle's pixels are in a part, and the layers there, to be read before the next
        part is asked for. Values do not depend on the parts. ``layers`` names those of the first hit and
        averaged ones; nothing else is computed.
        """
        import mitsuba as mi

        names, channels = [name for name in TABLE if name in layers], channel_count(layers)
        trace = self._one_by_one if mi.variant().startswith("scalar") else self._wavefront
        rays_at_once = self.workspace.rays_at_once(channels)
        log.debug("tracing %d rays, at most %d at once", bundle.ray_count, rays_at_once)
        step = max(1, rays_at_once // bundle.rays_per_pixel)
        for start in range(0, len(bundle.pixels), step):
            stop = min(start + step, len(bundle.pixels))
            part = bundle.part(start, stop)
            values = trace(part, names, seed)
            self._count(part, values)
            yield slice(start, stop), values
        self.workspace.after_rays(min(rays_at_once, bundle.ray_count), channels)

    def _count(self, bundle: Bundle, values: Channels) -> None:
        self.rays["primary"] += bundle.ray_count
        for name, (first, *_) in values.items():
            if kind := TABLE[name].counts:
                # means over the pixel's rays, counted in float32 ones: exact to 2^24 for each pixel
                count = round(bundle.rays_per_pixel * float(np.sum(first, dtype=np.float64)))
                self.rays[kind] = self.rays.get(kind, 0) + count

    def _wavefront(self, bundle: Bundle, names: Sequence[str], seed: int) -> Channels:
        import drjit as dr

        sampler, pixels = self._sampler(), len(bundle.pixels)
        numbers = bundle.numbers(self.view.width, self.view.height)

        samples = bundle.placed(numbers)
        if sampler is not None:
            sampler.start_at(seed, samples.number)
        values = self.shader.trace(names, self.view, samples, sampler)
        if bundle.rays_per_pixel == 1:
            result = {name: components(value) for name, value in values.items()}
        else:
            result = _by_pixel(values, bundle, samples, numbers.share)
        dr.eval(result)
        # LLVM's arrays are not copied
        return {
            name: [np.asarray(c, np.float32)[:pixels] for c in channels] for name, channels in result.items()
        }

    def _one_by_one(self, bundle: Bundle, names: Sequence[str], seed: int) -> Channels:
        pixels = {name: np.zeros((len(bundle.pixels), TABLE[name].channels)) for name in names}
        sampler = self._sampler()
        for samples in bundle.each_sample(self.view.width, self.view.height):
            if sampler is not None:
                sampler.start_at(seed, samples.number)
            for name, value in self.shader.trace(names, self.view, samples, sampler).items():
                if TABLE[name].source == AVERAGED:
                    pixels[name][samples.order] += np.array(value) / bundle.rays_per_pixel
                elif samples.is_first:
                    pixels[name][samples.order] = np.array(value)
        return {name: list(values.T.astype(np.float32)) for name, values in pixels.items()}

    def _sampler(self) -> Any:
        """Return a random sampler, or None where nothing is random."""
        import mitsuba as mi

        random = self.shader.random or mi.is_spectral or self.view.sensor.needs_aperture_sample()
        return ray_sampler() if random else None


def _by_pixel(values: dict[str, Any], bundle: Bundle, samples: Samples, share: Any) -> dict[str, list[Any]]:
    """Return the first value of each pixel for layers of the first hit, the mean for averaged ones.

    ``share``: of a ray in the mean.
    """
    import drjit as dr
    import mitsuba as mi

    def first(component: Any) -> Any:
        target = dr.zeros(mi.Float, len(bundle.pixels))
        dr.scatter(target, component, samples.order, samples.is_first, mode=dr.ReduceMode.Permute)
        return target

    def mean(component: Any) -> Any:
        return dr.block_reduce(dr.ReduceOp.Add, mi.Float(component), bundle.rays_per_pixel) * share

    averaged = {name: value for name, value in values.items() if TABLE[name].source == AVERAGED}
    pixels = {
        name: [first(component) for component in components(value)]
        for name, value in values.items()
        if TABLE[name].source == FIRST_HIT
    }
    dr.eval(averaged, pixels)  # block_reduce would evaluate each channel by itself, in a kernel of its own
    for name, value in averaged.items():
        pixels[name] = [mean(component) for component in components(value)]
    return pixels
