"""Exposing pixels: tracing groups of rays in chosen ones, and what their values add up to.

Rays start where a lattice places them, or where a film's sampler does. In vectorised variants they are traced
in wavefronts, split where they would not fit into memory; in scalar variants by a loop in Python.
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections.abc import Callable, Iterator, Set
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.filters.grid import dilated
from mrt_mitsuba.interrupts import heed
from mrt_mitsuba.machine import BYTES_PER_CHANNEL_OF_RAY
from mrt_mitsuba.output.layers import FIRST_HIT, TABLE
from mrt_mitsuba.rays.film import Canvas, Film, Places, divide, opaque
from mrt_mitsuba.rendering.progress import Job
from mrt_mitsuba.rendering.shading import Shader

log = logging.getLogger(__name__)

# From the number of a pixel and that of a ray among all of the pixel: the place on the film, in pixels, that
# in the picture, [0, 1]², the time, and the sampler of what else is random
Start = Callable[[Any, Any], tuple[Any, Any, Any, Any]]


class Groups(NamedTuple):
    """Groups of ``size`` rays, each in one pixel; several may be in the same."""

    size: int
    pixels: Any  #: of each: numbers row by row, those of a second picture after those of the first; ascending
    first: np.ndarray | None = None  #: of each, the number of its first ray among all of its pixel; None: 0

    @classmethod
    def spread(cls, size: int, counts: np.ndarray, before: np.ndarray) -> Groups:
        """Return ``counts`` groups in each picture and pixel, [pictures, pixels], after ``before`` rays."""
        counts = counts.ravel()
        pixels = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
        first = (before.ravel() - size * (np.cumsum(counts) - counts)).astype(np.int64).astype(np.uint32)
        return cls(size, pixels, np.repeat(first, counts) + size * np.arange(len(pixels), dtype=np.uint32))

    def parts(self, most: int, width: int) -> Iterator[tuple[slice, Groups]]:
        """Yield parts of no more than ``most`` groups, cut between rows where that can be, and which groups
        are in each."""
        start, count = 0, len(self.pixels)
        while start < count:
            stop = min(start + most, count)
            if stop < count:
                row = bisect_left(self.pixels, self.pixels[stop] // width * width)
                stop = row if row > start else stop
            part, start = slice(start, stop), stop
            yield part, Groups(self.size, self.pixels[part], None if self.first is None else self.first[part])


class Stack:
    """Pictures in the making, exposure upon exposure.

    An exposure may leave pixels out. It counts in proportion to the independent rays that it brings to a
    pixel, and only where none is missing under the filter; the rays of a pixel have the same weight in all.
    """

    def __init__(self, film: Film, pictures: int, channels: int) -> None:
        self.film = film
        self.rays = np.zeros((pictures, film.pixels))
        # rows of channels in memory, which NumPy adds up much faster
        self._sums = np.moveaxis(np.zeros((channels, pictures, *film.shape), np.float32), 0, -1)
        self._weights, self._amount = np.zeros((2, pictures, *film.shape), np.float32)

    def widened(self, groups: np.ndarray) -> np.ndarray:
        """Return numbers of groups [pictures, pixels], one at least wherever the filter reaches from."""
        if not self.film.reach:
            return groups
        near = dilated(self.rows(groups) > 0, self.film.reach)
        return np.maximum(groups, near.reshape(groups.shape))

    @np.errstate(over="ignore")  # of light beyond float32, whose mean is infinite
    def add(self, exposed: Canvas, chosen: np.ndarray) -> None:
        """Add as many pictures of an exposure as there are ``chosen`` pixels for, [pictures, pixels]."""
        rays = exposed.rays[: len(chosen)]
        amount = self.rows(chosen) / self.film.spread_out(self.rows(np.float32(1 / np.maximum(rays, 1))))
        self._sums += amount[..., None] * exposed.sums[: len(chosen)]
        self._weights += amount * exposed.weights[: len(chosen)]
        self._amount += amount
        self.rays += rays

    def pictures(self) -> np.ndarray:
        """Return the pictures one by one, [pictures, H, W, channels], with the film's border."""
        return self._sums / np.where(self._weights == 0, 1, self._weights)[..., None]

    def mean(self) -> np.ndarray:
        """Return the mean of the pictures, each counting alike, [H, W, channels], without the border."""
        amount = np.maximum(self._amount, 1e-30)
        sums, weights = (self._sums / amount[..., None]).sum(0), (self._weights / amount).sum(0)
        return self.film.picture(sums / np.where(weights == 0, 1, weights)[..., None])

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Return a view [pictures, H, W, ...] of values [pictures, pixels, ...]."""
        return values.reshape(-1, *self.film.shape, *values.shape[2:])


class Exposer:
    """A shader that exposes pixels of a film or, without one, of a lattice.

    ``layers``: by name, those to expose; of a film next to the picture. ``names``: of all channels, of a film
    first R, G, B, its own, and the integrator's.
    """

    def __init__(self, job: Job, shader: Shader, film: Film | None, layers: Set[str]) -> None:
        self.job, self.shader = job, shader
        self.film: Any = film  #: None for a lattice
        own = ("image", "square") if film else ()  # which a film knows by itself
        self.layers = [name for name in TABLE if name in layers and name not in own]
        self.names = [f"{name}.{letter}" for name in self.layers for letter in TABLE[name].letters]
        if film:
            self.names = [*"RGB", *"A" * film.alpha, *film.bands, *shader.aovs, *self.names]

    def means(self, pixels: Any, places: Places, seed: int) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
        """Trace samples of a lattice in pixels, in parts that fit into memory or of one pixel.

        Yields which of the pixels are in a part, and by layer the values there, [pixels, channels]: means
        over the rays of each pixel, or what the first ray hit. They do not depend on the parts.
        """
        workspace, channels, size = self.job.workspace, len(self.names), places.size
        width, height = self.shader.width, self.shader.height
        random = self.shader.random or mi.is_spectral or self.shader.sensor.needs_aperture_sample()
        sampler = mi.load_dict({"type": "mrt_rays"}) if random else None

        def start(pixel: Any, number: Any) -> tuple[Any, Any, Any, Any]:
            if sampler is not None:
                sampler.start(seed, mi.UInt64(pixel) * mi.UInt64(opaque(size)) + mi.UInt64(number))
            return None, *places.at(pixel, number, width, height), sampler

        def over_rays(plane: Any, first: bool) -> np.ndarray:
            if first or size == 1:
                return np.asarray(plane)[::size]
            if isinstance(plane, np.ndarray):
                return np.asarray(plane.reshape(-1, size).sum(1))
            if dr.width(plane) == 1:  # a value of one entry is that of all rays
                return np.asarray(plane * size)
            return np.asarray(dr.block_reduce(dr.ReduceOp.Add, plane, size))

        most = workspace.rays_at_once(channels)
        log.debug("tracing %d rays, at most %d at once", len(pixels) * size, most)
        for part, groups in Groups(size, pixels).parts(max(1, most // size), width):
            means = dict[str, np.ndarray]()
            for name, planes in self._trace(groups, start)[1].items():
                first = TABLE[name].source == FIRST_HIT
                sums = np.broadcast_arrays(*(over_rays(plane, first) for plane in planes))
                means[name] = np.stack(sums, -1).astype(np.float32, copy=False)
                means[name] *= np.float32(1 if first else 1 / size)
            yield part, means
        workspace.give_back(min(most, len(pixels) * size) * channels * BYTES_PER_CHANNEL_OF_RAY)

    def expose(
        self,
        groups: Groups,
        seed: int,
        *,
        pictures: int = 1,
        progressive: bool = False,
        moments: bool = False,
        advance: Callable[[int], object] = lambda rays: None,
    ) -> Canvas:
        """Trace groups of rays in as many wavefronts as fit into memory, and add their values up.

        Args:
            progressive: draw from one sequence for each pixel, to be continued by later exposures; else as
                the scene's sampler does.
            moments: add up colours and their squares by pixel as well.
        """
        film, size = self.film, groups.size
        rays = np.bincount(groups.pixels, minlength=pictures * film.pixels).reshape(pictures, -1) * size
        canvas = Canvas(film, rays, len(self.names), moments=moments)
        most = max(1, self.job.workspace.rays_at_once(2 * len(self.names)) // size)
        log.debug("tracing %d rays, at most %d at once", len(groups.pixels) * size, most * size)
        scalar = mi.variant().startswith("scalar")
        sequence = progressive and not scalar
        independent = scalar or film.sampler == "IndependentSampler"
        sampler: Any = mi.load_dict({"type": "mrt_sequence" if sequence else "mrt_rays"})

        def start(pixel: Any, number: Any) -> tuple[Any, Any, Any, Any]:
            if sequence:
                sampler.start(number, mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, seed))[0])
            elif independent:  # numbered as Mitsuba numbers the rays of a whole picture
                rays = 2**24 if progressive else opaque(size)
                sampler.start(seed, mi.UInt64(pixel) * mi.UInt64(rays) + mi.UInt64(number))
            if progressive:
                _, pixel = divide(pixel, film.pixels)
            return *film.place(pixel, sampler), None, sampler

        for part, some in groups.parts(most, film.width):
            count = len(some.pixels) * size
            if not (sequence or independent):
                sampler = film.sensor.sampler().clone()
                sampler.set_sample_count(size)
                sampler.set_samples_per_wavefront(size)
                sampler.seed((seed + part.start) % 2**32, count)
            place, values = self._trace(some, start)
            planes = [plane for channels in values.values() for plane in channels]
            canvas.put(place, planes, some.pixels, size)
            advance(count)
        return canvas

    def _trace(self, groups: Groups, start: Start) -> tuple[Any, dict[str, list[Any]]]:
        """Trace a wavefront; return places on the film and values, by layer and channel, of all rays."""
        heed()
        size, pixels, count = groups.size, groups.pixels, len(groups.pixels) * groups.size
        if mi.variant().startswith("scalar"):
            places, values = [], dict[str, Any]()
            for lane in range(count):
                group, rest = divmod(lane, size)
                number = rest if groups.first is None else rest + int(groups.first[group])
                place, found = self._ray(int(pixels[group]), number, start)
                heed()
                places.append((0, 0) if place is None else (place.x, place.y))
                for name, channels in found.items():
                    values.setdefault(name, []).append(channels)
            place = np.array(places).T
            values = {name: list(np.array(planes).T) for name, planes in values.items()}
        else:
            group, number = divide(dr.arange(mi.UInt32, count), size)
            if isinstance(pixels, range):
                pixel = group + dr.opaque(mi.UInt32, pixels.start)
            else:
                pixel = dr.gather(mi.UInt32, mi.UInt32(pixels), group)
            if groups.first is not None:
                number += dr.gather(mi.UInt32, mi.UInt32(groups.first), group)
            place, values = self._ray(pixel, number, start)
            dr.eval(place, values)
        self.job.rays["primary"] += count
        for name, planes in values.items():
            kind = TABLE[name].counts if name in TABLE else ""
            if kind:
                self.job.rays[kind] += round(float(np.sum(np.asarray(planes[0]), dtype=np.float64)))
        return place, values

    def _ray(self, pixel: Any, number: Any, start: Start) -> tuple[Any, dict[str, list[Any]]]:
        """Trace a ray, or one in each lane: return its place on the film, and its values."""
        place, inside, time, sampler = start(pixel, number)
        values, film, found = self.shader.values(inside, time, sampler), self.film, dict[str, Any]()
        if film is not None:
            found["image"] = mi.Color3f(mi.luminance(values.image)) if film.grey else values.image
            if film.alpha:
                found["A"] = dr.select(values.valid, mi.Float(1), 0)
            if film.bands:
                sensed = film.sensor.film().prepare_sample
                bands = sensed(values.spectrum, values.ray.wavelengths, len(film.bands) + 1)
                found |= zip(film.bands, bands, strict=False)  # without the weight
            found |= zip(self.shader.aovs, values.aovs, strict=True)
        found |= {name: TABLE[name].value(values) for name in self.layers}
        parts = {name: list(value) if dr.size_v(value) > 1 else [value] for name, value in found.items()}
        return place, {name: [mi.Float(c) for c in channels] for name, channels in parts.items()}
