"""Bundles: which samples of which pixels to trace, and where each of their rays starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from mrt_mitsuba.rays.divisor import Divisor
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
        whole = start == 0 and stop == len(self.pixels)
        return self if whole else replace(self, pixels=self.pixels[start:stop])

    def numbers(self, width: int, height: int) -> Numbers:
        """Return the data of ``placed``: the size of the picture, and the pixels."""
        import mitsuba as mi

        first = self.pixels.start if isinstance(self.pixels, range) else 0
        numbers = _opaque_numbers(replace(self, pixels=first), width, height, mi.variant())
        return numbers if isinstance(self.pixels, range) else replace(numbers, pixels=mi.UInt32(self.pixels))

    def placed(self, numbers: Numbers) -> Samples:
        """Return where every ray of the bundle starts, from its ``numbers``. Vectorised variants only."""
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
        numbers = self.numbers_by(width, height, lambda kind, value: kind(value), Divisor)
        for lane in range(self.ray_count):
            order, rest = divmod(lane, self.rays_per_pixel)
            yield self._samples(order, int(self.pixels[order]), rest, numbers)

    def numbers_by(
        self, width: int, height: int, number: Number, divisor: Callable[[int], Divisor]
    ) -> Numbers:
        """Return the data of ``placed``, made by ``number(type, value)`` and ``divisor(value)``."""
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
            pixels=number(mi.UInt32, self.pixels) if isinstance(self.pixels, int) else None,
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


@lru_cache(maxsize=64)  # of bundles without their pixels, of which a number says where they begin
def _opaque_numbers(bundle: Bundle, width: int, height: int, variant: str) -> Numbers:
    import drjit as dr

    return bundle.numbers_by(width, height, dr.opaque, Divisor.opaque)


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
