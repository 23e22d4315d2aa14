"""Tracing bundles of camera rays: per-pixel means of what an integrator returns, and the layers of the first
hit.

One function, ``trace_bundle``, for any Mitsuba scene and sampling integrator. In vectorised variants a bundle
is one wavefront, split where it would not fit in memory; in scalar variants a Python loop.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrt_mitsuba.rays.bundle import Bundle, Samples
from mrt_mitsuba.rays.sampler import ray_sampler
from mrt_mitsuba.rendering.memory import MOST_RAYS

# Layers taken from the first ray of a pixel, not averaged: they name a point, not a colour
FIRST_HIT = {"depth": 1, "normal": 3, "albedo": 3}
# Layers averaged as the picture is
AVERAGED = {"image": 3, "direct": 3, "reflection": 3, "bounces": 1, "shadow_rays": 1, "square": 3}
CHANNELS = FIRST_HIT | AVERAGED

Planes = Mapping[str, Sequence[np.ndarray]]


@dataclass(frozen=True)
class Camera:
    """A sensor of a scene, and what to sample of it."""

    sensor: Any
    width: int
    height: int
    motion: tuple[float, float, float] | None = None  # the camera's way from time 0 to 1

    def rays(self, samples: Samples, sampler: Any) -> tuple[Any, Any]:
        """Rays through some places on the film, and their weights."""
        import mitsuba as mi

        aperture = sampler.next_2d() if self.sensor.needs_aperture_sample() else mi.Point2f(0.5)
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        ray, weight = self.sensor.sample_ray(mi.Float(samples.time), wavelength, samples.place, aperture)
        ray = mi.Ray3f(ray)
        if self.motion is not None:
            ray.o += self._way(samples.time)
        return ray, weight

    def _way(self, time: Any) -> Any:
        import mitsuba as mi

        return mi.Vector3f(_opaque(mi.Vector3f, self.motion)) * time

    def distance(self, si: Any) -> Any:
        """Distance of a hit from the eye; along the ray where the sensor has no single eye."""
        import drjit as dr
        import mitsuba as mi

        if self.sensor.class_name() not in ("PerspectiveCamera", "ThinLensCamera"):
            return si.t
        # not si.t: rays start at the near plane
        eye = mi.Point3f(self.sensor.world_transform().translation())
        if self.motion is not None:
            eye += self._way(si.time)
        return dr.norm(si.p - eye)


def trace_bundle(
    tracer: Tracer,
    camera: Camera,
    bundle: Bundle,
    wanted: frozenset[str],
    *,
    seed: int = 0,
    before: int = 0,
    rays_at_once: int = MOST_RAYS,
) -> Iterator[tuple[Any, Planes]]:
    """Trace a bundle, in parts of at most so many rays or one pixel.

    Yields the pixels of each part and the wanted layers there: by name one plane for each channel, [pixels]
    float32, to be read before the next part is asked for. ``wanted``: names from ``FIRST_HIT`` and
    ``AVERAGED``; nothing else is computed. ``before``: pixels already traced with this seed, whose random
    numbers are not to be used again. Values do not depend on ``rays_at_once``.
    """
    import mitsuba as mi

    sizes = {name: size for name, size in CHANNELS.items() if name in wanted}
    run = _trace_scalar if mi.variant().startswith("scalar") else _trace_wavefront
    step = max(1, rays_at_once // bundle.rays_per_pixel)
    for start in range(0, len(bundle.pixels), step):
        part = bundle.part(start, min(start + step, len(bundle.pixels)))
        first_ray = (before + start) * bundle.rays_per_pixel
        yield part.pixels, run(tracer, camera, part, sizes, seed, first_ray)


def _trace_wavefront(
    tracer: Tracer, camera: Camera, bundle: Bundle, sizes: Mapping[str, int], seed: int, first_ray: int
) -> Planes:
    import drjit as dr
    import mitsuba as mi

    samples = bundle.samples(camera.width, camera.height)
    sampler = tracer.sampler(camera)
    if sampler is not None:
        sampler.start(seed, first_ray, bundle.ray_count)
    values = _shade(tracer, camera, samples, sampler, sizes)
    if bundle.rays_per_pixel == 1:
        dr.eval(values)
        return {name: _to_numpy(_planes(value)) for name, value in values.items()}
    pixels = {}
    for name in sizes.keys() & FIRST_HIT.keys():
        pixels[name] = [_first_of(samples, plane, len(bundle.pixels)) for plane in _planes(values.pop(name))]
    dr.eval(values, pixels)  # block_reduce would evaluate each channel by itself, in a kernel of its own
    scale = dr.opaque(mi.Float, 1 / bundle.rays_per_pixel)
    for name, value in values.items():
        pixels[name] = [
            dr.block_reduce(dr.ReduceOp.Add, mi.Float(plane), bundle.rays_per_pixel) * scale
            for plane in _planes(value)
        ]
    dr.eval(pixels)
    return {name: _to_numpy(planes) for name, planes in pixels.items()}


def _first_of(samples: Samples, plane: Any, count: int) -> Any:
    """Each pixel's first value."""
    import drjit as dr
    import mitsuba as mi

    target = dr.zeros(mi.Float, count)
    dr.scatter(target, plane, samples.order, samples.is_first, mode=dr.ReduceMode.Permute)
    return target


