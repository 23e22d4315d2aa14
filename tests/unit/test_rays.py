"""Places of samples: the division of lane numbers."""

from __future__ import annotations

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.rays.divisor import Divisor

LARGEST = 2**32 - 1


@pytest.mark.parametrize("number", [1, 2, 3, 7, 16, 641, 800, 16384, 65537, 2**31 - 1, 2**31, LARGEST])
def test_division_is_exact(number: int) -> None:
    """Next to multiples of the divisor, where a product with the rounded inverse could fall to the wrong
    side, and everywhere else."""
    mrt.register()
    import mitsuba as mi

    rng = np.random.default_rng(number)
    multiples = rng.integers(0, LARGEST // number + 1, 10_000) * number
    near = np.concatenate([multiples + k for k in (-1, 0, 1)] + [rng.integers(0, LARGEST, 10_000)])
    n = np.clip(np.append(near, [0, LARGEST]), 0, LARGEST).astype(np.uint32)
    quotient, remainder = Divisor.opaque(number).divide(mi.UInt32(n))
    assert np.array_equal(quotient, n // np.uint32(number))
    assert np.array_equal(remainder, n % np.uint32(number))


def test_division_in_scalar_variants() -> None:
    assert Divisor(7).divide(23) == (3, 2)
