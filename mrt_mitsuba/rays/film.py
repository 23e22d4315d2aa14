"""Where and when rays start, by a lattice or a film's rules, and how a film turns values into a picture."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

STEPS = 32  # of a pixel, where integrals over a filter are summed


def opaque(number: float) -> Any:
    """Return a number as data of a kernel, so that another needs no other kernel."""
    variant = mi.variant()
    if variant.startswith("scalar"):
        return number
    return _data(variant, "UInt32" if isinstance(number, int) else "Float", number)


def divide(n: Any, divisor: int) -> tuple[Any, Any]:
    """Return quotient and remainder of whole numbers below 2³².

    A processor divides the integers of a packet one after the other, which takes as long as tracing the ray;
    so vectorised variants multiply by the inverse in double precision. The half added keeps n/d away from
    whole numbers by 1/(2 d), and rounding moves it by less than n/d / 2⁵² < 1/(2 d).
    """
    variant = mi.variant()
    if variant.startswith("scalar"):
        return divmod(n, divisor)
    quotient = mi.UInt32((mi.Float64(n) + 0.5) * _data(variant, "Float64", 1 / divisor))
    return quotient, n - quotient * _data(variant, "UInt32", divisor)


_data = lru_cache(maxsize=64)(lambda variant, kind, number: dr.opaque(getattr(mi, kind), number))


class Region(NamedTuple):
    """The pixels in columns from ``x`` on and rows from ``y`` on, counted from the top."""

    x: int
    y: int
    width: int
    height: int

    def grown(self, reach: int, width: int, height: int) -> Region:
        """Return the region with so many pixels around it, as far as the picture goes."""
        left, top = max(self.x - reach, 0), max(self.y - reach, 0)
        right, bottom = min(self.x + self.width + reach, width), min(self.y + self.height + reach, height)
        return Region(left, top, right - left, bottom - top)

    def inside(self, other: Region) -> tuple[slice, slice]:
        """Return its rows and columns in an array of another region's pixels."""
        top, left = self.y - other.y, self.x - other.x
        return slice(top, top + self.height), slice(left, left + self.width)


