"""When the rays of a pixel are traced."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Number = Callable[[Any, Any], Any]  # of a type and a value: a number as the kernel has it


@dataclass(frozen=True)
class Shutter:
    """The times of a pixel's rays; the shutter is open from time 0 to 1.

    The time is divided into ``moments`` equal parts, and successive rays of a pixel go to different parts,
    far from each other, so that place and time do not correlate. ``phase`` says where in its part a ray is, 0
    to 1. None stands for a random place, the same for all rays of a pixel and another for the next pixel,
    which turns steps into noise.
    """

    moments: int
    phase: float | None = None
    seed: int = 0

    @property
    def stride(self) -> int:
        """Parts from one ray to the next: coprime to their number, near its golden section."""
        golden = round(self.moments * (math.sqrt(5) - 1) / 2)
        return next(s for s in range(max(golden, 1), self.moments + 2) if math.gcd(s, self.moments) == 1)

    def numbers(self, number: Number) -> tuple[Any, Any, Any]:
        """Return what ``time`` needs, made by ``number(type, value)``: moments, stride, phase or seed."""
        import mitsuba as mi

        phase = number(mi.UInt32, self.seed) if self.phase is None else number(mi.Float, self.phase)
        return number(mi.UInt64, self.moments), number(mi.UInt64, self.stride), phase

    def time(self, rest: Any, pixel: Any, moments: Any, stride: Any, phase: Any) -> Any:
        """Return the time of ray number ``rest`` of a pixel; the last three are the shutter's ``numbers``."""
        import mitsuba as mi

        part = mi.UInt64(rest) * stride % moments
        if self.phase is None:
            phase = mi.sample_tea_float32(pixel, phase)
        return (mi.Float(part) + phase) / mi.Float(moments)
