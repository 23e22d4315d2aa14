"""Exposing pixels: tracing groups of rays in chosen ones, and adding up their values.

Where rays start is up to an object with ``start``: given pixels, the numbers of rays among all of their pixel
and how many groups were in earlier wavefronts, it gives a ``Start``. There is one for a lattice, one for the
sampler of a scene and one for any other sampling of a film. Values of rays add up to means over the rays of
each pixel of a lattice, or on a ``Canvas`` to sums under the filter of a film. In vectorised variants rays
are traced in wavefronts, split where they would not fit into memory; in scalar variants by a loop in Python.
"""

from __future__ import annotations

import logging
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.files.layers import FIRST_HIT, TABLE
from mrt_mitsuba.filters.grid import dilated
from mrt_mitsuba.interrupts import heed
from mrt_mitsuba.machine import BYTES_PER_CHANNEL_OF_RAY
from mrt_mitsuba.rendering.canvas import Canvas
from mrt_mitsuba.rendering.film import Film, Places, divide, opaque
from mrt_mitsuba.rendering.plan import Pass
from mrt_mitsuba.rendering.progress import Advance, Job
from mrt_mitsuba.rendering.seeds import derived_seed
from mrt_mitsuba.rendering.settings import FILM
from mrt_mitsuba.rendering.shading import RayValues, Shader

log = logging.getLogger(__name__)

# Of rays, by channel: mi.Float, in scalar variants np.ndarray
Values = list[Any]
OWN = "own:"  # begins what is no layer's name: the channels of the film and the integrator


