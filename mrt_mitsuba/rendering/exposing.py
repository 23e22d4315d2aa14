"""Exposing a film: tracing groups of rays in chosen pixels, and what their values add up to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from mrt_mitsuba.memory import Workspace
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.divisor import Divisor
from mrt_mitsuba.rays.film import Canvas, Film, Numbers
from mrt_mitsuba.rays.sampler import ray_sampler
from mrt_mitsuba.rays.sequence import pixel_sequence
from mrt_mitsuba.records import dataclass
from mrt_mitsuba.rendering.shading import Shader, components
from mrt_mitsuba.rendering.view import View


@dataclass(frozen=True)
class Groups:
    """Groups of ``size`` rays, each in one pixel of one of the pictures that are exposed at once."""

    size: int
    pixels: np.ndarray  #: [groups] uint32, as the film numbers them
    pictures: np.ndarray  #: [groups] uint32
    weights: np.ndarray  #: [groups] float32, of each ray
    first: np.ndarray  #: [groups] uint32, number of the first ray in its pixel of its picture

    @classmethod
    def uniform(cls, pixels: np.ndarray, size: int) -> Groups:
        """Return one group in each pixel, of a single picture."""
        zeros = np.zeros(len(pixels), np.uint32)
        return cls(size, pixels.astype(np.uint32), zeros, np.ones(len(pixels), np.float32), zeros)

    @classmethod
    def spread(cls, size: int, counts: np.ndarray, before: np.ndarray) -> Groups:
        """Return ``counts`` groups in each picture and pixel, [pictures, pixels], after ``before`` rays.

        The rays of a pixel have a weight of 1 in all, so that pixels count alike whatever they are given.
        """
        pictures, pixels = np.nonzero(counts)
        repeats = counts[pictures, pixels]
        number = np.arange(repeats.sum()) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        return cls(
            size,
            np.repeat(pixels, repeats).astype(np.uint32),
            np.repeat(pictures, repeats).astype(np.uint32),
            np.repeat(1 / (repeats * size), repeats).astype(np.float32),
            (np.repeat(before[pictures, pixels], repeats) + number * size).astype(np.uint32),
        )

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def most(self) -> int:
        """The most rays that start in a pixel of a picture."""
        place = np.flatnonzero(np.diff(self.pixels, prepend=-1) | np.diff(self.pictures, prepend=-1))
        return self.size * int(np.diff(place, append=len(self)).max())

    def part(self, start: int, stop: int) -> Groups:
        """Return the groups ``start`` to ``stop − 1``."""
        return Groups(
            self.size, *(a[start:stop] for a in (self.pixels, self.pictures, self.weights, self.first))
        )


@dataclass(frozen=True)
class Exposed:
    """The sums over the rays of one exposure."""

    sums: np.ndarray  #: [pictures, H, W, channels]: filtered values times their weights
    weights: np.ndarray  #: [pictures, H, W]: filtered weights
    rays: np.ndarray  #: [pictures, pixels]: how many started there
    total: np.ndarray  #: [pictures, pixels, 3]: of the colours of those; empty where not asked for
    square: np.ndarray  #: [pictures, pixels, 3]: of their squares


class Stack:
    """Pictures in the making, exposure upon exposure.

    An exposure may leave pixels out. It counts in proportion to the independent rays that it brings to a
    pixel, and only where none is missing under the filter; the rays of a pixel have the same weight in all.
    """

    def __init__(self, film: Film, pictures: int, channels: int) -> None:
        self.film = film
        self.rays = np.zeros((pictures, film.pixels))
        self._sums = np.zeros((pictures, *film.shape, channels), np.float32)
        self._weights, self._amount = np.zeros((2, pictures, *film.shape), np.float32)

    def widened(self, groups: np.ndarray) -> np.ndarray:
        """Return numbers of groups [pictures, pixels], one at least wherever the filter reaches from."""
        if not self.film.reach:
            return groups
        near = box_mean(self.rows(groups) > 0, self.film.reach, (1, 2)) > 0
        return np.maximum(groups, near.reshape(groups.shape))

    def add(self, exposed: Exposed, chosen: np.ndarray) -> None:
        """Add an exposure that was made for the ``chosen`` pixels [pictures, pixels]."""
        each = np.where(exposed.rays > 0, 1 / np.maximum(exposed.rays, 1), 1.0)
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


def _divided(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sums [..., channels] over weights [...], as Mitsuba's films divide them."""
    return np.asarray(sums / np.where(weights == 0, 1, weights)[..., None])


