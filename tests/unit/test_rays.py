"""Rays: the division of lane numbers, random numbers by ray, and what rays add up to on a film."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba.filters.grid import dilated, window_means
from mrt_mitsuba.rays.film import divide

LARGEST = 2**32 - 1


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("number", [1, 2, 3, 7, 16, 641, 800, 16384, 65537, 2**31 - 1, 2**31, LARGEST])
def test_division_is_exact(number: int) -> None:
    """Next to multiples of the divisor, where a product with the rounded inverse could fall to the wrong
    side, and everywhere else."""
    rng = np.random.default_rng(number)
    multiples = rng.integers(0, LARGEST // number + 1, 10_000) * number
    near = np.concatenate([multiples + k for k in (-1, 0, 1)] + [rng.integers(0, LARGEST, 10_000)])
    n = np.clip(np.append(near, [0, LARGEST]), 0, LARGEST).astype(np.uint32)
    quotient, remainder = divide(mi.UInt32(n), number)
    assert np.array_equal(quotient, n // np.uint32(number))
    assert np.array_equal(remainder, n % np.uint32(number))


@pytest.mark.parametrize("reach", [1, 2, 8])
@pytest.mark.parametrize("shape", [(2, 17, 23), (5, 3)])
def test_windows_are_those_of_a_loop(shape, reach):
    """Means and dilations; windows are cut at the border, and may be larger than the picture."""
    values = np.random.default_rng(reach).exponential(size=shape) ** 8
    mask = values > 50
    rows, columns = (
        [slice(max(at - reach, 0), at + reach + 1) for at in range(count)] for count in shape[-2:]
    )
    windows = [[(..., row, column) for column in columns] for row in rows]
    means = np.array([[values[w].mean((-2, -1)) for w in line] for line in windows])
    near = np.array([[mask[w].any((-2, -1)) for w in line] for line in windows])
    assert np.allclose(window_means(values, reach), np.moveaxis(means, (0, 1), (-2, -1)), rtol=1e-13, atol=0)
    assert np.array_equal(dilated(mask, reach), np.moveaxis(near, (0, 1), (-2, -1)))


@pytest.mark.usefixtures("variant")
def test_rays_beyond_32_bits_get_numbers_of_their_own() -> None:
    sampler, seen = mi.load_dict({"type": "mrt_rays"}), []
    for first in (0, 2**32, 2**33):
        sampler.start(7, dr.arange(mi.UInt64, 1000) + first)
        seen.append(np.array(sampler.next_1d()))
    assert not any((seen[i] == seen[i + 1]).any() for i in range(2))
