"""The acceleration study: its methods find the same hits, and its crossing point is one."""

from __future__ import annotations

import numpy as np
import pytest

from mrt_mitsuba.validation.studies import acceleration

pytestmark = pytest.mark.usefixtures("variant")


def test_methods_find_the_same_hits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceleration, "MOST_RAYS", 10_000)
    runs, rays = acceleration.methods(200)
    found = {name: trace() for name, trace in runs.items()}
    assert {name: len(t) for name, t in found.items()} == rays == dict.fromkeys(acceleration.METHODS, 10_000)
    assert 0.05 < np.mean(found["loop"] < acceleration.MISS) < 0.95
    for name in ("tree", "bvh"):
        assert acceleration.disagreement(found[name], found["loop"]) <= 1e-3  # ten grazing rays
    # the comparison has power: a sphere missed by one in a hundred rays is seen
    spoiled = np.where(np.arange(10_000) % 100 == 0, np.float32(acceleration.MISS), found["loop"])
    hit = np.mean(found["loop"] < acceleration.MISS)
    assert acceleration.disagreement(spoiled, found["loop"]) == pytest.approx(hit / 100, rel=0.3)


def test_crossing_point() -> None:
    loop = {10: 1e6, 100: 1e5, 1000: 1e4}
    assert acceleration.crossing(loop, {10: 1e5, 100: 1e5, 1000: 1e5}) == pytest.approx(100)
    assert acceleration.crossing(loop, {10: 1e5, 100: 5e4, 1000: 2e4}) == pytest.approx(100 * 10**0.5)
    assert acceleration.crossing(loop, {10: 2e6, 100: 1e6}) == 10
    assert acceleration.crossing(loop, {10: 1e3, 100: 1e3}) == float("inf")