@dataclass(frozen=True)
class Places:
    """Samples ``first`` to ``first + count − 1`` in each pixel, each traced ``repeats`` times.

    They lie on a lattice of aa × aa. ``report``: sample (i, j) is at (0.5 + i/aa, 0.5 + j/aa), y upwards, as
    in the original. Sample 0 is the pixel's centre and the others reach into the next pixels, which shifts
    the picture by up to half a pixel. ``centered``: samples are the centres of aa × aa equal cells. ``film``:
    no grid, but as many places that the sampler of a scene draws, see ``Film``.

    The shutter is open from time 0 to 1, which is divided into ``moments`` equal parts; successive rays of a
    pixel go to different parts, far from each other, so that place and time do not correlate. ``phase`` says
    where in its part a ray is, 0 to 1. None stands for a random place, the same for all rays of a pixel and
    another for the next pixel, which turns steps into noise.
    """

    lattice: str = "report"
    aa: int = 1  #: of the report's lattice, the pixel's centre alone
    first: int = 0
    count: int = 1
    repeats: int = 1
    moments: int = 0  #: 0: all rays start at time 0
    phase: float | None = 0.0
    seed: int = 0  #: of random phases

    @property
    def size(self) -> int:
        """Number of rays of a pixel."""
        return self.count * self.repeats

    @property
    def holds_centre(self) -> bool:
        """Return whether the pixel's centre is one of the lattice's samples; it then comes first."""
        return self.lattice == "report" or (self.lattice == "centered" and self.aa % 2 == 1)

    def at(self, pixel: Any, ray: Any, width: int, height: int) -> tuple[Any, Any]:
        """Return where and when a ray of a pixel starts: its place in a picture of this size, [0, 1]², x to
        the right and y down, and its time."""
        row, column = divide(pixel, width)
        sample = divide(ray, self.repeats)[0] + opaque(self.first)
        if self.lattice == "centered" and self.holds_centre:
            # start from the middle one, so that sample 0 is the centre
            sample = (sample + self.aa**2 // 2) % self.aa**2
        i, j = (mi.Float(number) for number in divide(sample, self.aa))
        n = mi.Float(opaque(self.aa))
        x, y = (0.5 + i / n, 0.5 - j / n) if self.lattice == "report" else ((i + 0.5) / n, (j + 0.5) / n)
        size = mi.Float(opaque(width)), mi.Float(opaque(height))
        place = mi.Point2f((mi.Float(column) + x) / size[0], (mi.Float(row) + y) / size[1])
        if not self.moments:
            return place, mi.Float(0)
        phase = (
            mi.sample_tea_float32(pixel, opaque(self.seed))
            if self.phase is None
            else opaque(float(self.phase))
        )
        # from one ray to the next, so many parts: coprime to their number, near its golden section
        golden = max(round(self.moments * (math.sqrt(5) - 1) / 2), 1)
        stride = next(s for s in range(golden, self.moments + 2) if math.gcd(s, self.moments) <= 1)
        part = mi.UInt64(ray) * mi.UInt64(opaque(stride)) % mi.UInt64(opaque(self.moments))
        return place, (mi.Float(part) + phase) / mi.Float(mi.UInt64(opaque(self.moments)))


class Film:
    """The film of a sensor, as Mitsuba would expose it.

    Pixels are numbered row by row, with the border that it samples around the picture.
    """

    def __init__(self, sensor: Any) -> None:
        film, sampler = sensor.film(), sensor.sampler()
        rfilter, found = film.rfilter(), re.search(r"pixel_format = (\w+)", str(film))
        self.sensor = sensor
        #: pixels on either side to which a ray contributes
        self.reach = 0 if rfilter.is_box_filter() else int(rfilter.border_size())
        #: pixels that are sampled around the picture, and are no part of it
        self.border = int(rfilter.border_size()) if film.sample_border() else 0
        self.width, self.height = (int(n) + 2 * self.border for n in film.crop_size())  # with the border
        self.shape, self.pixels = (self.height, self.width), self.height * self.width
        #: as the film prints it, "rgb" or "ya"; "" for a film of another kind
        self.pixel_format = found[1] if found else ""
        self.grey = self.pixel_format in ("luminance", "y", "ya")
        self.alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)  #: does it keep the coverage
        self.bands: tuple[str, ...] = ()  #: names of its spectral bands, if it has such
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            film.prepare([])  # it knows its channels from then on
            self.bands = tuple(field.name for field in film.bitmap().struct_())
        self.rays = int(sampler.sample_count())  #: of a pixel, as the scene's sampler has them
        self.sampler, self.rfilter = sampler.class_name(), rfilter.class_name()

    def picture(self, sampled: np.ndarray) -> np.ndarray:
        """Return what lies in the picture, of an array [..., rows, columns, channels]."""
        rows, columns = (slice(self.border, n - self.border) for n in self.shape)
        return sampled[..., rows, columns, :]

    def rays_near(self, count: int) -> int:
        """Return the number of rays a pixel that the scene's sampler makes of a number."""
        sampler = self.sensor.sampler().clone()
        sampler.set_sample_count(count)
        return int(sampler.sample_count())

    def place(self, pixel: Any, sampler: Any) -> tuple[Any, Any]:
        """Return places in pixels that a sampler draws: on the film, and in the picture, [0, 1]²."""
        border = float(self.border)
        size = mi.Vector2f(opaque(self.width - 2 * border), opaque(self.height - 2 * border))
        row, column = divide(pixel, self.width)
        place = mi.Point2f(mi.Float(column), mi.Float(row)) + sampler.next_2d()
        return place, (place - opaque(border)) / size

    @cached_property
    def weights(self) -> np.ndarray:
        """Values of the filter along an axis, ``STEPS`` to a pixel, [2 reach + 1, STEPS]."""
        places = np.arange(-self.reach, self.reach + 1)[:, None] + (np.arange(STEPS) + 0.5) / STEPS - 0.5
        rfilter, flat = self.sensor.film().rfilter(), places.ravel().tolist()
        if mi.variant().startswith("scalar"):
            values = [rfilter.eval(place) for place in flat]
        else:  # a list is copied; for NumPy's memory, Dr.Jit would compile a kernel for every alignment
            values = rfilter.eval(mi.Float(flat))
        return np.asarray(values, np.float64).reshape(places.shape)

    @property
    def correlation(self) -> float:
        """Sum of the squared correlations of a pixel's error with those of all pixels, itself included."""
        values = self.weights.ravel()
        overlap = np.correlate(values, values, "full")[(len(values) - 1) % STEPS :: STEPS]
        return float(np.sum(np.square(overlap / overlap.max()))) ** 2

    @property
    def averaging(self) -> float:
        """Variance of a pixel over that of the mean of the rays that start in it."""
        along = np.square(self.weights).mean() / np.square(self.weights.mean())
        return float(along / len(self.weights)) ** 2

    def spread_out(self, variance: np.ndarray) -> np.ndarray:
        """Return the variance [..., H, W] of pixels, up to a factor, given that of the rays in each."""
        share = np.square(self.weights).sum(axis=1)
        share = np.float32(share / share.sum())
        for axis in (-2, -1) if self.reach else ():
            padding = [(0, 0)] * variance.ndim
            padding[axis] = (self.reach, self.reach)
            wide = sliding_window_view(np.pad(variance, padding, mode="edge"), len(share), axis)
            pairs = ((wide[..., k] + wide[..., -1 - k]) * share[k] for k in range(self.reach))  # symmetric
            variance = sum(pairs, share[self.reach] * wide[..., self.reach])
        return variance


