"""Exposing pixels: tracing groups of rays in chosen ones, and adding up their values.

Where rays start is up to an object with ``start``: a lattice, the sampler of a scene, or any other sampling
of a film. What their values add up to is up to a canvas: means over the rays of each pixel, or sums under the
filter of a film. In vectorised variants rays are traced in wavefronts, split where they would not fit into
memory; in scalar variants by a loop in Python.
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.filters.grid import dilated
from mrt_mitsuba.interrupts import heed
from mrt_mitsuba.machine import BYTES_PER_CHANNEL_OF_RAY
from mrt_mitsuba.output.layers import FIRST_HIT, TABLE
from mrt_mitsuba.rays.canvas import Canvas
from mrt_mitsuba.rays.film import Film, Places, divide, opaque
from mrt_mitsuba.rendering.progress import Advance, Job
from mrt_mitsuba.rendering.shading import RayValues, Shader

log = logging.getLogger(__name__)

# Of rays, by layer and channel: mi.Float, in scalar variants np.ndarray
Values = dict[str, list[Any]]
OWN = "own:"  # begins what is no layer's name: the channels of the film and the integrator


class Groups(NamedTuple):
    """Groups of ``size`` rays, each in one pixel; several may be in the same."""

    size: int
    pixels: Any  #: of each: numbers row by row, those of a second picture after those of the first; ascending
    first: np.ndarray | None = None  #: of each, the number of its first ray among all of its pixel; None: 0
    before: int = 0  #: number of groups in earlier wavefronts

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
        start = 0
        count = len(self.pixels)
        while start < count:
            stop = min(start + most, count)
            if stop < count:
                row = bisect_left(self.pixels, self.pixels[stop] // width * width)
                stop = row if row > start else stop
            part = slice(start, stop)
            first = None if self.first is None else self.first[part]
            yield part, Groups(self.size, self.pixels[part], first, start)
            start = stop

    @property
    def rays(self) -> int:
        """Number of rays."""
        return len(self.pixels) * self.size

    def lanes(self) -> tuple[mi.UInt32, mi.UInt32]:
        """Return of each ray the number of its pixel, and its own among all of the pixel."""
        group, number = divide(dr.arange(mi.UInt32, self.rays), self.size)
        if isinstance(self.pixels, range):
            pixel = group + opaque(self.pixels.start)
        else:
            pixel = dr.gather(mi.UInt32, mi.UInt32(self.pixels), group)
        if self.first is not None:
            number += dr.gather(mi.UInt32, mi.UInt32(self.first), group)
        return pixel, number


# ------------------------------------------ Where rays start ------------------------------------------


class Start(NamedTuple):
    """Where and when rays start, one or one in each lane."""

    film: mi.Point2f | None  #: place on the film, in pixels; None on a lattice
    picture: mi.Point2f  #: place in the picture, [0, 1]²
    time: mi.Float | None  #: from 0, when the shutter opens, to 1; None: the sampler draws it
    sampler: mi.Sampler | None  #: of all else that is random; None where nothing is


class Starts(Protocol):
    """Where rays start."""

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        """Return where rays start, given their pixels and their numbers among all of the pixel; ``before``:
        groups in earlier wavefronts."""
        ...


class Sampling(Protocol):
    """Random numbers of rays."""

    seed: Any

    def start(self, pixel: mi.UInt32, number: mi.UInt32) -> mi.Sampler:
        """Return a sampler of rays, given their pixels and their numbers among all of the pixel."""
        ...


class Independent:
    """Independent random numbers, as Mitsuba numbers the rays of a whole picture, ``rays`` in each pixel.

    ``seed``: a number, or an array of one.
    """

    def __init__(self, seed: Any, rays: Any) -> None:
        self.seed = seed
        self._rays = rays
        self._sampler = mi.load_dict({"type": "mrt_rays"})

    def start(self, pixel: mi.UInt32, number: mi.UInt32) -> mi.Sampler:
        self._sampler.start(self.seed, mi.UInt64(pixel) * mi.UInt64(self._rays) + mi.UInt64(number))
        return self._sampler


class Sequences:
    """One sequence for each pixel, to be continued by later exposures."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._sampler = mi.load_dict({"type": "mrt_sequence"})

    def start(self, pixel: mi.UInt32, number: mi.UInt32) -> mi.Sampler:
        key = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, self.seed))[0]
        self._sampler.start(number, key)
        return self._sampler


