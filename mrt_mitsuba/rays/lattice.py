"""Where in a pixel the samples of a lattice lie, and when their rays start."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class Lattice:
    """A grid of aa × aa samples in a pixel.

    ``report``: sample (i, j) is at (0.5 + i/aa, 0.5 + j/aa), y upwards, as in the original. Sample 0 is the
    pixel's centre and the others reach into the next pixels, which shifts the picture by up to half a pixel.
    ``centered``: samples are the centres of aa × aa equal cells.
    ``film``: no grid, but aa × aa places that the sampler of a scene draws, see ``rays.film``.
    """

    kind: str
    aa: int

    @property
    def count(self) -> int:
        """Samples in a pixel."""
        return self.aa**2

    @property
    def holds_centre(self) -> bool:
        """Return whether the pixel's centre is one of the samples; it then comes first."""
        return self.kind == "report" or (self.kind == "centered" and self.aa % 2 == 1)


@dataclass(frozen=True)
class Places:
    """Samples ``first`` to ``first + count − 1`` of a lattice in each pixel, each traced ``repeats`` times.

    The shutter is open from time 0 to 1, which is divided into ``moments`` equal parts; successive rays of a
    pixel go to different parts, far from each other, so that place and time do not correlate. ``phase`` says
    where in its part a ray is, 0 to 1. None stands for a random place, the same for all rays of a pixel and
    another for the next pixel, which turns steps into noise.
    """

    lattice: Lattice = Lattice("report", 1)  # the pixel's centre alone
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

    @cached_property
    def _stride(self) -> int:
        """Parts of the time from one ray to the next: coprime to their number, near its golden section."""
        golden = max(round(self.moments * (math.sqrt(5) - 1) / 2), 1)
        return next(s for s in range(golden, self.moments + 2) if math.gcd(s, self.moments) <= 1)

    def at(self, pixel: Any, ray: Any, width: int, height: int) -> tuple[Any, Any]:
        """Return where and when a ray of a pixel starts: its place in a picture of this size, [0, 1]², x to
        the right and y down, and its time."""
        lattice = self.lattice
        row, column = divide(pixel, width)
        sample = divide(ray, self.repeats)[0] + opaque(self.first)
        if lattice.kind == "centered" and lattice.holds_centre:
            # start from the middle one, so that sample 0 is the centre
            sample = (sample + lattice.count // 2) % lattice.count
        i, j = (mi.Float(number) for number in divide(sample, lattice.aa))
        n = mi.Float(opaque(lattice.aa))
        x, y = (0.5 + i / n, 0.5 - j / n) if lattice.kind == "report" else ((i + 0.5) / n, (j + 0.5) / n)
        size = mi.Float(opaque(width)), mi.Float(opaque(height))
        place = mi.Point2f((mi.Float(column) + x) / size[0], (mi.Float(row) + y) / size[1])
        if not self.moments:
            return place, mi.Float(0)
        if self.phase is None:
            phase = mi.sample_tea_float32(pixel, opaque(self.seed))
        else:
            phase = opaque(float(self.phase))
        moments, stride = mi.UInt64(opaque(self.moments)), mi.UInt64(opaque(self._stride))
        return place, (mi.Float(mi.UInt64(ray) * stride % moments) + phase) / mi.Float(moments)


def opaque(number: float) -> Any:
    """Return a number as data of a kernel, so that another needs no other kernel."""
    return (
        number
        if mi.variant().startswith("scalar")
        else _opaque(mi.variant(), number, isinstance(number, int))[0]
    )


def divide(n: Any, divisor: int) -> tuple[Any, Any]:
    """Return quotient and remainder of whole numbers below 2³².

    A processor divides the integers of a packet one after the other, which takes as long as tracing the ray;
    so vectorised variants multiply by the inverse in double precision. The half added keeps n/d away from
    whole numbers by 1/(2 d), and rounding moves it by less than n/d / 2⁵² < 1/(2 d).
    """
    if mi.variant().startswith("scalar"):
        return divmod(n, divisor)
    number, inverse = _opaque(mi.variant(), divisor, True)
    quotient = mi.UInt32((mi.Float64(n) + 0.5) * inverse)
    return quotient, n - quotient * number


@lru_cache(maxsize=64)
def _opaque(variant: str, number: float, whole: bool) -> tuple[Any, Any]:
    if not whole:
        return dr.opaque(mi.Float, number), None
    return dr.opaque(mi.UInt32, number), dr.opaque(mi.Float64, 1 / number if number else 0)
