"""Samplers for Mitsuba, executed once for each variant.

Each declares what adaptive sampling needs: ``group``, the rays of a pixel that are traced together;
``gain``, the excess convergence rate: variance falls as n^−(1 + gain); and ``spacing``, between preferred
sample counts.
``ADAPTIVE`` names the one that adaptive sampling uses.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.rendering.film import opaque

# Of adaptive sampling; in scalar variants, where rays are traced one by one, and elsewhere
ADAPTIVE = "mrt_rays" if mi.variant().startswith("scalar") else "mrt_sequence"
# The golden ratio in 32 bits: numbers that follow each other, times this, lie far apart
STRIDE = 0x9E3779B9
# Sobol's second coordinate: bit i of the index takes part where Pascal's triangle is odd, in five doublings
_PASCAL = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))


class RaySampler(mi.Sampler):
    """Draws the numbers of Mitsuba's ``independent``, with rays that need not begin with number 0.

    ``independent`` numbers the rays of every wavefront from 0, so that pictures would depend on how they
    are cut into wavefronts. ``rays``: of each pixel, as ``seek_pixels`` numbers them.
    """

    group = 2
    gain = 0.0

    def __init__(self, props: Any) -> None:
        mi.Sampler.__init__(self, props)
        self.rays = props.get("rays", 2**24)
        self.random = mi.PCG32()

    @staticmethod
    def spacing(rays: np.ndarray) -> np.ndarray:
        return np.full_like(rays, RaySampler.group)

    def seek_pixels(self, seed: Any, pixel: Any, number: Any) -> None:
        """Seek to the given ray indices within their pixels."""
        self.seek(seed, mi.UInt64(pixel) * mi.UInt64(opaque(self.rays)) + mi.UInt64(number))

    def seek(self, seed: Any, number: Any) -> None:
        """Seek to rays by their indices, or to one in scalar variants.

        ``seed``: a number, or an array of one.
        """
        if mi.variant().startswith("scalar"):
            seed = (seed + (number >> 32) * STRIDE) % 2**32
            state, sequence = mi.sample_tea_32(seed, number % 2**32)
        else:
            mi.Sampler.seed(self, 0, dr.width(number))  # sets the wavefront size only
            seed = seed if dr.is_array_v(seed) else dr.opaque(mi.UInt32, seed)
            start = seed + mi.UInt32(number >> 32) * STRIDE
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

    group = 2
    gain = 0.25

    def __init__(self, props: Any) -> None:
        mi.Sampler.__init__(self, props)
        self.index, self.key, self.dimension = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

    @staticmethod
    def spacing(rays: np.ndarray) -> np.ndarray:
        """An eighth to a quarter of the rays, a power of two: small multiples of large ones err least (A. B.
        Owen, 1995)."""
        return np.ldexp(np.float32(0.125), np.maximum(np.frexp(rays)[1], 4))

    def seek_pixels(self, seed: Any, pixel: Any, number: Any) -> None:
        """Seek to the given ray indices within their pixels."""
        self.seek(number, mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, seed))[0])

    def seek(self, index: Any, key: Any) -> None:
        """Seek to the given ray indices; ``key``: scrambles the sequence of each pixel."""
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
        a = _mixed(self.key + self.dimension * STRIDE)
        b = _mixed(a)
        self.dimension = dr.select(active, self.dimension + 1, self.dimension)
        return dr.brev(_scrambled(self.index, a, b)), a, b


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
