"""The memory budget."""

from __future__ import annotations

import pytest

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.memory import LEAST_RAYS, MOST_RAYS, free_memory, rays_at_once

GIB = 2**30


def test_plenty_of_memory_gives_the_largest_wavefront():
    assert rays_at_once(800 * 600, 4, 64 * GIB) == MOST_RAYS


def test_less_memory_gives_fewer_rays():
    pixels = 800 * 600
    rays = [rays_at_once(pixels, 4, memory) for memory in (GIB // 8, GIB // 16, GIB // 32)]
    assert MOST_RAYS > rays[0] > rays[1] > rays[2] >= LEAST_RAYS


def test_a_picture_that_does_not_fit_is_refused_with_both_sizes():
    with pytest.raises(UsageError, match=r"9\.0 GiB.*4\.0 GiB"):
        rays_at_once(16384 * 16384, 3, 4 * GIB)


def test_tiny_pictures_need_no_full_wavefront():
    assert rays_at_once(1, 3, 2**20) >= 1


def test_free_memory_is_believable():
    assert 2**26 < free_memory() < 2**46
