"""Tracing batches of rays in chosen pixels, and adding up their values.

A function of pixels and ray numbers says where rays start: on a lattice, where random numbers place them on a
film, or where the scene's sampler does. Values are averaged over the rays of each pixel of a lattice, or
accumulated on a ``Canvas`` under the film's filter. Vectorised variants trace wavefronts that fit into memory
and are short enough for progress to show; scalar variants trace ray by ray in Python.
"""

from __future__ import annotations

import logging
import math
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.files.layers import FIRST_HIT, TABLE
from mrt_mitsuba.filters.grid import dilated
from mrt_mitsuba.interrupts import deliver_pending
from mrt_mitsuba.machine import BYTES_PER_CHANNEL_OF_RAY, flush_cache, wavefront_size
from mrt_mitsuba.rendering.canvas import Canvas
from mrt_mitsuba.rendering.film import Film, SamplePattern, derived_seed, divide, opaque
from mrt_mitsuba.rendering.plan import Pass
from mrt_mitsuba.rendering.progress import Advance, Job
from mrt_mitsuba.rendering.settings import FILM
from mrt_mitsuba.rendering.shading import RayValues, Shader

log = logging.getLogger(__name__)

Values = list[Any]  # of rays, by channel: mi.Float, in scalar variants np.ndarray
FILM_PREFIX = "film:"  # of the names of channels of the film and the integrator, which are no layers
WAVEFRONT = 2**20  # rays of the first wavefront, and of later ones at least
WAVEFRONT_SECONDS = 0.5  # that later ones take, about


