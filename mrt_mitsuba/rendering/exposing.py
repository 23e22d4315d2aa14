"""Exposing pixels: tracing groups of rays in chosen ones, and what their values add up to.

Rays start where a lattice places them, or where a film's sampler does. In vectorised variants they are traced
in wavefronts, split where they would not fit into memory; in scalar variants by a loop in Python.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from mrt_mitsuba.interrupts import heed
from mrt_mitsuba.output.layers import FIRST_HIT, TABLE
from mrt_mitsuba.output.layers import channels as channel_count
from mrt_mitsuba.rays.canvas import Canvas
from mrt_mitsuba.rays.divisor import constants
from mrt_mitsuba.rays.film import Film
from mrt_mitsuba.rays.lattice import Places
from mrt_mitsuba.rays.samplers import pixel_sequence, ray_sampler
from mrt_mitsuba.rendering.job import Job
from mrt_mitsuba.rendering.shading import Shader, components
from mrt_mitsuba.rendering.view import View
from mrt_mitsuba.rendering.windows import dilated

log = logging.getLogger(__name__)

# From the number of a pixel, that of a ray in its group and that among all rays of the pixel: the place on
# the film, in pixels, that in the picture, [0, 1]², the time, and the sampler of what else is random
Start = Callable[[Any, Any, Any], tuple[Any, Any, Any, Any]]
# By layer or channel, one array for each of its channels: [groups] float32
Planes = Mapping[str, Sequence[np.ndarray]]


@dataclass(frozen=True)
class Groups:
    """Groups of ``size`` rays, some in each of some pixels.

    ``pixels``: ascending numbers, row by row from the top, those of a second picture after those of the
    first; or a range, for which no numbers are stored.
    """

    size: int
    pixels: Any
    counts: np.ndarray | None = None  #: groups in each; None: one
    first: np.ndarray | None = None  #: number of the first ray of each among all that the pixel gets in time

    @classmethod
    def spread(cls, size: int, counts: np.ndarray, before: np.ndarray) -> Groups:
        """Return ``counts`` groups in each picture and pixel, [pictures, pixels], after ``before`` rays."""
        pixels = np.flatnonzero(counts)
        return cls(size, pixels, counts.ravel()[pixels], before.ravel()[pixels].astype(np.int64))

    def __len__(self) -> int:
        return len(self.pixels) if self.counts is None else int(self.counts.sum())

    @cached_property
    def _ends(self) -> np.ndarray:
        return np.arange(1, len(self) + 1) if self.counts is None else np.cumsum(self.counts)

    @property
    def rays(self) -> Any:
        """Number of rays of each pixel."""
        return self.size if self.counts is None else self.size * self.counts

    def parts(self, most: int, width: int) -> Iterator[tuple[int, Groups]]:
        """Yield parts of no more than ``most`` groups, cut between rows where that can be, and the number of
        the first group of each."""
        cuts = [0]
        if not len(self):
            return
        if len(self) <= most:
            cuts.append(len(self))
        elif isinstance(self.pixels, range):
            cuts = [*range(0, len(self), most // width * width or most), len(self)]
        else:
            ends = self._ends[np.diff(self.pixels // width, append=-1) != 0]  # of rows
            while cuts[-1] < len(self):
                whole = ends[: np.searchsorted(ends, cuts[-1] + most, "right")]
                cuts.append(int(whole[-1]) if len(whole) and whole[-1] > cuts[-1] else cuts[-1] + most)
        for start, stop in pairwise(cuts):
            yield start, self._part(start, min(stop, len(self)))

    def _part(self, start: int, stop: int) -> Groups:
        if self.counts is None or self.first is None:
            return Groups(self.size, self.pixels[start:stop])
        run = slice(np.searchsorted(self._ends, start, "right"), np.searchsorted(self._ends, stop) + 1)
        begin = self._ends[run] - self.counts[run]
        low, high = np.maximum(begin, start), np.minimum(self._ends[run], stop)
        return Groups(self.size, self.pixels[run], high - low, self.first[run] + self.size * (low - begin))

    @property
    def places(self) -> np.ndarray:
        """The place in ``pixels`` of each group."""
        return np.repeat(
            np.arange(len(self.pixels), dtype=np.uint32), 1 if self.counts is None else self.counts
        )

    @property
    def offsets(self) -> np.ndarray:
        """By pixel, the number of a ray in it minus that among the rays of all groups, modulo 2³²."""
        return (self.first - self.size * (self._ends - self.counts)).astype(np.uint32)


@dataclass(frozen=True)
class Exposed:
    """The sums over the rays of one exposure; the rays of a pixel weigh 1 in all."""

    sums: np.ndarray  #: [pictures, H, W, channels]: filtered values times their weights
    weights: np.ndarray  #: [pictures, H, W]: filtered weights
    rays: np.ndarray  #: [pictures, pixels]: how many started there
    total: np.ndarray  #: [pictures, H, W, 3]: of the colours of those; empty where not asked for
    square: np.ndarray  #: [pictures, H, W, 3]: of their squares
    peak: np.ndarray  #: [pictures, H, W, 1]: mean colour of the brightest, for progressive groups


class Stack:
    """Pictures in the making, exposure upon exposure.

    An exposure may leave pixels out. It counts in proportion to the independent rays that it brings to a
    pixel, and only where none is missing under the filter; the rays of a pixel have the same weight in all.
    """

    def __init__(self, film: Film, pictures: int, channels: int) -> None:
        self.film = film
        self.rays = np.zeros((pictures, film.pixels))
        self._sums = channels_last(np.zeros((channels, pictures, *film.shape), np.float32))
        self._weights, self._amount = np.zeros((2, pictures, *film.shape), np.float32)

    def widened(self, groups: np.ndarray) -> np.ndarray:
        """Return numbers of groups [pictures, pixels], one at least wherever the filter reaches from."""
        if not self.film.reach:
            return groups
        near = dilated(self.rows(groups) > 0, self.film.reach)
        return np.maximum(groups, near.reshape(groups.shape))

    def add(self, exposed: Exposed, chosen: np.ndarray) -> None:
        """Add an exposure that was made for the ``chosen`` pixels [pictures, pixels]."""
        each = np.float32(1 / np.maximum(exposed.rays, 1))
        amount = self.rows(chosen) / self.film.spread_out(self.rows(each))
        self._sums += amount[..., None] * exposed.sums
        self._weights += amount * exposed.weights
        self._amount += amount
        self.rays += exposed.rays

    def pictures(self) -> np.ndarray:
        """Return the pictures one by one, [pictures, H, W, channels], with the film's border."""
        return _divided(self._sums, self._weights)

    def mean(self) -> np.ndarray:
        """Return the mean of the pictures, each counting alike, [H, W, channels], without the border."""
        amount = np.maximum(self._amount, 1e-30)
        return self.film.picture(
            _divided((self._sums / amount[..., None]).sum(0), (self._weights / amount).sum(0))
        )

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Return a view [pictures, H, W, ...] of values [pictures, pixels, ...]."""
        return values.reshape(-1, *self.film.shape, *values.shape[2:])


def channels_last(values: np.ndarray) -> np.ndarray:
    """Return a view [..., channels] of channels [channels, ...], whose rows NumPy adds up much faster."""
    return np.moveaxis(values, 0, -1)


def _divided(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sums [..., channels] over weights [...], as Mitsuba's films divide them."""
    return np.asarray(sums / np.where(weights == 0, 1, weights)[..., None])


