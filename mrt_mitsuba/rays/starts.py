"""Where in a pixel rays start, when, and with which random numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi

# The golden ratio in 32 bits: numbers that follow each other, times this, lie far apart
_STRIDE = 0x9E3779B9
# Sobol's second coordinate: bit i of the index takes part where Pascal's triangle is odd, in five doublings
_PASCAL = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))


@dataclass(frozen=True)
class Places:
    """Samples ``first`` to ``first + count − 1`` in each pixel, each traced ``repeats`` times.

    They lie on a lattice of aa × aa. ``report``: sample (i, j) is at (0.5 + i/aa, 0.5 + j/aa), y upwards, as
    in the original. Sample 0 is the pixel's centre and the others reach into the next pixels, which shifts
    the picture by up to half a pixel. ``centered``: samples are the centres of aa × aa equal cells. ``film``:
    no grid, but as many places that the sampler of a scene draws, see ``rays.film``.

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


@lru_cache(maxsize=64)
def _data(variant: str, kind: str, number: float) -> Any:
    return dr.opaque(getattr(mi, kind), number)


def ray_sampler() -> Any:
    """Return a Mitsuba sampler for the current variant; call ``start`` for the rays that it is to serve."""
    return _classes(mi.variant())[0](mi.Properties("ray_sampler"))


def pixel_sequence() -> Any:
    """Return a Mitsuba sampler for the current variant; call ``start`` for the rays that it is to serve."""
    return _classes(mi.variant())[1](mi.Properties("pixel_sequence"))


@cache
def _classes(variant: str) -> tuple[type, type]:
    class RaySampler(mi.Sampler):
        """Draws the numbers of Mitsuba's ``independent``, with rays that need not begin with number 0.

        ``independent`` numbers the rays of every wavefront from 0, so that pictures would depend on how they
        are cut into wavefronts.
        """

        def __init__(self, props: Any) -> None:
            mi.Sampler.__init__(self, props)
            self.random = mi.PCG32()

        def start(self, seed: Any, number: Any) -> None:
            """Turn to the rays of these numbers, or of this one in scalar variants.

            ``seed``: a number, or an array of one.
            """
            if mi.variant().startswith("scalar"):
                seed = (seed + (number >> 32) * _STRIDE) % 2**32
                state, sequence = mi.sample_tea_32(seed, number % 2**32)
            else:
                mi.Sampler.seed(self, 0, dr.width(number))  # which only notes how many there are
                seed = seed if dr.is_array_v(seed) else dr.opaque(mi.UInt32, seed)
                start = seed + mi.UInt32(number >> 32) * _STRIDE
                state, sequence = mi.sample_tea_32(start, mi.UInt32(number))
            self.random = mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))

        def next_1d(self, active: Any = True) -> Any:
            return self.random.next_float32(active)

        def next_2d(self, active: Any = True) -> Any:
            x = self.random.next_float32(active)
            return mi.Point2f(x, self.random.next_float32(active))

    class PixelSequence(mi.Sampler):
        """Sobol's (0, 2)-sequence, shuffled and scrambled anew for each pixel and each pair of dimensions.

        Any run of 2ᵏ rays that starts at a multiple of 2ᵏ is stratified in every pair of dimensions, and the
        mean over the first n rays is unbiased for every n. Scrambling as A. B. Owen (1995), by hashing as in
        B. Burley, "Practical hash-based Owen scrambling" (2020). ``dimension`` counts what a ray has drawn.
        """

        def __init__(self, props: Any) -> None:
            mi.Sampler.__init__(self, props)
            self.index, self.key, self.dimension = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

        def start(self, index: Any, key: Any) -> None:
            """Turn to the rays with these numbers in their pixels, the pixels having these keys."""
            count = dr.width(index)
            mi.Sampler.seed(self, 0, count)
            # with its first bit lowest, as scrambling takes it
            self.index, self.key, self.dimension = dr.brev(index), key, dr.zeros(mi.UInt32, count)

        def next_1d(self, active: Any = True) -> Any:
            index, a, b = self._shuffled(active)
            return _fraction(_scrambled(index, b, ~a))

        def next_2d(self, active: Any = True) -> Any:
            index, a, b = self._shuffled(active)
            second = index
            for shift, mask in _PASCAL:
                second = second ^ ((second >> shift) & mask)
            return mi.Point2f(_fraction(_scrambled(index, b, ~a)), _fraction(_scrambled(second, ~b, a)))

        def _shuffled(self, active: Any) -> tuple[Any, Any, Any]:
            """Return the index, shuffled for this dimension and with its first bit lowest, and two hashes."""
            a = _mixed(self.key + self.dimension * _STRIDE)
            b = _mixed(a)
            self.dimension = dr.select(active, self.dimension + 1, self.dimension)
            return dr.brev(_scrambled(self.index, a, b)), a, b

    return RaySampler, PixelSequence


def _mixed(bits: Any) -> Any:
    """Return a hash of 32 bits. Source: C. Wellons, "Prospecting for Hash Functions" (2018)."""
    bits = (bits ^ (bits >> 16)) * 0x7FEB352D
    bits = (bits ^ (bits >> 15)) * 0x846CA68B
    return bits ^ (bits >> 16)


def _scrambled(bits: Any, a: Any, b: Any) -> Any:
    """Flip every bit by a hash of the lower ones."""
    bits = (bits + a) ^ ((bits + a) * (b & 0xFFFFFFFE))
    bits *= a | 1
    bits ^= bits * ((a ^ (b >> 16)) & 0xFFFFFFFE)
    return bits ^ (bits * 0x6C50B47C)


def _fraction(bits: Any) -> Any:
    """Return the number in [0, 1) whose binary digits are the bits, lowest first."""
    return mi.Float(dr.brev(bits) >> 8) * 2.0**-24
