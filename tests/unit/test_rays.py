"""Rays: the division of lane numbers, random numbers by ray, and what rays add up to on a film."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import ndimage

from mrt_mitsuba.filters.grid import dilated, window_means
from mrt_mitsuba.rendering.exposing import RayBatch
from mrt_mitsuba.rendering.film import divide

LARGEST = 2**32 - 1


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("number", [1, 2, 3, 7, 16, 641, 800, 16384, 65537, 2**31 - 1, 2**31, LARGEST])
def test_division_is_exact(number):
    """Next to multiples of the divisor, where a product with the rounded inverse could fall to the wrong
    side, and everywhere else."""
    rng = np.random.default_rng(number)
    multiples = rng.integers(0, LARGEST // number + 1, 10_000) * number
    anywhere = rng.integers(0, LARGEST, 10_000)
    near = [multiples - 1, multiples, multiples + 1]
    n = np.concatenate([*near, anywhere, [0, LARGEST]]).clip(0, LARGEST).astype(np.uint32)
    quotient, remainder = divide(mi.UInt32(n), number)
    assert_array_equal(quotient, n // np.uint32(number))
    assert_array_equal(remainder, n % np.uint32(number))


@pytest.mark.parametrize("reach", [1, 2, 8])
@pytest.mark.parametrize("shape", [(2, 17, 23), (5, 3)])
def test_windows_are_those_of_scipy(shape, reach):
    """Means and dilations; windows are cut at the border, and may be larger than the picture."""
    values = np.random.default_rng(reach).exponential(size=shape) ** 8
    mask = values > 50
    window = np.ones((1,) * (len(shape) - 2) + (2 * reach + 1,) * 2)
    sums, counts = (ndimage.correlate(each, window, mode="constant") for each in (values, np.ones(shape)))
    assert_allclose(window_means(values, reach), sums / counts, rtol=1e-13)
    assert_array_equal(dilated(mask, reach), ndimage.maximum_filter(mask, window.shape))


@pytest.mark.usefixtures("variant")
def test_rays_beyond_32_bits_get_numbers_of_their_own():
    sampler = mi.load_dict({"type": "mrt_rays"})
    seen = []
    for first in (0, 2**32, 2**33):
        sampler.seek(7, dr.arange(mi.UInt64, 1000) + first)
        seen.append(np.array(sampler.next_1d()))
    assert (seen[0] != seen[1]).all()
    assert (seen[1] != seen[2]).all()


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("most", [1, 2, 4, 7, 100])
def test_however_groups_are_cut_each_ray_is_traced_once(most):
    """Also where a pixel has more groups than a wavefront takes, and has had rays before."""
    counts = np.array([[0, 5, 1, 0, 9, 3]])
    before = np.array([[0, 4, 0, 0, 8, 2]])
    pixels = np.repeat(np.arange(6), 2 * counts[0])
    numbers = np.concatenate([b + np.arange(2 * n) for b, n in zip(before[0], counts[0], strict=True)])
    traced = []
    done = 0
    for _, some in RayBatch.from_counts(2, counts, before).parts(lambda: most, 3):
        assert some.count <= most
        assert some.first_group == done
        done += some.count
        traced.append(np.stack([np.array(lane) for lane in some.lanes()]))
    assert_array_equal(np.concatenate(traced, 1), [pixels, numbers])