@dataclass(frozen=True)
class Groups:
    """Groups of ``size`` rays, each in one entry of a list of pixels."""

    size: int
    pixels: Any  #: of each entry: numbers row by row, those of a second picture after those of the first
    #: [2, entries], the number of groups and the number of their first ray among all of the pixel; None: one
    #: group for each entry, which begins with ray 0
    shares: np.ndarray | None = None
    before: int = 0  #: groups in earlier wavefronts

    @classmethod
    def shared_out(cls, size: int, counts: np.ndarray, before: np.ndarray) -> Groups:
        """``counts`` groups in each picture and pixel, [pictures, pixels], after ``before`` rays there."""
        chosen = np.flatnonzero(counts)
        shares = np.stack([counts.ravel()[chosen], before.ravel()[chosen]])
        return cls(size, chosen, shares.astype(np.int64))

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.pixels) if self.shares is None else int(self.shares[0].sum())

    @property
    def rays(self) -> int:
        """Number of rays."""
        return self.count * self.size

    def rays_of(self, pixels: int) -> np.ndarray:
        """The rays in each of so many pixels, [pixels]."""
        rays = np.zeros(pixels, np.int64)
        given = self.pixels
        at = slice(given.start, given.stop) if isinstance(given, range) else given
        rays[at] = self.size if self.shares is None else self.size * self.shares[0]
        return rays

    def parts(self, most: int, width: int) -> Iterator[tuple[slice, Groups]]:
        """Cut into parts of no more than ``most`` groups, between rows where that can be.

        Yields the entries in each part, and their groups.
        """
        pixels = self.pixels
        shares = self.shares
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
        before = 0
        while start < len(pixels):
            stop = bisect_right(ends, before + most)
            if stop < len(pixels):
                row = bisect_left(pixels, pixels[stop] // width * width)
                stop = row if row > start else stop
            part = slice(start, stop)
            yield part, Groups(self.size, pixels[part], None if shares is None else shares[:, part], before)
            before = int(ends[stop - 1])
            start = stop

    def lanes(self) -> tuple[mi.UInt32, mi.UInt32]:
        """The pixel of each ray, and its number among all rays of the pixel."""
        ray = dr.arange(mi.UInt32, self.rays)
        entry, number = divide(ray, self.size)
        if self.shares is not None:
            counts, first = self.shares
            starts = np.cumsum(counts) - counts  # the first group of each entry
            begins = dr.zeros(mi.UInt32, self.count)
            dr.scatter(begins, mi.UInt32(1), mi.UInt32(starts))
            entry = dr.gather(mi.UInt32, dr.cumsum(begins), entry) - 1
            number = ray + dr.gather(mi.UInt32, mi.UInt32(first - self.size * starts), entry)
        if isinstance(self.pixels, range):
            return entry + opaque(self.pixels.start), number
        return dr.gather(mi.UInt32, mi.UInt32(self.pixels), entry), number


# ------------------------------------------ Where rays start ------------------------------------------


class Start(NamedTuple):
    """Where and when rays start, one or one in each lane."""

    film: mi.Point2f | None  #: place on the film, in pixels; None on a lattice
    picture: mi.Point2f  #: place in the picture, [0, 1]²
    time: mi.Float | None  #: from 0, when the shutter opens, to 1; None: the sampler draws it
    sampler: mi.Sampler | None  #: of all else that is random; None where nothing is


def ray_sampler(rays: int) -> mi.Sampler:
    """Independent random numbers, as Mitsuba numbers the rays of a whole picture, ``rays`` in each pixel."""
    return mi.load_dict({"type": "mrt_rays", "rays": rays})


@dataclass(frozen=True)
class LatticeStarts:
    """Rays start at the samples of a lattice, in a picture of this size."""

    places: Places
    width: int
    height: int
    seed: Any  #: a number, or an array of one
    sampler: mi.Sampler | None  #: of what else is random; None where nothing is

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        if self.sampler is not None:
            self.sampler.start_in(self.seed, pixel, number)
        return Start(None, *self.places.at(pixel, number, self.width, self.height), self.sampler)


@dataclass(frozen=True)
class FilmStarts:
    """Rays start in the pixels of a film where random numbers place them."""

    film: Film
    seed: Any  #: a number, or an array of one
    sampler: mi.Sampler  #: one of ``adaptive/samplers.py``

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        self.sampler.start_in(self.seed, pixel, number)
        inside = divide(pixel, self.film.pixels)[1]
        return Start(*self.film.place(inside, self.sampler), None, self.sampler)


@dataclass(frozen=True)
class SceneStarts:
    """Rays start in the pixels of a film where the sampler of its scene places ``rays`` of each pixel."""

    film: Film
    seed: Any  #: a number, or an array of one
    rays: int
    independent: mi.Sampler | None  #: in place of Mitsuba's of this name; None: the scene has another

    def start(self, pixel: mi.UInt32, number: mi.UInt32, before: int) -> Start:
        if self.independent is not None:
            sampler = self.independent
            sampler.start_in(self.seed, pixel, number)
        else:
            sampler = self.film.sensor.sampler().clone()
            sampler.set_sample_count(self.rays)
            sampler.set_samples_per_wavefront(self.rays)
            sampler.seed(derived_seed(self.seed, wavefront=before), dr.width(pixel))
        return Start(*self.film.place(pixel, sampler), None, sampler)


Starts = LatticeStarts | FilmStarts | SceneStarts


# ---------------------------------------- What values add up to ----------------------------------------


@dataclass(frozen=True)
class Stack:
    """Pictures in the making, exposure upon exposure.

    An exposure may leave pixels out. It counts in proportion to the independent rays that it brings to a
    pixel, and only where none is missing under the filter; the rays of a pixel have the same weight in all.
    """

    film: Film
    sums: np.ndarray  #: filtered values times their weights, [channels, pictures, H, W]
    weights: np.ndarray  #: sums of these weights, [pictures, H, W]
    amount: np.ndarray  #: sums of the weights of exposures, [pictures, H, W]

    @classmethod
    def blank(cls, film: Film, pictures: int, channels: int) -> Stack:
        """Pictures that nothing was exposed to."""
        sums = np.zeros((channels, pictures, *film.shape), np.float32)
        return cls(film, sums, np.zeros_like(sums[0]), np.zeros_like(sums[0]))

    @np.errstate(over="ignore", invalid="ignore")  # of light beyond float32, whose mean is infinite
    def plus(self, exposed: Canvas, chosen: np.ndarray, first: int = 0) -> Stack:
        """With as many pictures of an exposure as there are ``chosen`` pixels for, [pictures, pixels], from
        the ``first`` on."""
        some = slice(first, first + len(chosen))
        each = np.float32(1 / np.maximum(exposed.rays[some], 1))  # variance of a pixel's mean, up to a factor
        shape = self.amount.shape
        amount = chosen.reshape(shape) / self.film.spread_out(each.reshape(shape))
        return replace(
            self,
            sums=self.sums + amount * exposed.sums[: len(self.sums), some],
            weights=self.weights + amount * exposed.weights[some],
            amount=self.amount + amount,
        )

    def pictures(self) -> np.ndarray:
        """The pictures one by one, [pictures, H, W, channels], with the film's border."""
        weights = np.where(self.weights == 0, 1, self.weights)
        return np.moveaxis(self.sums / weights, 0, -1)

    def mean(self) -> np.ndarray:
        """The mean of the pictures, each counting alike, [H, W, channels], without the border."""
        amount = np.maximum(self.amount, 1e-30)
        sums = (self.sums / amount).sum(1)
        weights = (self.weights / amount).sum(0)
        return self.film.picture(np.moveaxis(sums / np.where(weights == 0, 1, weights), 0, -1))


def widened(film: Film, counts: np.ndarray) -> np.ndarray:
    """Counts [pictures, pixels], at least one wherever the film's filter reaches from."""
    if not film.reach:
        return counts
    near = dilated(counts.reshape(-1, *film.shape) > 0, film.reach)
    return np.maximum(counts, near.reshape(counts.shape))


def _over_rays(plane: Any, size: int, first: bool) -> np.ndarray:
    """The sum over the ``size`` rays of each pixel, or the value of the first ray, [pixels]."""
    if first or size == 1:
        return np.asarray(plane)[::size]
    if isinstance(plane, np.ndarray):
        return np.asarray(plane.reshape(-1, size).sum(1))
    if dr.width(plane) == 1:  # a value of one entry is that of all rays
        return np.asarray(plane * size)
    return np.asarray(dr.block_reduce(dr.ReduceOp.Add, plane, size))


class Exposer:
    """A shader that exposes pixels of a lattice, or of a film.

    ``own``: names of the channels of a film, R, G and B first, and of its integrator. ``names``: of all
    channels, the own ones first. ``planes``: the layers to expose, of a film next to its picture, each with
    its places among the channels.
    """

    def __init__(self, job: Job, shader: Shader, step: Pass) -> None:
        film = shader.film if step.places.lattice == FILM else None
        self.job = job
        self.shader = shader
        self.film: Any = film  #: None for a lattice
        self.own = [*"RGB", *"A" * film.alpha, *film.bands, *shader.aovs] if film else []
        self.names = list(self.own)
        self.planes: dict[str, slice] = {}
        known = ("image", "square") if film else ()  # to a film by itself
        for name, layer in TABLE.items():
            if name in step.layers and name not in known:
                start = len(self.names)
                self.names += [f"{name}.{letter}" for letter in layer.letters]
                self.planes[name] = slice(start, len(self.names))

    def starts(self, places: Places, seed: Any) -> LatticeStarts | SceneStarts:
        """Where the rays of a pass start; ``seed``: a number, or an array of one."""
        shader = self.shader
        film = self.film
        if film is not None:
            rays = film.rays_near(places.size)
            independent = mi.variant().startswith("scalar") or film.sampler == "IndependentSampler"
            return SceneStarts(film, seed, rays, ray_sampler(rays) if independent else None)
        random = shader.random or mi.is_spectral or shader.sensor.needs_aperture_sample()
        sampler = ray_sampler(places.size) if random else None
        return LatticeStarts(places, shader.width, shader.height, seed, sampler)

    def average(
        self,
        places: Places,
        seed: int,
        pixels: Any,
        layers: Mapping[str, np.ndarray],
        chosen: np.ndarray | None,
        advance: Advance,
    ) -> None:
        """Trace the rays of a lattice in pixels, and write the mean of each pixel into layers, [pixels,
        channels] each; into layers of the first hit, what its first ray hit.

        ``chosen``: the rows of the pixels in the layers, whose means of earlier samples are averaged with the
        new ones; None: every row is new. The results do not depend on how memory cuts the rays into
        wavefronts.
        """
        channels = len(self.names)
        known = places.first
        new = places.count
        groups = Groups(places.size, pixels)
        for part, _, _, values in self._wavefronts(groups, self.starts(places, seed), channels):
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
        advance: Advance,
    ) -> Canvas:
        """Trace groups of rays on a film, and add their values up; with ``moments``, the squares of their
        colours as well."""
        film = self.film
        rays = groups.rays_of(pictures * film.pixels).reshape(pictures, -1)
        canvas = Canvas(film, rays, len(self.names), moments=moments)
        for _, some, place, values in self._wavefronts(groups, starts, 2 * len(self.names)):
            canvas.put(place, values, some.rays_of(rays.size))
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
            place: Any
            values: Values
            if mi.variant().startswith("scalar"):
                place, values = self._one_by_one(some, starts)
            else:
                place, values = self.trace(*some.lanes(), starts, some.before)
                if self.film is not None and not self.film.reach:
                    place = None  # a box takes all rays of a pixel alike
                dr.eval(place, values)
            self.job.rays["primary"] += some.rays
            for name, planes in self.planes.items():
                if TABLE[name].counts:
                    count = np.sum(np.asarray(values[planes.start]), dtype=np.float64)
                    self.job.rays[TABLE[name].counts] += round(float(count))
            yield part, some, place, values

    def _one_by_one(self, groups: Groups, starts: Starts) -> tuple[np.ndarray, Values]:
        """Trace rays in a loop, as scalar variants do."""
        places = list[tuple[float, float]]()
        values = list[Values]()
        for entry, pixel in enumerate(groups.pixels):
            count, first = (1, 0) if groups.shares is None else groups.shares[:, entry].tolist()
            for number in range(first, first + groups.size * count):
                place, traced = self.trace(int(pixel), number, starts, groups.before)
                heed()
                places.append((0, 0) if place is None else (place.x, place.y))
                values.append(traced)
        return np.array(places).T, list(np.array(values).T)

    def trace(
        self, pixel: mi.UInt32, number: mi.UInt32, starts: Starts, before: int = 0
    ) -> tuple[Any, Values]:
        """Trace a ray, or one in each lane, for its place on the film, and its values."""
        start = starts.start(pixel, number, before)
        rays = self.shader.values(start.picture, start.time, start.sampler)
        values = [] if self.film is None else self._own(rays)
        for name in self.planes:
            values += _channels(TABLE[name].value(rays))
        return start.film, values

    def _own(self, rays: RayValues) -> list[mi.Float]:
        """The channels of the film and the integrator."""
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
    """The channels of a value."""
    parts = list(value) if dr.size_v(value) > 1 else [value]
    return [mi.Float(part) for part in parts]