@dataclass
class Exposer:
    """A shader that exposes pixels of a view, or of its film."""

    job: Job
    shader: Shader
    view: View
    film: Any = None
    layers: Sequence[str] = ()  #: to expose; with a film, averaged ones, next to the picture

    @property
    def names(self) -> tuple[str, ...]:
        """Channels of the picture: R, G, B, those that the film and the integrator have, and the layers'."""
        film = self.film
        own = () if film is None else (*(("A",) if film.alpha else ()), *film.bands)
        layers = [f"{name}.{letter}" for name in self.layers for letter in TABLE[name].letters]
        return ("R", "G", "B", *own, *self.shader.aovs, *layers)

    # ------------------------------------------- Lattices -------------------------------------------

    def means(self, pixels: Any, places: Places, seed: int) -> Iterator[tuple[slice, Planes]]:
        """Trace samples of a lattice in pixels, in parts that fit into memory or of one pixel.

        Yields which of the pixels are in a part, and the layers there: means over the rays of each pixel, or
        what the first ray hit. They do not depend on the parts.
        """
        workspace, channels = self.job.workspace, channel_count(self.layers)
        most, width = workspace.rays_at_once(channels), self.view.width
        start = self._on_lattice(places, seed)
        log.debug("tracing %d rays, at most %d at once", len(pixels) * places.size, most)
        for first, part in Groups(places.size, pixels).parts(max(1, most // places.size), width):
            sums = self._wavefront(part, start)
            share = np.float32(1 / places.size)
            means = {
                name: [plane if TABLE[name].source == FIRST_HIT else plane * share for plane in planes]
                for name, planes in sums.items()
            }
            yield slice(first, first + len(part)), means if places.size > 1 else sums
        workspace.after_rays(min(most, len(pixels) * places.size), channels)

    def _on_lattice(self, places: Places, seed: int) -> Start:
        import mitsuba as mi

        random = self.shader.random or mi.is_spectral or self.view.sensor.needs_aperture_sample()
        sampler = ray_sampler() if random else None
        numbers = places.numbers(self.view.width, self.view.height)
        size = constants(size=places.size)["size"].number

        def start(pixel: Any, rest: Any, number: Any) -> tuple[Any, Any, Any, Any]:
            if sampler is not None:
                sampler.start(seed, mi.UInt64(pixel) * mi.UInt64(size) + mi.UInt64(number))
            return None, *places.at(pixel, rest, numbers), sampler

        return start

    # --------------------------------------------- Films --------------------------------------------

    def expose(
        self,
        groups: Groups,
        seed: int,
        *,
        pictures: int = 1,
        progressive: bool = False,
        moments: bool = False,
        advance: Callable[[int], object] = lambda rays: None,
    ) -> Exposed:
        """Trace groups of rays in as many wavefronts as fit into memory, and add their values up.

        Args:
            progressive: draw from one sequence for each pixel, to be continued by later exposures; else as
                the scene's sampler does.
            moments: add up colours and their squares by pixel as well.
        """
        film, kept = self.film, len(self.names)
        rays = np.zeros((pictures, film.pixels), np.int64)
        rays.ravel()[groups.pixels] = groups.rays
        # where pixels have one group each, and its rays reach no other, sums of groups are what is wanted
        canvas = Canvas(film, rays, kept, moments=moments) if film.reach or progressive else None
        total = np.zeros((0 if canvas else kept + 3 * moments, rays.size))
        most = max(1, self.job.workspace.rays_at_once(2 * kept) // groups.size)
        log.debug("tracing %d rays, at most %d at once", len(groups) * groups.size, most * groups.size)
        for before, part in groups.parts(most, film.width):
            start = self._on_film(part, seed, before, progressive)
            planes = self._wavefront(part, start, canvas, moments and canvas is None)
            flat = (plane for channels in planes.values() for plane in channels)
            for row, plane in zip(total, flat, strict=True):
                row[part.pixels] = plane
            advance(len(part) * part.size)
        if canvas is not None:
            sums, colors = canvas.sums, canvas.moments
        else:
            means = np.concatenate([total[:kept] / np.maximum(rays.ravel(), 1), rays.reshape(1, -1) > 0])
            found = np.concatenate([means, total[: 3 * moments], total[kept:]])
            sums, colors = np.split(channels_last(found.reshape(-1, pictures, *film.shape)), [kept + 1], -1)
        return Exposed(sums[..., :-1], sums[..., -1], rays, *np.split(colors, [3, 6], axis=-1))

    def _on_film(self, groups: Groups, seed: int, before: int, progressive: bool) -> Start:
        """Return where rays of groups start, ``before`` of which were traced already."""
        import drjit as dr
        import mitsuba as mi

        film, size, scalar = self.film, groups.size, mi.variant().startswith("scalar")
        stock = film.sensor.sampler()
        numbers = constants(size=size, area=film.pixels)
        key = seed if scalar else dr.opaque(mi.UInt32, seed)
        independent = scalar or stock.class_name() == "IndependentSampler"
        sampler = ray_sampler()
        if progressive and not scalar:
            sampler = pixel_sequence()
        elif not independent:
            sampler = stock.clone()
            sampler.set_sample_count(size)
            sampler.set_samples_per_wavefront(size)
            sampler.seed((seed + before) % 2**32, len(groups) * size)

        def start(pixel: Any, rest: Any, number: Any) -> tuple[Any, Any, Any, Any]:
            rays = 2**24 if progressive else numbers["size"].number
            if progressive and not scalar:
                sampler.start(number, mi.sample_tea_32(pixel, key)[0])
            elif independent:
                # numbered as Mitsuba numbers the rays of a whole picture
                sampler.start(key, mi.UInt64(pixel) * mi.UInt64(rays) + mi.UInt64(number))
            if progressive:
                _, pixel = numbers["area"].divide(pixel)
            return *film.place(pixel, sampler), None, sampler

        return start

    # ---------------------------------------------- Rays --------------------------------------------

    def _wavefront(
        self, groups: Groups, start: Start, canvas: Canvas | None = None, moments: bool = False
    ) -> Planes:
        """Trace a wavefront onto a canvas. Without one, return sums over each group by layer and channel,
        those of squares last if ``moments``; of the layers of the first hit, what the first ray found."""
        import drjit as dr
        import mitsuba as mi

        heed()
        if mi.variant().startswith("scalar"):
            place, values = self._one_by_one(groups, start, moments)
        else:
            place, values = self._ray(*_numbered(groups), start, moments)
        counted = {name: TABLE[name].counts for name in values if name in TABLE and TABLE[name].counts}
        if canvas is not None:
            flat = [plane for planes in values.values() for plane in planes]
            dr.eval(place, flat)
            canvas.put(place, flat, groups.pixels, groups.rays)
            values = {name: values[name] for name in counted}
        if groups.size > 1:
            values = _by_group(values, groups)
        dr.eval(values)
        # LLVM's arrays are not copied
        sums = {name: [np.asarray(plane, np.float32) for plane in planes] for name, planes in values.items()}
        self.job.count("primary", len(groups) * groups.size)
        for name, kind in counted.items():
            self.job.count(kind, round(float(np.sum(sums[name][0], dtype=np.float64))))
        return {} if canvas is not None else sums

    def _ray(
        self, pixel: Any, rest: Any, number: Any, start: Start, moments: bool
    ) -> tuple[Any, dict[str, list[Any]]]:
        """Trace a ray of each group and pixel: return its place on the film, and its values."""
        import drjit as dr
        import mitsuba as mi

        place, inside, time, sampler = start(pixel, rest, number)
        ray, weight = self.view.rays(inside, time, sampler)
        values, film = self.shader.values(self.view, ray, weight, sampler), self.film
        found: dict[str, Any] = {}
        if film is not None:
            found["image"] = film.toned(values.image)
            if film.alpha:
                found["A"] = dr.select(values.valid, mi.Float(1), 0)
            if film.bands:
                found |= zip(film.bands, film.banded(values.spectrum, ray.wavelengths), strict=True)
            found |= zip(self.shader.aovs, values.aovs, strict=True)
        found |= {name: TABLE[name].value(values) for name in self.layers}
        if moments:
            found["square"] = found["image"] * found["image"]
        return place, {name: [mi.Float(c) for c in components(value)] for name, value in found.items()}

    def _one_by_one(
        self, groups: Groups, start: Start, moments: bool
    ) -> tuple[np.ndarray, dict[str, list[np.ndarray]]]:
        """Trace the rays of groups in a loop: return places on the film, [2, rays], and values, [rays]."""
        alone = groups.counts is None
        at, offsets = (None, None) if alone else (groups.places, groups.offsets)
        places, found = [], dict[str, list[Any]]()
        for lane in range(len(groups) * groups.size):
            group, rest = divmod(lane, groups.size)
            pixel, number = groups.pixels[group if at is None else at[group]], rest
            if at is not None and offsets is not None:
                number = (lane + int(offsets[at[group]])) % 2**32
            place, values = self._ray(int(pixel), rest, number, start, moments)
            heed()
            places.append((0, 0) if place is None else (place.x, place.y))
            for name, channels in values.items():
                found.setdefault(name, []).append(channels)
        planes = {name: list(np.array(values).T) for name, values in found.items()}
        return np.array(places).T, planes


def _numbered(groups: Groups) -> tuple[Any, Any, Any]:
    """Return of each ray its pixel, its number in its group, and that among all rays of the pixel."""
    import drjit as dr
    import mitsuba as mi

    lane = dr.arange(mi.UInt32, len(groups) * groups.size)
    group, rest = constants(size=groups.size)["size"].divide(lane)
    if isinstance(groups.pixels, range):
        return group + dr.opaque(mi.UInt32, groups.pixels.start), rest, rest
    pixels = mi.UInt32(groups.pixels)
    if groups.counts is None:
        return dr.gather(mi.UInt32, pixels, group), rest, rest
    place = dr.gather(mi.UInt32, mi.UInt32(groups.places), group)
    offset = dr.gather(mi.UInt32, mi.UInt32(groups.offsets), place)
    return dr.gather(mi.UInt32, pixels, place), rest, lane + offset


def _by_group(values: Mapping[str, Sequence[Any]], groups: Groups) -> dict[str, list[Any]]:
    """Return the sums of values over each group, or of layers of the first hit those of the first ray."""
    import drjit as dr
    import mitsuba as mi

    hits = {name for name in values if name in TABLE and TABLE[name].source == FIRST_HIT}
    if mi.variant().startswith("scalar"):

        def first(plane: Any) -> Any:
            return plane[:: groups.size]

        def summed(plane: Any) -> Any:
            return plane.reshape(-1, groups.size).sum(1)
    else:
        size = constants(size=groups.size)["size"]
        group, rest = size.divide(dr.arange(mi.UInt32, len(groups) * groups.size))

        def first(plane: Any) -> Any:
            target = dr.zeros(mi.Float, len(groups))
            dr.scatter(target, plane, group, rest == 0, mode=dr.ReduceMode.Permute)
            return target

        def summed(plane: Any) -> Any:
            return dr.block_reduce(dr.ReduceOp.Add, plane, groups.size)

    found = {**values, **{name: list(map(first, values[name])) for name in hits}}
    dr.eval(found)  # block_reduce would evaluate each plane by itself, in a kernel of its own
    return {
        name: list(planes) if name in hits else list(map(summed, planes)) for name, planes in found.items()
    }