@dataclass(frozen=True)
class LatticeStarts:
    """Rays start at the samples of a lattice, in a picture of this size."""

    places: Places
    width: int
    height: int
    sampling: Sampling | None  #: of what else is random; None where nothing is

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        sampler = None if self.sampling is None else self.sampling.start(pixel, number)
        return Start(None, *self.places.at(pixel, number, self.width, self.height), sampler)


@dataclass(frozen=True)
class FilmStarts:
    """Rays start in the pixels of a film where random numbers place them."""

    film: Film
    sampling: Sampling

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        sampler = self.sampling.start(pixel, number)
        return Start(*self.film.place(divide(pixel, self.film.pixels)[1], sampler), None, sampler)


class SceneStarts:
    """Rays start in the pixels of a film where the sampler of its scene places ``rays`` of each pixel."""

    def __init__(self, film: Film, seed: Any, rays: int) -> None:
        self._film = film
        self._seed = seed
        self._rays = rays
        one_by_one = mi.variant().startswith("scalar")
        independent = one_by_one or film.sampler == "IndependentSampler"
        self._independent = Independent(seed, opaque(rays)) if independent else None

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        if self._independent:
            sampler = self._independent.start(pixel, number)
        else:
            sampler = self._film.sensor.sampler().clone()
            sampler.set_sample_count(self._rays)
            sampler.set_samples_per_wavefront(self._rays)
            sampler.seed((self._seed + before) % 2**32, dr.width(pixel))
        return Start(*self._film.place(pixel, sampler), None, sampler)


# ---------------------------------------- What values add up to ----------------------------------------


class Means:
    """Means over the rays of each pixel, or of layers of the first hit what the first ray hit.

    They are written into layers, [pixels, channels] each; or averaged with rows ``chosen`` of them, ``share``
    being the weights of what is there and of what is new.
    """

    def __init__(
        self,
        layers: Mapping[str, np.ndarray],
        size: int,
        chosen: np.ndarray | None = None,
        share: tuple[int, int] = (0, 1),
    ) -> None:
        self._layers = layers
        self._size = size
        self._chosen = chosen
        self._share = share

    def put(self, part: slice, values: Values) -> None:
        """Take up the values of rays, ``size`` in each pixel of a part."""
        rows = part if self._chosen is None else self._chosen[part]
        for name, planes in values.items():
            first = TABLE[name].source == FIRST_HIT
            sums = np.broadcast_arrays(*(self._over_rays(plane, first) for plane in planes))
            means = np.stack(sums, -1).astype(np.float32, copy=False)
            means *= np.float32(1 if first else 1 / self._size)
            layer = self._layers[name]
            if self._chosen is not None:
                known, new = self._share
                means = (known * layer[rows] + new * means) / np.float32(known + new)
            layer[rows] = means

    def _over_rays(self, plane: Any, first: bool) -> np.ndarray:
        """Return by pixel the sum over its rays, or the value of the first."""
        size = self._size
        if first or size == 1:
            return np.asarray(plane)[::size]
        if isinstance(plane, np.ndarray):
            return np.asarray(plane.reshape(-1, size).sum(1))
        if dr.width(plane) == 1:  # a value of one entry is that of all rays
            return np.asarray(plane * size)
        return np.asarray(dr.block_reduce(dr.ReduceOp.Add, plane, size))


