"""Where in a pixel, and when, the samples lie."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

LATTICES = ("report", "centered")


@dataclass(frozen=True)
class Divisor:
    """A number to divide lane numbers by. As data of a kernel: another number needs no other kernel.

    A processor divides integers of a packet one after the other, which takes as long as tracing the ray; so
    vectorised variants multiply by the inverse in double precision. The half added keeps n/d away from whole
    numbers by 1/(2 d), and rounding moves it by less than n/d / 2⁵² < 1/(2 d) for all n < 2³².
    """

    number: Any
    inverse: Any = None

    @classmethod
    def opaque(cls, number: int) -> Divisor:
        """For vectorised variants."""
        import drjit as dr
        import mitsuba as mi

        return cls(dr.opaque(mi.UInt32, number), dr.opaque(mi.Float64, 1 / number))

    def divide(self, n: Any) -> tuple[Any, Any]:
        """Quotient and remainder."""
        import mitsuba as mi

        if self.inverse is None:
            return divmod(n, self.number)
        quotient = mi.UInt32((mi.Float64(n) + 0.5) * self.inverse)
        return quotient, n - quotient * self.number


@dataclass(frozen=True)
class Lattice:
    """A grid of aa × aa samples in a pixel.

    ``report``: sample (i, j) at (0.5 + i/aa, 0.5 + j/aa), y upwards, as in the original: sample 0 is the
    pixel's centre and the others reach into the next pixels, which shifts the picture by up to half a pixel.
    ``centered``: the middles of aa × aa equal cells.
    """

    kind: str
    aa: int

    @property
    def count(self) -> int:
        """Samples in a pixel."""
        return self.aa**2

    @property
    def holds_centre(self) -> bool:
        """Is the pixel's centre one of the samples? It then comes first."""
        return self.kind == "report" or self.aa % 2 == 1

    def offset(self, sample: Any, aa: Divisor) -> tuple[Any, Any]:
        """Place of sample number ``sample`` in its pixel as (x, y), y downwards."""
        import mitsuba as mi

        if self.kind == "centered" and self.holds_centre:
            # start from the middle one, so that sample 0 is the centre
            sample = (sample + self.count // 2) % self.count
        i, j = aa.divide(sample)
        n = mi.Float(aa.number)
        if self.kind == "report":
            return 0.5 + mi.Float(i) / n, 0.5 - mi.Float(j) / n
        return (mi.Float(i) + 0.5) / n, (mi.Float(j) + 0.5) / n


@dataclass(frozen=True)
class Shutter:
    """When the rays of a pixel are traced, the shutter being open from time 0 to 1.

    The time is divided into ``moments`` equal parts, and successive rays of a pixel go to different parts,
    far from each other, so that place and time do not go together. ``phase``: where in its part a ray is, 0
    to 1; None: at a random place, the same for all rays of a pixel and another for the next pixel, which
    turns steps into noise.
    """

    moments: int
    phase: float | None = None
    seed: int = 0

    @property
    def stride(self) -> int:
        """Parts from one ray to the next: without a common divisor, near the golden section of all."""
        golden = round(self.moments * (math.sqrt(5) - 1) / 2)
        return next(s for s in range(max(golden, 1), self.moments + 2) if math.gcd(s, self.moments) == 1)

    def time(self, rest: Any, pixel: Any, moments: Any, stride: Any, phase: Any) -> Any:
        """Of ray number ``rest`` of a pixel; the last three are the shutter's own, ``phase`` the seed where
        it is None."""
        import mitsuba as mi

        part = mi.UInt64(rest) * stride % moments
        if self.phase is None:
            phase = mi.sample_tea_float32(pixel, phase)
        return (mi.Float(part) + phase) / mi.Float(moments)


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
        return self.count * self.repeats

    @property
    def ray_count(self) -> int:
        return len(self.pixels) * self.rays_per_pixel

    def part(self, start: int, stop: int) -> Bundle:
        """The bundle of some of the pixels."""
        return replace(self, pixels=self.pixels[start:stop])

    def samples(self, width: int, height: int) -> Samples:
        """Where every ray of the bundle starts. Vectorised variants only."""
        import drjit as dr
        import mitsuba as mi

        lane = dr.arange(mi.UInt32, self.ray_count)
        order, rest = Divisor.opaque(self.rays_per_pixel).divide(lane)
        if isinstance(self.pixels, range):
            pixel = order + dr.opaque(mi.UInt32, self.pixels.start)
        else:
            pixel = dr.gather(mi.UInt32, mi.UInt32(self.pixels), order)
        # Sizes are data, not constants: another picture size needs no other kernel
        columns, repeats, aa = (Divisor.opaque(n) for n in (width, self.repeats, self.lattice.aa))
        rows, first = (dr.opaque(mi.UInt32, n) for n in (height, self.first))
        shutter = self._shutter_numbers(dr.opaque)
        return self._samples(lane, order, pixel, rest, columns, rows, repeats, first, aa, shutter)

    def each_sample(self, width: int, height: int) -> Iterator[Samples]:
        """The same, one ray at a time, for scalar variants."""
        shutter = self._shutter_numbers(lambda kind, value: kind(value))
        for lane in range(self.ray_count):
            order, rest = divmod(lane, self.rays_per_pixel)
            yield self._samples(
                lane,
                order,
                int(self.pixels[order]),
                rest,
                Divisor(width),
                height,
                Divisor(self.repeats),
                self.first,
                Divisor(self.lattice.aa),
                shutter,
            )

    def _shutter_numbers(self, number: Any) -> tuple[Any, ...]:
        """What ``Shutter.time`` needs, each made by ``number(type, value)``; nothing without a shutter."""
        import mitsuba as mi

        shutter = self.shutter
        if shutter is None:
            return ()
        phase = number(mi.UInt32, shutter.seed) if shutter.phase is None else number(mi.Float, shutter.phase)
        return number(mi.UInt64, shutter.moments), number(mi.UInt64, shutter.stride), phase

    def _samples(
        self,
        lane: Any,
        order: Any,
        pixel: Any,
        rest: Any,
        width: Divisor,
        height: Any,
        repeats: Divisor,
        first: Any,
        aa: Divisor,
        shutter: tuple[Any, ...],
    ) -> Samples:
        import mitsuba as mi

        row, column = width.divide(pixel)
        x, y = self.lattice.offset(repeats.divide(rest)[0] + first, aa)
        place = mi.Point2f(
            (mi.Float(column) + x) / mi.Float(width.number), (mi.Float(row) + y) / mi.Float(height)
        )
        time = self.shutter.time(rest, pixel, *shutter) if self.shutter else mi.Float(0)
        return Samples(lane=lane, order=order, is_first=rest == 0, place=place, time=time)


@dataclass(frozen=True)
class Samples:
    """Rays of a bundle before they are rays.

    ``lane``: the ray's number; ``order``: its pixel's place in the bundle; ``is_first``: is it its pixel's
    first; ``place``: on the film, x to the right, y down, the picture being [0, 1]²; ``time``: from 0, when
    the shutter opens, to 1.
    """

    lane: Any
    order: Any
    is_first: Any
    place: Any
    time: Any