@dataclass(frozen=True)
class RayBatch:
    """Rays in groups of ``size``, each group belonging to an entry of a list of pixels."""

    size: int
    pixels: Any  #: of each entry: numbers row by row, those of a second picture after those of the first
    #: [2, entries], the number of groups and the number of their first ray among all of the pixel; None: one
    #: group for each entry, which begins with ray 0
    counts_and_first: np.ndarray | None = None
    first_group: int = 0  #: number of groups in earlier wavefronts

    @classmethod
    def from_counts(cls, size: int, counts: np.ndarray, before: np.ndarray) -> RayBatch:
        """``counts`` groups in each picture and pixel, [pictures, pixels], after ``before`` rays there."""
        chosen = np.flatnonzero(counts)
        shares = np.stack([counts.ravel()[chosen], before.ravel()[chosen]])
        return cls(size, chosen, shares.astype(np.int64))

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.pixels) if self.counts_and_first is None else int(self.counts_and_first[0].sum())

    @property
    def rays(self) -> int:
        """Number of rays."""
        return self.count * self.size

    def rays_of(self, pixels: int) -> np.ndarray:
        """Ray count per pixel, [pixels]."""
        rays = np.zeros(pixels, np.int64)
        given = self.pixels
        at = slice(given.start, given.stop) if isinstance(given, range) else given
        rays[at] = self.size if self.counts_and_first is None else self.size * self.counts_and_first[0]
        return rays

    def parts(self, limit: Callable[[], int], width: int) -> Iterator[tuple[slice, RayBatch]]:
        """Cut into parts of at most ``limit()`` groups, between rows of ``width`` pixels where possible.

        Yields the entries in each part, and their groups.
        """
        pixels = self.pixels
        shares = self.counts_and_first
        most = limit()
        if shares is not None and shares[0].max(initial=0) > most:
            # several entries for a pixel of more groups
            pieces = -(-shares[0] // most)
            number = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
            counts, first = np.repeat(shares, pieces, axis=1)
            shares = np.stack([np.minimum(counts - most * number, most), first + self.size * most * number])
            pixels = np.repeat(pixels, pieces)
        # groups up to the end of each entry
        ends: Any = range(1, len(pixels) + 1) if shares is None else np.cumsum(shares[0])
        start = 0
        done = 0
        while start < len(pixels):
            stop = max(bisect_right(ends, done + limit()), start + 1)
            if stop < len(pixels):
                row = bisect_left(pixels, pixels[stop] // width * width)
                stop = row if row > start else stop
            part = slice(start, stop)
            yield part, RayBatch(self.size, pixels[part], None if shares is None else shares[:, part], done)
            done = int(ends[stop - 1])
            start = stop

    def lanes(self) -> tuple[mi.UInt32, mi.UInt32]:
        """The pixel of each ray, and its number among all rays of the pixel."""
        ray = dr.arange(mi.UInt32, self.rays)
        entry, number = divide(ray, self.size)
        if self.counts_and_first is not None:
            counts, first = self.counts_and_first
            starts = np.cumsum(counts) - counts  # the first group of each entry
            begins = dr.zeros(mi.UInt32, self.count)
            dr.scatter(begins, mi.UInt32(1), mi.UInt32(starts))
            entry = dr.gather(mi.UInt32, dr.cumsum(begins), entry) - 1
            number = ray + dr.gather(mi.UInt32, mi.UInt32(first - self.size * starts), entry)
        if isinstance(self.pixels, range):
            return entry + opaque(self.pixels.start), number
        return dr.gather(mi.UInt32, mi.UInt32(self.pixels), entry), number


# ------------------------------------------ Where rays start ------------------------------------------


class CameraSample(NamedTuple):
    """Where and when rays start, one or one in each lane."""

    film: mi.Point2f | None  #: position on the film, in pixels; None on a lattice
    picture: mi.Point2f  #: position in the picture, [0, 1]²
    time: mi.Float | None  #: from 0, when the shutter opens, to 1; None: the sampler draws it
    sampler: mi.Sampler | None  #: of all other random numbers; None where there are none


# Of pixels, the numbers of rays among all of their pixel, and the number of groups in earlier wavefronts
Samples = Callable[[Any, Any, int], CameraSample]


def lattice_samples(pattern: SamplePattern, shader: Shader, seed: Any) -> Samples:
    """Return the samples of a lattice; ``seed``: a number, or an array of one."""
    random = shader.random or mi.is_spectral or shader.sensor.needs_aperture_sample()
    sampler = mi.load_dict({"type": "mrt_rays", "rays": pattern.size}) if random else None

    def at(pixel: mi.UInt32, number: mi.UInt32, first_group: int) -> CameraSample:
        if sampler is not None:
            sampler.seek_pixels(seed, pixel, number)
        return CameraSample(None, *pattern.at(pixel, number, shader.width, shader.height), sampler)

    return at


def film_samples(film: Film, seed: Any, sampler: mi.Sampler) -> Samples:
    """Return samples that a sampler of ``adaptive/samplers.py`` places in the pixels of several pictures."""

    def at(pixel: mi.UInt32, number: mi.UInt32, first_group: int) -> CameraSample:
        sampler.seek_pixels(seed, pixel, number)
        inside = divide(pixel, film.pixels)[1]
        return CameraSample(*film.place(inside, sampler), None, sampler)

    return at


def scene_samples(film: Film, seed: Any, rays: int) -> Samples:
    """Return ``rays`` samples of each pixel, placed by the scene's sampler.

    Mitsuba's ``independent`` is replaced by one whose numbers do not depend on how wavefronts are cut.
    """
    if film.independent:
        return film_samples(film, seed, mi.load_dict({"type": "mrt_rays", "rays": rays}))

    def at(pixel: mi.UInt32, number: mi.UInt32, first_group: int) -> CameraSample:
        sampler = film.sensor.sampler().clone()
        sampler.set_sample_count(rays)
        sampler.set_samples_per_wavefront(rays)
        sampler.seed(derived_seed(seed, wavefront=first_group), dr.width(pixel))
        return CameraSample(*film.place(pixel, sampler), None, sampler)

    return at


# ---------------------------------------- What values add up to ----------------------------------------


@dataclass(frozen=True)
class FilmAccumulator:
    """Accumulates exposures of several pictures of one film.

    An exposure may leave pixels out. It is weighted by the independent rays that it brings to a pixel, and
    counts only where none is missing under the filter; all rays of a pixel have the same weight.
    """

    film: Film
    sums: np.ndarray  #: filtered values times their weights, [channels, pictures, H, W]
    weights: np.ndarray  #: sums of these weights, [pictures, H, W]
    exposure_weight: np.ndarray  #: sums of the weights of exposures, [pictures, H, W]

    @classmethod
    def blank(cls, film: Film, pictures: int, channels: int) -> FilmAccumulator:
        """Return an empty accumulator."""
        sums = np.zeros((channels, pictures, *film.shape), np.float32)
        return cls(film, sums, np.zeros_like(sums[0]), np.zeros_like(sums[0]))

    @np.errstate(over="ignore", invalid="ignore")  # of light beyond float32, whose mean is infinite
    def accumulate(self, exposed: Canvas, chosen: np.ndarray, first: int = 0) -> FilmAccumulator:
        """Return the sums with an exposure of the ``chosen`` pixels, [pictures, pixels], added.

        ``first``: the picture of the exposure that belongs to the first one here.
        """
        some = slice(first, first + len(chosen))
        each = np.float32(1 / np.maximum(exposed.rays[some], 1))  # variance of a pixel's mean, up to a factor
        shape = self.exposure_weight.shape
        exposure_weight = chosen.reshape(shape) / self.film.filtered_variance(each.reshape(shape))
        return replace(
            self,
            sums=self.sums + exposure_weight * exposed.sums[: len(self.sums), some],
            weights=self.weights + exposure_weight * exposed.weights[some],
            exposure_weight=self.exposure_weight + exposure_weight,
        )

    def pictures(self) -> np.ndarray:
        """Return each picture, [pictures, H, W, channels], with the film's border."""
        weights = np.where(self.weights == 0, 1, self.weights)
        return np.moveaxis(self.sums / weights, 0, -1)

    def mean(self) -> np.ndarray:
        """Return the unweighted mean of the pictures, [H, W, channels], without the film's border."""
        exposure_weight = np.maximum(self.exposure_weight, 1e-30)
        sums = (self.sums / exposure_weight).sum(1)
        weights = (self.weights / exposure_weight).sum(0)
        return self.film.picture(np.moveaxis(sums / np.where(weights == 0, 1, weights), 0, -1))


def widened(film: Film, counts: np.ndarray) -> np.ndarray:
    """Return counts [pictures, pixels], raised to 1 in pixels within the filter's reach of a count."""
    if not film.reach:
        return counts
    near = dilated(counts.reshape(-1, *film.shape) > 0, film.reach)
    return np.maximum(counts, near.reshape(counts.shape))


def _over_rays(plane: Any, size: int, first: bool) -> np.ndarray:
    """Return the sum over the ``size`` rays of each pixel, or the value of the first ray, [pixels]."""
    if first or size == 1:
        return np.asarray(plane)[::size]
    if isinstance(plane, np.ndarray):
        return np.asarray(plane.reshape(-1, size).sum(1))
    if dr.width(plane) == 1:  # a value of one entry is that of all rays
        return np.asarray(plane * size)
    return np.asarray(dr.block_reduce(dr.ReduceOp.Add, plane, size))


class Exposer:
    """Traces rays in pixels of a lattice or of a film, and adds up their values.

    ``film_channels``: names of the channels of the film, R, G and B first, and of its integrator. ``names``:
    of all channels, those first. ``planes``: the layers next to the film's picture, with the places of each
    among the channels.
    """

    def __init__(self, job: Job, shader: Shader, step: Pass) -> None:
        film = shader.film if step.pattern.lattice == FILM else None
        self.job = job
        self.shader = shader
        self.film: Any = film  #: None for a lattice
        self.film_channels = [*"RGB", *"A" * film.alpha, *film.bands, *shader.aovs] if film else []
        self.names = list(self.film_channels)
        self._wavefront = WAVEFRONT  # rays of the next one
        self.planes: dict[str, slice] = {}
        known = ("image", "square") if film else ()  # to a film by itself
        for name, layer in TABLE.items():
            if name in step.layers and name not in known:
                start = len(self.names)
                self.names += [f"{name}.{letter}" for letter in layer.letters]
                self.planes[name] = slice(start, len(self.names))

    def samples(self, pattern: SamplePattern, seed: Any) -> Samples:
        """Return where the rays of a pass start; ``seed``: a number, or an array of one."""
        if self.film is not None:
            return scene_samples(self.film, seed, self.film.rays_near(pattern.size))
        return lattice_samples(pattern, self.shader, seed)

    def average(
        self,
        pattern: SamplePattern,
        seed: int,
        pixels: Any,
        layers: Mapping[str, np.ndarray],
        chosen: np.ndarray | None,
        advance: Advance,
    ) -> None:
        """Write the mean over the rays of each pixel of a lattice into layers, [pixels, channels] each; into
        layers of the first hit, the value of the first ray.

        ``chosen``: the rows of the pixels in the layers, whose means of earlier samples are averaged with the
        new ones; None: every row is new. Results do not depend on how rays are cut into wavefronts.
        """
        channels = len(self.names)
        known = pattern.first
        new = pattern.count
        groups = RayBatch(pattern.size, pixels)
        for part, _, _, values in self._wavefronts(groups, self.samples(pattern, seed), channels):
            rows = part if chosen is None else chosen[part]
            for name, planes in self.planes.items():
                first = TABLE[name].source == FIRST_HIT
                sums = [_over_rays(plane, groups.size, first) for plane in values[planes]]
                means = np.stack(np.broadcast_arrays(*sums), -1).astype(np.float32, copy=False)
                means *= np.float32(1 if first else 1 / groups.size)
                layer = layers[name]
                if chosen is not None:
                    means = (known * layer[rows] + new * means) / np.float32(known + new)
                layer[rows] = means
                del sums, means
            del values  # which would take room, as these would, next to the next wavefront
            advance(part.stop - part.start)
        space = self.job.workspace
        most = max(wavefront_size(space, channels), groups.size)
        flush_cache(space, min(most, groups.rays) * channels * BYTES_PER_CHANNEL_OF_RAY)

    def expose(
        self,
        groups: RayBatch,
        samples: Samples,
        *,
        pictures: int = 1,
        moments: bool = False,
        timed: bool = True,
        advance: Advance,
    ) -> Canvas:
        """Return a canvas with the values of rays; with ``moments``, the squares of their colours, too.

        ``timed``: time may decide where wavefronts are cut; not for random numbers that depend on the cuts.
        """
        film = self.film
        rays = groups.rays_of(pictures * film.pixels).reshape(pictures, -1)
        canvas = Canvas(film, rays, len(self.names), moments=moments)
        for _, some, place, values in self._wavefronts(groups, samples, 2 * len(self.names), timed):
            canvas.put(place, values, some.rays_of(rays.size))
            advance(some.rays)
        return canvas

    def _wavefronts(
        self, groups: RayBatch, samples: Samples, channels: int, timed: bool = True
    ) -> Iterator[tuple[slice, RayBatch, Any, Values]]:
        """Trace rays in wavefronts, each small enough for ``channels`` values of its rays to fit into memory.

        Yields the entries of the groups in a wavefront, these groups, the positions of their rays on the
        film, and their values.
        """
        width = self.film.width if self.film else self.shader.width
        most = wavefront_size(self.job.workspace, channels)
        self._wavefront = min(most, self._wavefront)
        start = time.perf_counter()

        def limit() -> int:
            return max(1, self._wavefront // groups.size)

        for part, some in groups.parts(limit, width):
            deliver_pending()
            place: Any
            values: Values
            if mi.variant().startswith("scalar"):
                place, values = self._one_by_one(some, samples)
            else:
                place, values = self.trace(*some.lanes(), samples, some.first_group)
                if self.film is not None and not self.film.reach:
                    place = None  # a box takes all rays of a pixel alike
                dr.eval(place, values)
            self.job.rays["primary"] += some.rays
            for name, planes in self.planes.items():
                if TABLE[name].counts:
                    count = np.sum(np.asarray(values[planes.start]), dtype=np.float64)
                    self.job.rays[TABLE[name].counts] += round(float(count))
            yield part, some, place, values
            del place, values
            seconds = time.perf_counter() - start
            start += seconds
            if timed:  # a power of two, so that Dr.Jit finds arrays to use again
                known = round(math.log2(max(some.rays * WAVEFRONT_SECONDS / max(seconds, 1e-9), 1)))
                self._wavefront = min(max(2**known, WAVEFRONT), most)

    def _one_by_one(self, groups: RayBatch, samples: Samples) -> tuple[np.ndarray, Values]:
        """Trace rays in a loop in Python, for scalar variants."""
        places = list[tuple[float, float]]()
        values = list[Values]()
        for entry, pixel in enumerate(groups.pixels):
            count, first = (
                (1, 0) if groups.counts_and_first is None else groups.counts_and_first[:, entry].tolist()
            )
            for number in range(first, first + groups.size * count):
                place, traced = self.trace(int(pixel), number, samples, groups.first_group)
                deliver_pending()
                places.append((0, 0) if place is None else (place.x, place.y))
                values.append(traced)
        return np.array(places).T, list(np.array(values).T)

    def trace(
        self, pixel: mi.UInt32, number: mi.UInt32, samples: Samples, first_group: int = 0
    ) -> tuple[Any, Values]:
        """Return the position on the film and the values of a ray, or of one in each lane."""
        start = samples(pixel, number, first_group)
        rays = self.shader.values(start.picture, start.time, start.sampler)
        values = [] if self.film is None else self._film_values(rays)
        for name in self.planes:
            values += _channels(getattr(rays, name))
        return start.film, values

    def _film_values(self, rays: RayValues) -> list[mi.Float]:
        """Return the values of the film's and the integrator's channels."""
        film = self.film
        channels = _channels(mi.Color3f(mi.luminance(rays.image)) if film.grey else rays.image)
        if film.alpha:
            channels.append(dr.select(rays.valid, mi.Float(1), 0))
        if film.bands:
            sensed = film.sensor.film().prepare_sample
            bands = sensed(rays.spectrum, rays.ray.wavelengths, len(film.bands) + 1)
            channels += [mi.Float(band) for band in bands[: len(film.bands)]]  # without the weight
        return channels + [mi.Float(aov) for aov in rays.aovs]


def _channels(value: Any) -> list[mi.Float]:
    """Return the channels of a value."""
    parts = list(value) if dr.size_v(value) > 1 else [value]
    return [mi.Float(part) for part in parts]
