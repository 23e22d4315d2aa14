"""Numbers that are data of a kernel, so that others need no other kernel; and division by them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any


@dataclass(frozen=True)
class Divisor:
    """A whole number to divide lane numbers by.

    A processor divides the integers of a packet one after the other, which takes as long as tracing the ray;
    so vectorised variants multiply by the inverse in double precision. The half added keeps n/d away from
    whole numbers by 1/(2 d), and rounding moves it by less than n/d / 2⁵² < 1/(2 d) for all n < 2³².
    """

    number: Any
    inverse: Any = None  #: in vectorised variants

    def divide(self, n: Any) -> tuple[Any, Any]:
        """Return quotient and remainder."""
        import mitsuba as mi

        if self.inverse is None:
            return divmod(n, self.number)
        quotient = mi.UInt32((mi.Float64(n) + 0.5) * self.inverse)
        return quotient, n - quotient * self.number


def constants(**numbers: float) -> dict[str, Any]:
    """Return numbers by name as kernels of the current variant take them: whole ones as a ``Divisor``."""
    import mitsuba as mi

    return _constants(mi.variant(), *numbers.items())


@lru_cache(maxsize=64)
def _constants(variant: str, *numbers: tuple[str, float]) -> dict[str, Any]:
    import drjit as dr
    import mitsuba as mi

    if variant.startswith("scalar"):
        return {name: Divisor(n) if isinstance(n, int) else n for name, n in numbers}
    return {
        name: Divisor(dr.opaque(mi.UInt32, n), dr.opaque(mi.Float64, 1 / n if n else 0))
        if isinstance(n, int)
        else dr.opaque(mi.Float, n)
        for name, n in numbers
    }
