"""Searches for what a ray meets: trees and light buffers find the same; the study's crossing point is one."""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba.plugins.axial_mesh import Placement
from mrt_mitsuba.plugins.light_buffer import light_buffer
from mrt_mitsuba.plugins.quadric_kinds import KINDS, QuadricTable
from mrt_mitsuba.plugins.quadrics import Quadrics
from mrt_mitsuba.plugins.spheres import SphereBlockers
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


def lit(origins: np.ndarray, place: np.ndarray) -> mi.Ray3f:
    """Rays from points to a light."""
    o = mi.Point3f(origins.T)
    ray = mi.Ray3f(o, mi.Point3f(place.tolist()) - o, 1, 0, [])
    dr.eval(ray)
    return ray


PLACES = [(0.1, 0.2, 0.3), (0, 0, 0), (1.02, 1.02, 1.02), (5, 0, 0), (-40, 3, 2), (0, -2000, 0)]


@pytest.mark.parametrize(("size", "shift"), [(1, 0), (1e6, 0), (1e-6, 0), (1, 300)])
@pytest.mark.parametrize("kind", ["sphere", "cone", "cylinder", "capsule"])
def test_light_buffers_find_what_a_search_finds(kind: str, size: float, shift: float) -> None:
    """Spheres: to the bit what Embree finds; quadrics: what the tree does. Lights are inside and far off."""
    rng = np.random.default_rng(3)
    starts, radii = rng.uniform(-1, 1, (300, 3)), size * rng.uniform(0.02, 0.12, 300)
    ends = starts + rng.normal(scale=0.1, size=(300, 3))
    origins = rng.uniform(-1.2, 1.2, (50_000, 3)) * rng.choice([1, 3], (50_000, 1))
    starts, ends, origins, places = (size * (p + shift) for p in (starts, ends, origins, np.array(PLACES)))
    if kind == "sphere":
        nodes = {f"s{i}": {"type": "sphere", "center": c, "radius": r}
                 for i, (c, r) in enumerate(zip(starts.tolist(), radii.tolist(), strict=True))}  # fmt: skip
        scene = mi.load_dict({"type": "scene", **nodes})
        things: Any = SphereBlockers(scene.shapes())
        search = scene.ray_test
    else:
        numbers = np.column_stack([starts, ends, radii]).astype(np.float32)
        group = mi.load_dict({"type": "mrt_group", "kind": kind, "numbers": mi.Bitmap(numbers)})
        things = Quadrics([group])
        search = partial(things.occluded, active=mi.Bool(True))
    buffer = light_buffer(places, things.balls)
    assert buffer is not None
    for number, place in enumerate(places):
        ray = lit(origins, place)
        test = partial(things.block, ray=ray)
        found = np.array(buffer.any(mi.UInt32(number), ray.d, mi.Bool(True), test))
        expected = np.array(search(ray))
        assert 0.02 < expected.mean() < 0.98
        np.testing.assert_array_equal(found, expected)


def test_balls_hold_their_objects() -> None:
    """Vertices of the stand-in of each quadric, of any shear, are inside its ball, which is not far wider."""
    rng = np.random.default_rng(4)
    for kind in KINDS:
        points = rng.uniform(-1, 1, (40, 3 * KINDS[kind].points))
        numbers = np.column_stack([points, rng.uniform(0.05, 2, 40)])
        skew = np.eye(4)
        skew[:3, :3] += rng.uniform(-0.4, 0.4, (3, 3))
        place = Placement({"to_world": mi.ScalarTransform4f(skew.tolist())})
        table = QuadricTable.of_numbers(kind, numbers, 1, place, flipped=False)
        balls = table.balls()
        local = KINDS[kind].mesh(64).placed(table.extents[:, None])
        world = local @ np.linalg.inv(table.rows).transpose(0, 2, 1) + table.origins[:, None]
        share = np.linalg.norm(world - balls[:, None, :3], axis=2).max(axis=1) / balls[:, 3]
        assert share.min() > 0.6 and share.max() <= 1 + 1e-6, kind


def test_no_light_buffers_where_lists_would_be_long() -> None:
    places, balls = np.zeros((3, 3)), np.tile([0.0, 0, 5, 1], (50, 1))
    assert light_buffer(places, balls) is not None
    assert light_buffer(np.zeros((2**17, 3)), balls) is None
    assert light_buffer(places, np.tile([0.0, 0, 0, 1], (2**17, 1))) is None  # the lights are in all of them