class Stack:
    """Pictures in the making, exposure upon exposure.

    An exposure may leave pixels out. It counts in proportion to the independent rays that it brings to a
    pixel, and only where none is missing under the filter; the rays of a pixel have the same weight in all.

    ``sums`` [channels, pictures, H, W]: filtered values times their weights; ``weights`` and ``amount``
    [pictures, H, W]: sums of these weights, and of those of the exposures; ``rays`` [pictures, pixels].
    """

    def __init__(self, film: Film, pictures: int, channels: int) -> None:
        self.film = film
        self.rays = np.zeros((pictures, film.pixels))
        self.sums = np.zeros((channels, pictures, *film.shape), np.float32)
        self.weights = np.zeros((pictures, *film.shape), np.float32)
        self.amount = np.zeros((pictures, *film.shape), np.float32)

    def widened(self, groups: np.ndarray) -> np.ndarray:
        """Return numbers of groups [pictures, pixels], one at least wherever the filter reaches from."""
        if not self.film.reach:
            return groups
        near = dilated(self.rows(groups) > 0, self.film.reach)
        return np.maximum(groups, near.reshape(groups.shape))

    @np.errstate(over="ignore")  # of light beyond float32, whose mean is infinite
    def add(self, exposed: Canvas, chosen: np.ndarray, first: int = 0) -> None:
        """Add as many pictures of an exposure as there are ``chosen`` pixels for, [pictures, pixels], from
        the ``first`` on."""
        some = slice(first, first + len(chosen))
        rays = exposed.rays[some]
        each = np.float32(1 / np.maximum(rays, 1))  # variance of a pixel's mean, up to a factor
        amount = self.rows(chosen) / self.film.spread_out(self.rows(each))
        self.sums += amount * exposed.sums[: len(self.sums), some]
        self.weights += amount * exposed.weights[some]
        self.amount += amount
        self.rays += rays

    def pictures(self) -> np.ndarray:
        """Return the pictures one by one, [pictures, H, W, channels], with the film's border."""
        weights = np.where(self.weights == 0, 1, self.weights)
        return np.moveaxis(self.sums / weights, 0, -1)

    def mean(self, pictures: int | None = None) -> np.ndarray:
        """Return the mean of the first pictures, each counting alike, [H, W, channels], without the border;
        None: of all."""
        amount = np.maximum(self.amount[:pictures], 1e-30)
        sums = (self.sums[:, :pictures] / amount).sum(1)
        weights = (self.weights[:pictures] / amount).sum(0)
        return self.film.picture(np.moveaxis(sums / np.where(weights == 0, 1, weights), 0, -1))

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Return a view [pictures, H, W, ...] of values [pictures, pixels, ...]."""
        return values.reshape(-1, *self.film.shape, *values.shape[2:])


class Exposer:
    """A shader that exposes pixels of a lattice, or of a film.

    ``layers``: by name, those to expose; of a film next to the picture. ``own``: names of the channels of a
    film, R, G and B first, and of its integrator. ``names``: of all channels, the own ones first.
    """

    def __init__(self, job: Job, shader: Shader, film: Film | None, layers: Set[str]) -> None:
        self.job = job
        self.shader = shader
        self.film: Any = film  #: None for a lattice
        known = ("image", "square") if film else ()  # to a film by itself
        self.layers = [name for name in TABLE if name in layers and name not in known]
        self.own = [*"RGB", *"A" * film.alpha, *film.bands, *shader.aovs] if film else []
        ours = [f"{name}.{letter}" for name in self.layers for letter in TABLE[name].letters]
        self.names = self.own + ours

    def starts(self, places: Places, seed: Any) -> LatticeStarts | SceneStarts:
        """Where the rays of a pass start; ``seed``: a number, or an array of one."""
        shader = self.shader
        if self.film is not None:
            return SceneStarts(self.film, seed, self.film.rays_near(places.size))
        random = shader.random or mi.is_spectral or shader.sensor.needs_aperture_sample()
        sampling = Independent(seed, opaque(places.size)) if random else None
        return LatticeStarts(places, shader.width, shader.height, sampling)

    def average(self, groups: Groups, starts: Starts, means: Means, advance: Advance) -> None:
        """Trace the rays of a lattice in pixels, and take up their means. They do not depend on how memory
        cuts the rays into wavefronts."""
        channels = len(self.names)
        for part, _, _, values in self._wavefronts(groups, starts, channels):
            means.put(part, values)
            advance(part.stop - part.start)
        workspace = self.job.workspace
        most = max(workspace.rays_at_once(channels), groups.size)
        workspace.give_back(min(most, groups.rays) * channels * BYTES_PER_CHANNEL_OF_RAY)

    def expose(
        self,
        groups: Groups,
        starts: Starts,
        *,
        pictures: int = 1,
        moments: bool = False,
        advance: Advance = lambda rays: None,
    ) -> Canvas:
        """Trace groups of rays on a film, and add their values up; with ``moments``, the squares of their
        colours as well."""
        film = self.film
        rays = np.bincount(groups.pixels, minlength=pictures * film.pixels).reshape(pictures, -1)
        canvas = Canvas(film, rays * groups.size, len(self.names), moments=moments)
        for _, some, place, values in self._wavefronts(groups, starts, 2 * len(self.names)):
            planes = [plane for channels in values.values() for plane in channels]
            canvas.put(place, planes, some.pixels, some.size)
            advance(some.rays)
        return canvas

    def _wavefronts(
        self, groups: Groups, starts: Starts, channels: int
    ) -> Iterator[tuple[slice, Groups, Any, Values]]:
        """Trace rays in as many wavefronts as fit into memory, with so many channels of each ray.

        Yields which of the groups are in a wavefront, these, the places of their rays on the film, and the
        values.
        """
        width = self.film.width if self.film else self.shader.width
        most = self.job.workspace.rays_at_once(channels)
        log.debug("tracing %d rays, at most %d at once", groups.rays, most)
        for part, some in groups.parts(max(1, most // groups.size), width):
            heed()
            trace = self._one_by_one if mi.variant().startswith("scalar") else self._at_once
            place, values = trace(some, starts)
            self.job.rays["primary"] += some.rays
            for name, planes in values.items():
                kind = TABLE[name].counts if name in TABLE else ""
                if kind:
                    self.job.rays[kind] += round(float(np.sum(np.asarray(planes[0]), dtype=np.float64)))
            yield part, some, place, values

    def _at_once(self, groups: Groups, starts: Starts) -> tuple[mi.Point2f, Values]:
        """Trace rays in one wavefront."""
        place, values = self.trace(*groups.lanes(), starts, groups.before)
        dr.eval(place, values)
        return place, values

    def _one_by_one(self, groups: Groups, starts: Starts) -> tuple[np.ndarray, Values]:
        """Trace rays in a loop, as scalar variants do."""
        places = list[tuple[float, float]]()
        values = dict[str, list[Any]]()
        for lane in range(groups.rays):
            group, number = divmod(lane, groups.size)
            if groups.first is not None:
                number += int(groups.first[group])
            place, traced = self.trace(int(groups.pixels[group]), number, starts, groups.before)
            heed()
            places.append((0, 0) if place is None else (place.x, place.y))
            for name, channels in traced.items():
                values.setdefault(name, []).append(channels)
        return np.array(places).T, {name: list(np.array(planes).T) for name, planes in values.items()}

    def trace(
        self, pixel: mi.UInt32, number: mi.UInt32, starts: Starts, before: int = 0
    ) -> tuple[Any, Values]:
        """Trace a ray, or one in each lane: return its place on the film, and its values."""
        start = starts.start(pixel, number, before)
        rays = self.shader.values(start.picture, start.time, start.sampler)
        values = {name: _channels(TABLE[name].value(rays)) for name in self.layers}
        if self.film is not None:
            values = {OWN: self._own(rays), **values}
        return start.film, values

    def _own(self, rays: RayValues) -> list[mi.Float]:
        """Return the channels of the film and the integrator."""
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
