"""Random numbers by ray: Mitsuba's own, however the rays are cut into wavefronts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba.rays.samplers import ray_sampler

pytestmark = pytest.mark.usefixtures("variant")


def started(first: int, count: int):
    """Return a sampler for the rays from ``first`` on."""
    sampler = ray_sampler()
    sampler.start(7, dr.arange(mi.UInt64, count) + first)
    return sampler


def test_rays_beyond_32_bits_get_numbers_of_their_own() -> None:
    seen = [np.array(started(first, 1000).next_1d()) for first in (0, 2**32, 2**33)]
    assert not any((seen[i] == seen[i + 1]).any() for i in range(2))


@pytest.mark.parametrize("variant", ["scalar_rgb"], indirect=True)
def test_scalar_variants_draw_the_same(variant: str) -> None:
    scalar, found = ray_sampler(), []
    for ray in range(5):
        scalar.start(7, ray)
        found.append(scalar.next_1d())
    mi.set_variant("llvm_ad_rgb")
    np.testing.assert_array_equal(np.float32(found), started(0, 5).next_1d())
