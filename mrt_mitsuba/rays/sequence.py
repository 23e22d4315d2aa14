"""Random numbers that fill each pixel evenly, however many rays it gets in the end."""

from __future__ import annotations

import functools
from typing import Any

# Sobol's second coordinate: bit i of the index takes part where Pascal's triangle is odd, in five doublings
_PASCAL = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))


def pixel_sequence() -> Any:
    """Return a Mitsuba sampler for the current variant; call ``start`` for the rays that it is to serve."""
    import mitsuba as mi

    return _sequence_class(mi.variant())(mi.Properties("pixel_sequence"))


@functools.cache
def _sequence_class(variant: str) -> type:
    import drjit as dr
    import mitsuba as mi

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
            a = _mixed(self.key + self.dimension * 0x9E3779B9)
            b = _mixed(a)
            self.dimension = dr.select(active, self.dimension + 1, self.dimension)
            return dr.brev(_scrambled(self.index, a, b)), a, b

        def to_string(self) -> str:
            return "PixelSequence[]"

    return PixelSequence


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
    import drjit as dr
    import mitsuba as mi

    return mi.Float(dr.brev(bits) >> 8) * 2.0**-24
