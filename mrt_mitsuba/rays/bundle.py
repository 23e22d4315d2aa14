"""Bundles: which samples of which pixels to trace, and where each of their rays starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from mrt_mitsuba.rays.divisor import Divisor, opaque
from mrt_mitsuba.rays.lattice import Lattice
from mrt_mitsuba.rays.shutter import Number, Shutter


@dataclass(frozen=True)
class Bundle:
    """Samples ``first`` to ``first + count - 1`` of some pixels, each traced ``repeats`` times.

    ``pixels``: indices into the picture, row by row from the top, as an array; or a range, for which no
    indices are stored. The rays of a pixel lie side by side.
    """

    pixels: Any
    lattice: Lattice
    first: int = 0
    count: int = 1
    repeats: int = 1
    shutter: Shutter | None = None  # None: all at time 0

    @property
    def rays_per_pixel(self) -> int:
        """Number of rays of each pixel."""
        return self.count * self.repeats

    @property
    def ray_count(self) -> int:
        """Number of all rays."""
        return len(self.pixels) * self.rays_per_pixel

    def part(self, start: int, stop: int) -> Bundle:
        """Return the bundle of the pixels ``start`` to ``stop − 1``."""
        return replace(self, pixels=self.pixels[start:stop])

    @property
    def form(self) -> tuple[Any, ...]:
        """What shapes the code of ``samples``; all else is data."""
        phase = None if self.shutter is None else self.shutter.phase is None
        return self.lattice, self.ray_count, self.rays_per_pixel, isinstance(self.pixels, range), phase

    def numbers(self, width: int, height: int) -> Numbers:
        """Return the data of ``samples``: another picture size needs no other kernel."""
        import mitsuba as mi

        first = isinstance(self.pixels, range)
        pixels = opaque(mi.UInt32, self.pixels.start) if first else mi.UInt32(self.pixels)
        return self._numbers(width, height, opaque, Divisor.opaque, pixels)

    def samples(self, numbers: Numbers) -> Samples:
        """Return where every ray of the bundle starts. Vectorised variants only."""
        import drjit as dr
        import mitsuba as mi

        lane = dr.arange(mi.UInt32, self.ray_count)
        order, rest = numbers.rays.divide(lane)
        if isinstance(self.pixels, range):
            pixel = order + numbers.pixels
        else:
            pixel = dr.gather(mi.UInt32, numbers.pixels, order)
        return self._samples(order, pixel, rest, numbers)

    def each_sample(self, width: int, height: int) -> Iterator[Samples]:
        """Yield the same, one ray at a time, for scalar variants."""
        numbers = self._numbers(width, height, lambda kind, value: kind(value), Divisor, None)
        for lane in range(self.ray_count):
            order, rest = divmod(lane, self.rays_per_pixel)
            yield self._samples(order, int(self.pixels[order]), rest, numbers)

    def _numbers(
        self, width: int, height: int, number: Number, divisor: Callable[[int], Divisor], pixels: Any
    ) -> Numbers:
        import mitsuba as mi

        return Numbers(
            width=divisor(width),
            height=number(mi.UInt32, height),
            repeats=divisor(self.repeats),
            first=number(mi.UInt32, self.first),
            rays=divisor(self.rays_per_pixel),
            rays_per_pixel=number(mi.UInt64, self.rays_per_pixel),
            share=number(mi.Float, 1 / self.rays_per_pixel),
            aa=divisor(self.lattice.aa),
            shutter=self.shutter.numbers(number) if self.shutter else (),
            pixels=pixels,
        )

    def _samples(self, order: Any, pixel: Any, rest: Any, numbers: Numbers) -> Samples:
        import mitsuba as mi

        row, column = numbers.width.divide(pixel)
        x, y = self.lattice.offset(numbers.repeats.divide(rest)[0] + numbers.first, numbers.aa)
        place = mi.Point2f(
            (mi.Float(column) + x) / mi.Float(numbers.width.number),
            (mi.Float(row) + y) / mi.Float(numbers.height),
        )
        time = self.shutter.time(rest, pixel, *numbers.shutter) if self.shutter else mi.Float(0)
        number = mi.UInt64(pixel) * numbers.rays_per_pixel + mi.UInt64(rest)
        return Samples(number=number, order=order, is_first=rest == 0, place=place, time=time)


@dataclass(frozen=True)
class Numbers:
    """The sizes of picture and bundle, and the pixels, as the kernel has them: a PyTree of its data."""

    width: Divisor
    height: Any
    repeats: Divisor
    first: Any
    rays: Divisor  #: rays_per_pixel to divide by
    rays_per_pixel: Any
    share: Any  #: of a ray in the mean of its pixel
    aa: Divisor
    shutter: tuple[Any, ...]
    pixels: Any  #: indices, or the first of a range


@dataclass(frozen=True)
class Samples:
    """Where rays of a bundle start: one ray, or arrays of them."""

    number: Any  #: of the ray, among as many of each pixel of the picture
    order: Any  #: place of its pixel in the bundle
    is_first: Any  #: is it the first ray of its pixel
    place: Any  #: on the film, x to the right, y down; the picture is [0, 1]²
    time: Any  #: from 0, when the shutter opens, to 1