def box_mean(values: np.ndarray, reach: int, axes: tuple[int, ...] = (0, 1)) -> np.ndarray:
    """Return the means over windows of 2 reach + 1 values along axes, cut at the border."""
    for axis in axes:
        sums = np.moveaxis(np.cumsum(values, axis, dtype=np.float64), axis, 0)
        place = np.arange(len(sums))
        last, before = np.minimum(place + reach, len(sums) - 1), np.maximum(place - reach - 1, -1)
        means = sums[last]
        means[reach + 1 :] -= sums[: max(len(sums) - reach - 1, 0)]
        means /= (last - before).reshape(-1, *([1] * (sums.ndim - 1)))
        values = np.moveaxis(means, 0, axis)
    return values


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
        film = self.film
        canvas = Canvas(film, pictures, len(self.names) + 1) if film.reach else None
        kept = len(self.names) if canvas is None else 3 * moments
        total = np.zeros((kept + 3 * moments, pictures * film.pixels))
        pixel = groups.pictures.astype(np.int64) * film.pixels + groups.pixels  # ascending
        step = max(1, self.workspace.rays_at_once(2 * len(self.names)) // groups.size)
        for start in range(0, len(pixel), step):
            part, own = groups.part(start, start + step), pixel[start : start + step]
            planes = self._wavefront(part, _Start(seed, start, progressive), canvas, kept, moments)
            starts = np.flatnonzero(np.diff(own, prepend=-1))  # of the groups of each pixel
            for row, plane in zip(total, planes, strict=False):
                plane = np.broadcast_to(plane, own.shape)
                row[own[starts]] += np.add.reduceat(plane, starts, dtype=np.float64)
            self._count("primary", len(own) * groups.size)
            for kind, plane in zip(self._counted.values(), planes[len(total) :], strict=True):
                self._count(kind, round(np.sum(np.asarray(plane), dtype=np.float64)))
            advance(len(own) * groups.size)
        rays = groups.size * np.bincount(pixel, minlength=pictures * film.pixels)
        rays = rays.reshape(pictures, film.pixels)
        totals = np.moveaxis(total.reshape(-1, pictures, film.pixels), 0, -1)
        if canvas is None:
            means = totals[..., :kept] / np.maximum(rays, 1)[..., None]
            sums = np.concatenate([means, rays[..., None] > 0], axis=-1).reshape(pictures, *film.shape, -1)
        else:
            sums = canvas.sums
        return Exposed(sums[..., :-1], sums[..., -1], rays, totals[..., :3], totals[..., kept:])

    @property
    def _counted(self) -> dict[str, str]:
        """The layers that count rays, and of which kind."""
        return {name: TABLE[name].counts for name in self.layers if TABLE[name].counts}

    def _count(self, kind: str, number: int) -> None:
        self.rays[kind] = self.rays.get(kind, 0) + number

    def _wavefront(
        self, groups: Groups, start: _Start, canvas: Canvas | None, kept: int, moments: bool
    ) -> list[Any]:
        """Trace a wavefront onto the canvas; return sums over each group of the first ``kept`` channels, of
        squared colours, and of numbers of rays."""
        import drjit as dr

        data = _Data.of(groups, start.seed, self.film)
        form = groups.size, len(groups), kept, moments, self.film.form, *self.names

        def trace() -> list[Any]:
            return self._trace(groups, self._lanes(groups, data, start), data, canvas, kept, moments)

        # numbered rays of a film without a canvas, which would be written to
        known = canvas is None and not start.progressive and self._independent and self.film.form is not None
        sums = self.shader.replayed(self.view, form, self.layers, data, trace) if known else trace()
        dr.eval(sums)
        return sums

    @property
    def _independent(self) -> bool:
        return bool(self.film.sensor.sampler().class_name() == "IndependentSampler")

    def _lanes(self, groups: Groups, data: _Data, start: _Start) -> _Lanes:
        """Return the rays of a wavefront."""
        import drjit as dr
        import mitsuba as mi

        rays = len(groups) * groups.size
        group, number = data.group.divide(dr.arange(mi.UInt32, rays))
        pixel = dr.gather(mi.UInt32, data.pixels, group)
        picture = dr.gather(mi.UInt32, data.pictures, group)
        if start.progressive:
            sampler = pixel_sequence()
            first = dr.gather(mi.UInt32, mi.UInt32(groups.first), group)
            key = pixel + picture * dr.opaque(mi.UInt32, self.film.pixels)
            sampler.start(first + number, mi.sample_tea_32(key, data.seed)[0])
        elif self._independent:
            sampler = ray_sampler()
            # numbered as Mitsuba numbers the rays of a whole picture
            number = mi.UInt64(pixel) * data.size + mi.UInt64(number)
            sampler.start_at(data.seed, number)
        else:
            sampler = self.film.sensor.sampler().clone()
            sampler.set_sample_count(groups.size)
            sampler.set_samples_per_wavefront(groups.size)
            sampler.seed((start.seed + start.before) % 2**32, rays)
        return _Lanes(group, pixel, picture, sampler)

    def _trace(
        self,
        groups: Groups,
        lanes: _Lanes,
        data: _Data,
        canvas: Canvas | None,
        kept: int,
        moments: bool,
    ) -> list[Any]:
        import drjit as dr
        import mitsuba as mi

        place, ray, weight = self.film.rays(lanes.pixel, lanes.sampler, data.film)
        if self.view.motion is not None:
            ray = self.view.moved(ray, lanes.sampler.next_1d())
        values = self.shader.values(self.view, ray, weight, lanes.sampler)
        channels = [mi.Float(c) for c in self.film.toned(values.image)]
        if self.film.alpha:
            channels.append(dr.select(values.valid, mi.Float(1), 0))
        if self.film.bands:
            channels += self.film.banded(values.spectrum, ray.wavelengths)
        channels += values.aovs
        layers = {name: TABLE[name].value(values) for name in self.layers}
        channels += [mi.Float(c) for value in layers.values() for c in components(value)]
        planes = channels[:kept] + [c * c for c in channels[: 3 * moments]]
        planes += [mi.Float(layers[name]) for name in self._counted]
        if canvas is not None:
            share = dr.gather(mi.Float, mi.Float(groups.weights), lanes.group)
            weighted = [*(c * share for c in channels), share]
            dr.eval(planes, place, lanes.picture, weighted)
            canvas.put(place, lanes.picture, weighted, groups.most)
        else:
            dr.eval(planes)  # block_reduce would evaluate each plane by itself, in a kernel of its own
        return [dr.block_reduce(dr.ReduceOp.Add, plane, groups.size) for plane in planes]


@dataclass(frozen=True)
class _Start:
    """Where the random numbers of a wavefront begin."""

    seed: int
    before: int  #: groups that were traced already
    progressive: bool  #: continue the sequences of the pixels


@dataclass(frozen=True)
class _Data:
    """The groups of a wavefront and the film as the kernel has them: a PyTree of its data."""

    pixels: Any
    pictures: Any
    seed: Any
    group: Divisor  #: size of a group, to divide by
    size: Any  #: of a group
    film: Numbers

    @classmethod
    def of(cls, groups: Groups, seed: int, film: Film) -> _Data:
        """Return the data of some groups."""
        import mitsuba as mi

        pixels, pictures = mi.UInt32(groups.pixels), mi.UInt32(groups.pictures)
        return cls(pixels, pictures, *_opaque(seed, groups.size, mi.variant()), film.numbers())


@lru_cache(maxsize=64)
def _opaque(seed: int, size: int, variant: str) -> tuple[Any, Divisor, Any]:
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(mi.UInt32, seed), Divisor.opaque(size), dr.opaque(mi.UInt64, size)


@dataclass(frozen=True)
class _Lanes:
    """The rays of a wavefront before they are rays."""

    group: Any  #: number of their group
    pixel: Any  #: where they start
    picture: Any  #: to which they belong
    sampler: Any  #: that serves them