def _trace_scalar(
    tracer: Tracer, camera: Camera, bundle: Bundle, sizes: Mapping[str, int], seed: int, first_ray: int
) -> Planes:
    pixels = {name: np.zeros((len(bundle.pixels), size), np.float64) for name, size in sizes.items()}
    sampler = tracer.sampler(camera)
    for samples in bundle.each_sample(camera.width, camera.height):
        if sampler is not None:
            sampler.start(seed, first_ray + samples.lane, 1)
        for name, value in _shade(tracer, camera, samples, sampler, sizes).items():
            if name in AVERAGED:
                pixels[name][samples.order] += np.array(value) / bundle.rays_per_pixel
            elif samples.is_first:
                pixels[name][samples.order] = np.array(value)
    return {name: values.T.astype(np.float32) for name, values in pixels.items()}


def _shade(
    tracer: Tracer, camera: Camera, samples: Samples, sampler: Any, sizes: Mapping[str, int]
) -> dict[str, Any]:
    ray, weight = camera.rays(samples, sampler)
    values = tracer.trace(camera, ray, weight, sampler, sizes.keys())
    return {name: values[name] for name in sizes}


def _planes(value: Any) -> list[Any]:
    import drjit as dr

    return list(value) if dr.depth_v(value) > 1 else [value]


def _to_numpy(planes: Sequence[Any]) -> list[np.ndarray]:
    return [np.asarray(plane, dtype=np.float32) for plane in planes]  # LLVM's arrays are not copied


def _opaque(kind: Any, value: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(kind, value) if not mi.variant().startswith("scalar") else kind(value)


class Tracer:
    """An integrator on a scene."""

    def __init__(self, scene: Any, integrator: Any) -> None:
        self.scene, self.integrator = scene, integrator

    def sampler(self, camera: Camera) -> Any:
        """A random sampler, see ``ray_sampler``, or None where nothing is random."""
        import mitsuba as mi

        if self.random or mi.is_spectral or camera.sensor.needs_aperture_sample():
            return ray_sampler()
        return None

    @property
    def random(self) -> bool:
        """Does the integrator draw random numbers?"""
        return True

    def trace(
        self, camera: Camera, ray: Any, weight: Any, sampler: Any, wanted: AbstractSet[str]
    ) -> dict[str, Any]:
        """Per-ray values of the wanted layers."""
        import mitsuba as mi

        spectrum, _, _ = self.integrator.sample(self.scene, sampler, mi.RayDifferential3f(ray))
        result = {"image": to_rgb(mi.unpolarized_spectrum(spectrum) * mi.unpolarized_spectrum(weight), ray)}
        if "square" in wanted:
            result["square"] = result["image"] * result["image"]
        if FIRST_HIT.keys() & wanted:
            si = self.scene.ray_intersect(mi.Ray3f(ray))
            result |= first_hit_layers(camera, si, si.is_valid(), ray, wanted)
        return result


class WhittedTracer(Tracer):
    """``mrt_whitted``, whose layers fall out of the render."""

    def __init__(self, scene: Any, integrator: Any) -> None:
        super().__init__(scene, integrator)
        self.prepared = integrator.prepare(scene)

    @property
    def random(self) -> bool:
        return self.prepared.plan.random

    def trace(
        self, camera: Camera, ray: Any, weight: Any, sampler: Any, wanted: AbstractSet[str]
    ) -> dict[str, Any]:
        import mitsuba as mi

        trace = self.integrator.trace(self.scene, sampler, ray)
        weight = mi.unpolarized_spectrum(weight)
        result = {"image": to_rgb(trace.radiance * weight, ray)}
        if "square" in wanted:
            result["square"] = result["image"] * result["image"]
        if "direct" in wanted:
            result["direct"] = to_rgb(trace.direct * weight, ray)
        if "reflection" in wanted:
            result["reflection"] = to_rgb((trace.radiance - trace.direct) * weight, ray)
        for name in ("bounces", "shadow_rays"):
            if name in wanted:
                result[name] = mi.Float(getattr(trace, name))
        return result | first_hit_layers(camera, trace.hit.si, trace.hit.found, ray, wanted)


def first_hit_layers(
    camera: Camera, si: Any, found: Any, ray: Any, wanted: AbstractSet[str]
) -> dict[str, Any]:
    """Distance (inf for a miss), geometric normal and diffuse reflectance (0 for a miss) of the first hit."""
    import drjit as dr
    import mitsuba as mi

    result = {}
    if "depth" in wanted:
        result["depth"] = dr.select(found, camera.distance(si), dr.inf)
    if "normal" in wanted:
        result["normal"] = dr.select(found, mi.Vector3f(si.n), 0)
    if "albedo" in wanted:
        albedo = mi.UnpolarizedSpectrum(0)
        if not mi.variant().startswith("scalar") or found:
            albedo = si.bsdf(mi.RayDifferential3f(ray)).eval_diffuse_reflectance(si, found)
        result["albedo"] = to_rgb(dr.select(found, albedo, 0), ray)
    return result


def to_rgb(spectrum: Any, ray: Any) -> Any:
    """Linear sRGB of a spectrum in the current variant."""
    import mitsuba as mi

    if mi.is_spectral:
        xyz = sum(
            mi.cie1931_xyz(wavelength) * value
            for wavelength, value in zip(ray.wavelengths, spectrum, strict=True)
        )
        return mi.xyz_to_srgb(xyz * (mi.MI_CIE_Y_NORMALIZATION / len(spectrum)))
    if mi.is_monochromatic:
        return mi.Color3f(spectrum[0])
    return mi.Color3f(spectrum)
