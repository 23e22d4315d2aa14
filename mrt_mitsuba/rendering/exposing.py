"""Exposing a film: tracing groups of rays in chosen pixels, and what their values add up to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from mrt_mitsuba.memory import Workspace
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.canvas import Canvas
from mrt_mitsuba.rays.divisor import Divisor
from mrt_mitsuba.rays.film import Film, Numbers
from mrt_mitsuba.rays.sampler import ray_sampler
from mrt_mitsuba.rays.sequence import pixel_sequence
from mrt_mitsuba.rendering.shading import Shader, components
from mrt_mitsuba.rendering.view import View
from mrt_mitsuba.rendering.windows import dilated


@dataclass(frozen=True)
class Groups:
    """Groups of ``size`` rays, some in each of some pixels.

    Pixels of a second picture are numbered after those of the first.
    """

    size: int
    pixels: np.ndarray  #: numbers of pixels, ascending
    counts: np.ndarray  #: groups in each
    first: np.ndarray  #: number of the first ray of each among all that the pixel gets in time

    @classmethod
    def uniform(cls, size: int, pixels: np.ndarray) -> Groups:
        """Return one group in each pixel, of a single picture."""
        return cls(size, pixels, np.ones_like(pixels), np.zeros_like(pixels))

    @classmethod
    def spread(cls, size: int, counts: np.ndarray, before: np.ndarray) -> Groups:
        """Return ``counts`` groups in each picture and pixel, [pictures, pixels], after ``before`` rays."""
        pixels = np.flatnonzero(counts)
        return cls(size, pixels, counts.ravel()[pixels], before.ravel()[pixels].astype(np.int64))

    def __len__(self) -> int:
        return int(self.counts.sum())

    @cached_property
    def _ends(self) -> np.ndarray:
        return np.cumsum(self.counts)

    @property
    def rays(self) -> np.ndarray:
        """Number of rays of each pixel."""
        return self.size * self.counts

    def part(self, start: int, stop: int) -> Groups:
        """Return the groups ``start`` to ``stop − 1``."""
        if start == 0 and stop >= len(self):
            return self
        stop = min(stop, len(self))
        run = slice(np.searchsorted(self._ends, start, "right"), np.searchsorted(self._ends, stop) + 1)
        begin = self._ends[run] - self.counts[run]
        low, high = np.maximum(begin, start), np.minimum(self._ends[run], stop)
        return Groups(self.size, self.pixels[run], high - low, self.first[run] + self.size * (low - begin))

    def cuts(self, most: int, width: int) -> list[int]:
        """Return where to cut into parts of no more than ``most`` groups: between rows where that can be."""
        if 0 < len(self) <= most:
            return [0, len(self)]
        ends = self._ends[np.diff(self.pixels // width, append=-1) != 0]  # of rows
        cuts = [0]
        while cuts[-1] < len(self):
            whole = ends[: np.searchsorted(ends, cuts[-1] + most, "right")]
            cuts.append(int(whole[-1]) if len(whole) and whole[-1] > cuts[-1] else cuts[-1] + most)
        return cuts

    @property
    def places(self) -> np.ndarray:
        """The place in ``pixels`` of each group."""
        return np.repeat(np.arange(len(self.pixels), dtype=np.uint32), self.counts)

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
    """A shader that exposes a film. ``rays`` counts what is traced, by kind."""

    shader: Shader
    film: Film
    view: View
    workspace: Workspace
    rays: dict[str, int]
    layers: Sequence[str] = ()  #: averaged layers to expose with the picture

    @property
    def names(self) -> tuple[str, ...]:
        """Channels of the picture: R, G, B, those that the film and the integrator have, and the layers'."""
        alpha = ("A",) if self.film.alpha else ()
        layers = [f"{name}.{letter}" for name in self.layers for letter in TABLE[name].letters]
        return ("R", "G", "B", *alpha, *self.film.bands, *self.shader.aovs, *layers)

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
        most = max(1, self.workspace.rays_at_once(2 * kept) // groups.size)
        for start, stop in pairwise(groups.cuts(most, film.width)):
            part = groups.part(start, stop)
            planes = self._wavefront(part, _Start(seed, start, progressive), canvas, moments)
            for row, plane in zip(total, planes, strict=False):
                row[part.pixels] = np.broadcast_to(plane, len(part))
            self._count("primary", len(part) * groups.size)
            for kind, plane in zip(self._counted.values(), planes[len(total) :], strict=True):
                self._count(kind, round(np.sum(np.asarray(plane), dtype=np.float64)))
            advance(len(part) * groups.size)
        if canvas is not None:
            sums, colors = canvas.sums, canvas.moments
        else:
            means = np.concatenate([total[:kept] / np.maximum(rays.ravel(), 1), rays.reshape(1, -1) > 0])
            found = np.concatenate([means, total[: 3 * moments], total[kept:]])
            sums, colors = np.split(channels_last(found.reshape(-1, pictures, *film.shape)), [kept + 1], -1)
        found = np.split(colors, [3, 6], axis=-1)
        return Exposed(sums[..., :-1], sums[..., -1], rays, *found)

    @property
    def _counted(self) -> dict[str, str]:
        """The layers that count rays, and of which kind."""
        return {name: TABLE[name].counts for name in self.layers if TABLE[name].counts}

    def _count(self, kind: str, number: int) -> None:
        self.rays[kind] = self.rays.get(kind, 0) + number

    def _wavefront(self, groups: Groups, start: _Start, canvas: Canvas | None, moments: bool) -> list[Any]:
        """Trace a wavefront onto a canvas; without one, return sums over each group of the channels and of
        squared colours. Return sums of numbers of rays after them."""
        import drjit as dr

        data = _Data.of(groups, start, self.film)
        place, channels, planes = self._trace(*self._lanes(groups, data, start), data)
        if canvas is None:
            planes = [*channels, *(c * c for c in channels[: 3 * moments]), *planes]
            dr.eval(planes)  # block_reduce would evaluate each plane by itself, in a kernel of its own
        else:
            dr.eval(place, channels, planes)
            canvas.put(place, channels, groups.pixels, groups.rays)
        sums = [dr.block_reduce(dr.ReduceOp.Add, plane, groups.size) for plane in planes]
        dr.eval(sums)
        return sums

    @property
    def _independent(self) -> bool:
        return bool(self.film.sensor.sampler().class_name() == "IndependentSampler")

    def _lanes(self, groups: Groups, data: _Data, start: _Start) -> tuple[Any, Any]:
        """Return the pixels of the rays of groups, and their sampler."""
        import drjit as dr
        import mitsuba as mi

        rays = len(groups) * data.each
        lane = dr.arange(mi.UInt32, rays)
        group, number = data.group.divide(lane)
        place = group if data.places is None else dr.gather(mi.UInt32, data.places, group)
        pixel = dr.gather(mi.UInt32, data.pixels, place)
        if start.progressive:
            sampler = pixel_sequence()
            number = lane + dr.gather(mi.UInt32, mi.UInt32(groups.offsets), place)
            sampler.start(number, mi.sample_tea_32(pixel, data.seed)[0])
            _, pixel = data.area.divide(pixel)
        elif self._independent:
            sampler = ray_sampler()
            # numbered as Mitsuba numbers the rays of a whole picture
            sampler.start_at(data.seed, mi.UInt64(pixel) * data.size + mi.UInt64(number))
        else:
            sampler = self.film.sensor.sampler().clone()
            sampler.set_sample_count(data.each)
            sampler.set_samples_per_wavefront(data.each)
            sampler.seed((start.seed + start.before) % 2**32, rays)
        return pixel, sampler

    def _trace(self, pixel: Any, sampler: Any, data: _Data) -> tuple[Any, list[Any], list[Any]]:
        """Return the places of rays on the film, the channels of their values, and numbers of rays."""
        import drjit as dr
        import mitsuba as mi

        place, ray, weight = self.film.rays(pixel, sampler, data.film)
        if self.view.motion is not None:
            ray = self.view.moved(ray, sampler.next_1d())
        values = self.shader.values(self.view, ray, weight, sampler)
        channels = [mi.Float(c) for c in self.film.toned(values.image)]
        if self.film.alpha:
            channels.append(dr.select(values.valid, mi.Float(1), 0))
        if self.film.bands:
            channels += self.film.banded(values.spectrum, ray.wavelengths)
        channels += values.aovs
        layers = {name: TABLE[name].value(values) for name in self.layers}
        channels += [mi.Float(c) for value in layers.values() for c in components(value)]
        return place, channels, [mi.Float(layers[name]) for name in self._counted]


@dataclass(frozen=True)
class _Start:
    """Where the random numbers of a wavefront begin."""

    seed: int
    before: int  #: groups that were traced already
    progressive: bool  #: continue the sequences of the pixels


@dataclass(frozen=True)
class _Data:
    """The groups of a wavefront and the film as the kernel has them: a PyTree of its data."""

    each: int  #: rays of a group
    places: Any  #: of the groups among the pixels; None where each pixel has one by plan
    pixels: Any
    seed: Any
    group: Divisor  #: rays of a group, to divide by
    size: Any  #: rays of a group
    area: Divisor  #: pixels of a picture
    film: Numbers

    @classmethod
    def of(cls, groups: Groups, start: _Start, film: Film) -> _Data:
        """Return the data of groups."""
        import mitsuba as mi

        variant = mi.variant()
        places = mi.UInt32(groups.places) if start.progressive else None
        group, wide = _size(groups.size, variant)
        area, _ = _size(film.pixels, variant)
        numbers = places, mi.UInt32(groups.pixels), _seed(start.seed, variant)
        return cls(groups.size, *numbers, group, wide, area, film.numbers())


@lru_cache(maxsize=64)
def _seed(seed: int, variant: str) -> Any:
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(mi.UInt32, seed)


@lru_cache(maxsize=64)
def _size(size: int, variant: str) -> tuple[Divisor, Any]:
    import drjit as dr
    import mitsuba as mi

    return Divisor.opaque(size), dr.opaque(mi.UInt64, size)
