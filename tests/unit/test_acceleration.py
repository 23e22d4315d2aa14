"""Searches for what a ray meets: trees and lists find the same."""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import group
from numpy.testing import assert_array_equal

from mrt_mitsuba.plugins.quadric_kinds import CLOSED
from mrt_mitsuba.plugins.whitted.buffers import PointBuffer
from mrt_mitsuba.plugins.whitted.quadrics import Quadrics
from mrt_mitsuba.plugins.whitted.shapes import Spheres

pytestmark = pytest.mark.usefixtures("variant")


PLACES = [(0.1, 0.2, 0.3), (0, 0, 0), (1.02, 1.02, 1.02), (5, 0, 0), (-40, 3, 2), (0, -20_000, 0)]


def crowd(size: float, shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ends and radii of objects, and points within and without."""
    rng = np.random.default_rng(3)
    starts = rng.uniform(-1, 1, (300, 3))
    radii = size * rng.uniform(0.02, 0.12, 300)
    ends = starts + rng.normal(scale=0.1, size=(300, 3))
    points = rng.uniform(-1.2, 1.2, (20_000, 3)) * rng.choice([1, 3], (20_000, 1))
    starts, ends, points = (size * (p + shift) for p in (starts, ends, points))
    return starts, ends, radii, points


@pytest.mark.parametrize(("size", "shift"), [(1, 0), (1e6, 0), (1e-6, 0), (1, 300)])
@pytest.mark.parametrize("kind", CLOSED)
def test_light_buffers_find_what_a_search_finds(kind, size, shift):
    """Spheres: to the bit what Embree finds; quadrics: what the tree does. Lights are inside and far off.

    The last is within an object, near its surface.
    """
    starts, ends, radii, origins = crowd(size, shift)
    if kind == "sphere":
        nodes = {f"s{i}": {"type": "sphere", "center": c, "radius": r}
                 for i, (c, r) in enumerate(zip(starts.tolist(), radii.tolist(), strict=True))}  # fmt: skip
        scene = mi.load_dict({"type": "scene", **nodes})
        things: Any = Spheres(scene.shapes())
        search = scene.ray_test
    else:
        things = Quadrics([mi.load_dict(group(np.column_stack([starts, ends, radii]), kind=kind))])
        search = partial(things.occluded, active=mi.Bool(True))
    within = starts[0] + 0.97 * radii[0] * np.array([-0.8, 0.36, 0.48])
    places = np.concatenate([size * (np.array(PLACES) + shift), [within]])
    buffer = PointBuffer(places, *things.boxes())
    o = mi.Point3f(origins.T)
    for number, place in enumerate(places):
        ray = mi.Ray3f(o, mi.Point3f(place.tolist()) - o, 1, 0, [])
        dr.eval(ray)
        test = partial(things.block, ray=ray)
        found = np.array(buffer.any(mi.UInt32(number), ray.d, mi.Bool(True), test))
        expected = np.array(search(ray))
        assert 0.02 < expected.mean() <= (0.98 if number < len(PLACES) else 1)
        assert_array_equal(found, expected)


@pytest.mark.parametrize("size", [1, 1e6])
@pytest.mark.parametrize("kind", [kind for kind in CLOSED if kind != "sphere"])
def test_lists_around_the_eye_find_what_a_search_finds(kind, size):
    """For rays from there, wherever they start; those from elsewhere are searched for."""
    starts, ends, radii, aims = crowd(size, 0)
    things = Quadrics([mi.load_dict(group(np.column_stack([starts, ends, radii]), kind=kind))])
    for place in size * np.array(PLACES[1:4]):
        eye = dr.opaque(mi.Point3f, place.tolist())
        lists = PointBuffer(place[None], *things.boxes())
        d = dr.normalize(mi.Point3f(aims.T) - eye)
        for way, at_eye in ((d, 1), (-d, 0), (dr.cross(d, mi.Vector3f(1, 0, 0)), 0)):
            start = eye + dr.opaque(mi.Float, 0.3 * size) * way
            ray = mi.Ray3f(start, d, dr.opaque(mi.Float, 2.0**127), 0, [])
            dr.eval(ray)
            found, expected = (things.intersect(ray, mi.Bool(True), where) for where in (lists, None))
            assert np.mean(np.array(expected[0]) < 1e38) > 0.02
            assert_array_equal(found, expected)
            _, seen = lists.nearest(ray, mi.Bool(True), lambda *_: (mi.Float(0),), (ray.maxt,))
            assert np.mean(seen) == at_eye


@pytest.mark.parametrize(("place", "away"), [(300, 1), (0, 300)])
def test_trees_find_hairs_thinner_than_the_steps_of_coordinates(place, away):
    """Hairs along an axis, far from the origin or from where rays start; their own test meets nearly all."""
    rng = np.random.default_rng(5)
    starts = np.float32(place + rng.uniform(-1, 1, (64, 3)))
    ends = starts + np.float32([0, 0, 1])
    hairs = group(np.column_stack([starts, ends, np.full(64, 1e-5)]), kind="cylinder")
    things = Quadrics([mi.load_dict(hairs)])
    origins = np.float32(starts + away * rng.normal(size=(64, 3)))
    d = starts + np.array([0, 0, 0.5]) - origins  # to their middles
    ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(d.T), 2, 0, [])
    alone = np.array(things.block(mi.UInt32(things.leaf_of), ray))
    assert alone.mean() > 0.9
    assert_array_equal(np.array(things.occluded(ray, mi.Bool(True))), alone)
