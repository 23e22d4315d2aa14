"""Division of lane numbers by numbers that are data of a kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Divisor:
    """A number to divide lane numbers by, as data of a kernel: another number needs no other kernel.

    A processor divides the integers of a packet one after the other, which takes as long as tracing the ray;
    so vectorised variants multiply by the inverse in double precision. The half added keeps n/d away from
    whole numbers by 1/(2 d), and rounding moves it by less than n/d / 2⁵² < 1/(2 d) for all n < 2³².
    """

    number: Any
    inverse: Any = None

    @classmethod
    def opaque(cls, number: int) -> Divisor:
        """Return a divisor for vectorised variants."""
        import drjit as dr
        import mitsuba as mi

        return cls(dr.opaque(mi.UInt32, number), dr.opaque(mi.Float64, 1 / number))

    def divide(self, n: Any) -> tuple[Any, Any]:
        """Return quotient and remainder."""
        import mitsuba as mi

        if self.inverse is None:
            return divmod(n, self.number)
        quotient = mi.UInt32((mi.Float64(n) + 0.5) * self.inverse)
        return quotient, n - quotient * self.number
