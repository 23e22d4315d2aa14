"""The memory budget."""

from __future__ import annotations

import pytest

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rendering import memory
from mrt_mitsuba.rendering.memory import LEAST_RAYS, MOST_PIXELS, MOST_RAYS, Workspace, free_memory

GIB = 2**30


def test_plenty_of_memory_gives_the_largest_parts():
    space = Workspace.beside(800, 600, 4, memory=64 * GIB)
    assert space.rays_at_once(4) == MOST_RAYS
    assert space.rows_at_once(1024) == MOST_PIXELS // 1024


def test_less_memory_gives_smaller_parts():
    spaces = [Workspace.beside(800, 600, 4, memory=memory) for memory in (GIB // 8, GIB // 12, GIB // 16)]
    rays = [space.rays_at_once(4) for space in spaces]
    assert MOST_RAYS > rays[0] > rays[1] > rays[2] >= LEAST_RAYS
    rows = [space.rows_at_once(800) for space in spaces]
    assert MOST_PIXELS / 800 > rows[0] > rows[1] > rows[2]


@pytest.mark.parametrize(
    ("more", "needed"),
    [
        # 2^28 pixels of three floats, four bytes to write them, 24 rows under a filter, kernels: 4.1 GiB
        ({}, "4.1 GiB"),
        # twice the floats
        ({"pictures": 2}, "7.1 GiB"),
        # 2^26 rays of three floats each, three times
        ({"rays_per_pixel": 2**26}, "6.3 GiB"),
    ],
)
def test_a_picture_that_does_not_fit_is_refused_with_both_sizes(more, needed):
    with pytest.raises(UsageError, match=f"16384x16384 pixels needs {needed} of memory, and 4.0 GiB may be"):
        Workspace.beside(16384, 16384, 3, memory=4 * GIB, **more)


def test_by_default_half_of_what_is_free(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 8 * GIB)
    assert Workspace.beside(100, 100, 3) == Workspace.beside(100, 100, 3, memory=4 * GIB)


def test_tiny_pictures_need_no_full_wavefront():
    space = Workspace.beside(1, 1, 3, memory=2**26)
    assert space.rays_at_once(3) >= 1 and space.rows_at_once(1) >= 1


@pytest.mark.parametrize(("filtered", "flushed"), [(GIB // 1024, False), (GIB // 160, True)])
def test_what_a_large_pass_used_is_given_back(monkeypatch, filtered, flushed):
    import drjit as dr

    called = []
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: called.append(True))
    Workspace(GIB).after_filter(filtered)
    assert bool(called) is flushed


def test_more_than_the_machine_has_is_never_used(monkeypatch):
    monkeypatch.setattr(memory, "all_memory", lambda: 8 * GIB)
    with pytest.raises(UsageError, match=r"and 8\.0 GiB may be used"):
        Workspace.beside(65536, 65536, 3, memory=10**6 * GIB)
    assert Workspace.beside(800, 600, 3, memory=64 * GIB).size > 60 * GIB


def test_free_memory_is_believable():
    assert 2**26 < free_memory() < 2**46
