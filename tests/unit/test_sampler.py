"""Random numbers by ray: Mitsuba's own, however the rays are cut into wavefronts."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba.rays.sampler import ray_sampler

pytestmark = pytest.mark.usefixtures("variant")


def numbers(sampler) -> np.ndarray:
    return np.concatenate([np.ravel(sampler.next_1d()), np.ravel(sampler.next_2d())])


def test_first_rays_get_the_numbers_of_independent() -> None:
    mine, theirs = ray_sampler(), mi.load_dict({"type": "independent"})
    mine.start(7, 0, 100)
    theirs.seed(7, 100)
    for _ in range(3):
        np.testing.assert_array_equal(numbers(mine), numbers(theirs))


def test_later_rays_get_theirs_in_any_wavefront() -> None:
    whole, part = ray_sampler(), ray_sampler()
    whole.start(7, 0, 100)
    part.start(7, 60, 40)
    np.testing.assert_array_equal(np.array(whole.next_1d())[60:], np.array(part.next_1d()))


def test_rays_beyond_32_bits_get_numbers_of_their_own() -> None:
    sampler, seen = ray_sampler(), []
    for first in (0, 2**32, 2**33):
        sampler.start(7, first, 1000)
        seen.append(np.array(sampler.next_1d()))
    assert not any((seen[i] == seen[i + 1]).any() for i in range(2))


@pytest.mark.parametrize("variant", ["scalar_rgb"], indirect=True)
def test_scalar_variants_draw_the_same(variant: str) -> None:
    scalar = ray_sampler()
    mi.set_variant("llvm_ad_rgb")
    vector = ray_sampler()
    vector.start(7, 0, 5)
    expected = np.array(vector.next_1d())
    mi.set_variant(variant)
    found = []
    for ray in range(5):
        scalar.start_at(7, ray)
        found.append(scalar.next_1d())
    np.testing.assert_array_equal(np.float32(found), expected)