class Canvas:
    """Sums of filtered values over the pixels of some pictures; the rays of a pixel weigh 1 in all.

    Rays lie in memory by the pixel in which they start, so those that reach a pixel from one row are
    neighbours there: each pixel adds them up by itself, in the same order every time. Sums along a row are
    formed in single precision, those of rows in double, so that pictures are the same wherever wavefronts are
    cut between rows.

    ``sums`` [pictures, H, W, channels] has filtered values times their weights, ``weights`` [pictures, H, W]
    these. With ``moments``, ``total`` and ``square`` [pictures, H, W, 3] have the colours of the rays in each
    pixel and their squares, unfiltered, and ``peak`` [pictures, H, W, 1] the mean colour of the brightest.
    """

    def __init__(self, film: Film, rays: np.ndarray, channels: int, *, moments: bool) -> None:
        """Take up values of so many channels of so many rays in each pixel, [pictures, pixels]."""
        self.rays, self._film = rays, film
        self._share = np.float32(1 / np.maximum(rays, 1)).ravel()
        self._sums, self._moments = np.zeros((channels + 1, rays.size)), np.zeros((7 * moments, rays.size))
        sums, found = (
            np.moveaxis(planes.reshape(-1, len(rays), *film.shape), 0, -1)
            for planes in (self._sums, self._moments)
        )
        self.sums, self.weights = sums[..., :-1], sums[..., -1]
        self.total, self.square, self.peak = np.split(found, [3, 6], axis=-1)

    def put(self, place: Any, values: Sequence[Any], pixels: np.ndarray, size: int) -> None:
        """Add the values of rays, [channels] each, colours first, at their places on the film.

        ``pixels``: where ``size`` rays each start, ascending; those of the second picture follow on those of
        the first.
        """
        if isinstance(place, np.ndarray):
            self._put_one_by_one(place, np.asarray(values), np.repeat(pixels.astype(np.int64), size))
            return
        counts = size * np.bincount(pixels + 1, minlength=len(self._share) + 1)
        first = mi.UInt32(np.cumsum(counts, dtype=np.uint32))  # of each pixel, the number of its first ray
        reach, width = self._film.reach, self._film.width
        low = max(int(pixels[0]) // width - reach, 0) * width
        high = min((int(pixels[-1]) // width + reach + 1) * width, len(self._share))
        pixel = dr.arange(mi.UInt32, high - low) + dr.opaque(mi.UInt32, low)
        if len(self._moments):
            more = _moments(
                values[:3], dr.gather(mi.UInt32, first, pixel), dr.gather(mi.UInt32, first, pixel + 1)
            )
            dr.eval(more)
            for index, found in enumerate(more):
                known = self._moments[index, low:high]
                (np.add if index < 6 else np.maximum)(known, np.asarray(found), out=known)
        sums = self._near(place, values, (mi.Float(self._share[pixels]), size), first, pixel)
        dr.eval(sums)
        for total, found in zip(self._sums, sums, strict=True):
            total[low:high] += np.asarray(found)

    def _near(
        self, place: Any, values: Sequence[Any], share: tuple[Any, int], first: Any, pixel: Any
    ) -> list[Any]:
        """Return what rays give to these pixels; ``share``: of each so many in theirs."""
        film, rfilter, reach = self._film, self._film.sensor.film().rfilter(), opaque(self._film.reach)
        line, column = divide(pixel, film.width)
        row = divide(line, film.height)[1]
        left, right = dr.maximum(column, reach) - reach, dr.minimum(column + reach + 1, opaque(film.width))
        top, bottom = dr.maximum(row, reach) - reach, dr.minimum(row + reach + 1, opaque(film.height))
        centre = mi.Point2f(mi.Float(column), mi.Float(row)) + 0.5

        def add_ray(ray: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            weight = dr.gather(mi.Float, share[0], divide(ray, share[1])[0])
            if film.reach:
                weight *= rfilter.eval(centre.x - dr.gather(mi.Float, place.x, ray))
                weight *= rfilter.eval(centre.y - dr.gather(mi.Float, place.y, ray))
            found = [*(dr.gather(mi.Float, value, ray) for value in values), 1]
            return ray + 1, [a + weight * b for a, b in zip(sums, found, strict=True)]

        def add_row(at: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            begin = (line + at - row) * opaque(film.width)
            last = dr.gather(mi.UInt32, first, begin + right)
            state = dr.gather(mi.UInt32, first, begin + left), [mi.Float(0)] * (len(values) + 1)
            _, found = dr.while_loop(state, lambda ray, _: ray < last, add_ray)
            return at + 1, [a + mi.Float64(b) for a, b in zip(sums, found, strict=True)]

        state = top, [mi.Float64(0)] * (len(values) + 1)
        return list(dr.while_loop(state, lambda at, _: at < bottom, add_row)[1])

    def _put_one_by_one(self, place: np.ndarray, values: np.ndarray, pixels: np.ndarray) -> None:
        """Add values [channels, rays] at places [2, rays], of rays that start in these pixels."""
        film, evaluate = self._film, self._film.sensor.film().rfilter().eval
        if len(self._moments):
            colors = values[:3]
            for plane, value in zip(self._moments, [*colors, *colors**2], strict=False):
                np.add.at(plane, pixels, value)
            np.maximum.at(self._moments[6], pixels, colors.mean(0))
        line, column = np.divmod(pixels, film.width)
        away = (place - np.stack([column, line % film.height]) - 0.5).T.tolist()
        given = np.stack([*values, np.ones(len(pixels))]) * self._share[pixels]
        for down in range(-film.reach, film.reach + 1):
            for across in range(-film.reach, film.reach + 1):
                weight = np.array(
                    [evaluate(across - x) * evaluate(down - y) if film.reach else 1.0 for x, y in away]
                )
                row, there = line % film.height + down, column + across
                inside = (row >= 0) & (row < film.height) & (there >= 0) & (there < film.width)
                at = (pixels + down * film.width + across)[inside]
                for plane, value in zip(self._sums, given, strict=True):
                    np.add.at(plane, at, (value * weight)[inside])


def _moments(values: Sequence[Any], first: Any, last: Any) -> list[Any]:
    """Return sums over runs of rays of their values, those of their squares, and the largest mean of a ray's
    values, or 0."""

    def add(ray: Any, sums: list[Any], most: Any) -> tuple[Any, list[Any], Any]:
        found = [dr.gather(mi.Float, value, ray) for value in values]
        sums = [a + b for a, b in zip(sums, [*found, *(value * value for value in found)], strict=True)]
        return ray + 1, sums, dr.maximum(most, sum(found) / len(found))

    state = first, [mi.Float(0)] * (2 * len(values)), mi.Float(0)
    _, sums, most = dr.while_loop(state, lambda ray, *_: ray < last, add)
    return [*sums, most]
