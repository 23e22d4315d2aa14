"""Random numbers by ray: they do not depend on which other rays are traced with it."""

from __future__ import annotations

import functools
from typing import Any

# The golden ratio in 32 bits: seeds that follow each other must not meet those of later rays
_STRIDE = 0x9E3779B9


def ray_sampler() -> Any:
    """Return a Mitsuba sampler for the current variant; ``start`` says which rays it serves."""
    import mitsuba as mi

    return _sampler_class(mi.variant())(mi.Properties("ray_sampler"))


@functools.cache
def _sampler_class(variant: str) -> type:
    import drjit as dr
    import mitsuba as mi

    class RaySampler(mi.Sampler):
        """Draws the numbers of Mitsuba's ``independent``, with rays that need not begin with number 0.

        ``independent`` numbers the rays of every wavefront from 0, so that pictures would depend on how they
        are cut into wavefronts.
        """

        def __init__(self, props: Any) -> None:
            mi.Sampler.__init__(self, props)
            self.random = mi.PCG32()

        def start(self, seed: int, first: int, count: int) -> None:
            """Turn to the rays ``first`` to ``first + count - 1``."""
            self.start_at(seed, dr.arange(mi.UInt64, count) + dr.opaque(mi.UInt64, first))

        def start_at(self, seed: Any, number: Any) -> None:
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

        def to_string(self) -> str:
            return "RaySampler[]"

    return RaySampler
