"""Ray against sphere and plane: exact numbers, any size and distance, and rays that start on the surface."""

from __future__ import annotations

from typing import Any

import drjit.scalar
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from mpmath import mp, mpf

from mrt_mitsuba.plugins.columns import Vector3
from mrt_mitsuba.plugins.intersect import intersect_plane, intersect_sphere
from mrt_mitsuba.validation.oracles import exact

Vector = drjit.scalar.Array3f64
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: sum(x * x for x in v) > 1e-2)
SIZES = st.floats(-6, 6).map(lambda e: 10**e)


@mp.workdps(exact.DIGITS)
def exact_sphere(o: Any, d: Any, center: Any, radius: Any) -> mpf:
    """The least t > 0 by the quadratic formula in 50 digits; inf for none."""
    o, d, center = ([exact.number(x) for x in v] for v in (o, d, center))
    f = [x - c for x, c in zip(o, center, strict=True)]
    a, b = sum(x * x for x in d), sum(x * y for x, y in zip(f, d, strict=True))
    discriminant = b * b - a * (sum(x * x for x in f) - exact.number(radius) ** 2)
    if discriminant < 0:
        return mpf("inf")
    roots = [(-b - mp.sqrt(discriminant)) / a, (-b + mp.sqrt(discriminant)) / a]
    return min((t for t in roots if t > 0), default=mpf("inf"))


def vectors32(values: np.ndarray) -> Vector3:
    return Vector3(drjit.scalar.ArrayXf(np.ascontiguousarray(c, np.float32)) for c in values.T)


# ------------------------------------------------ Sphere -----------------------------------------------


@given(
    direction=DIRECTIONS,
    center=DIRECTIONS,
    radius=SIZES,
    distance=st.floats(1.01, 1e4),
    off=st.floats(0, 1.3),
)
def test_sphere_hits_where_the_formula_says(direction, center, radius, distance, off) -> None:
    """From outside, of any size, past the centre by up to 1.3 radii; t in units of |d|."""
    d = np.array(direction)
    c = np.array(center)
    side = np.cross(d, (0.3, 0.5, 0.7))
    assume(np.linalg.norm(side) > 1e-2)
    o = c + radius * (off * side / np.linalg.norm(side) - distance * d / np.linalg.norm(d))
    truth = exact_sphere(o, d, c, radius)
    found = intersect_sphere(Vector(o), Vector(d), Vector(c), radius)
    # the rounding of coordinates, 1e-16, a few times over; where the surface is oblique, t feels it more
    error = 4e-15 * (distance + np.linalg.norm(c) / radius)
    assume(abs(off - 1) > 10 * error)  # grazing: hit or miss is a matter of rounding
    if truth == mp.inf:
        assert found == np.inf
    else:
        length = abs(found - float(truth)) * np.linalg.norm(d) / radius
        assert length < error / np.sqrt(abs(1 - off**2))


def test_sphere_in_float32_is_exact_far_away_and_near() -> None:
    """At the same float32 inputs, to 1e-6 of the distance: a unit sphere near by and a million radii away."""
    rng = np.random.default_rng(1)
    count = 300
    distance = 10 ** rng.uniform(0.01, 6, count)
    o = rng.normal(size=(count, 3))
    o = (o / np.linalg.norm(o, axis=-1, keepdims=True) * distance[:, None]).astype(np.float32)
    aim = rng.uniform(-0.4, 0.4, size=(count, 3))
    d = aim - o
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)
    truth = [exact_sphere(*row, (0, 0, 0), 1) for row in zip(o, d, strict=True)]
    hit = np.array([t != mp.inf for t in truth])
    assert hit[distance < 1e5].all()
    found = np.array(intersect_sphere(vectors32(o), vectors32(d), Vector3([0.0, 0.0, 0.0]), 1.0))
    near = hit & (distance < 1e5)
    errors = np.array(
        [float(abs(exact.number(a) - b)) for a, b in zip(found[near], np.array(truth)[near], strict=True)]
    )
    # b²−ac as the textbooks have it would be off by the radius itself, from a distance of 3e3 on
    assert (errors < 1e-6 * distance[near]).all()


def test_sphere_from_inside_and_on_its_surface() -> None:
    center, radius = Vector(1, 2, 3), 0.5
    assert intersect_sphere(center, Vector(0, 2, 0), center, radius) == 0.25
    top = Vector(1, 2.5, 3)
    assert intersect_sphere(top, Vector(0, 1, 0), center, radius) == np.inf  # leaving
    assert intersect_sphere(top, Vector(0, -1, 0), center, radius) == 1.0  # through
    assert intersect_sphere(top, Vector(1, 0, 0), center, radius) == np.inf  # along
    assert intersect_sphere(Vector(1, 9, 3), Vector(0, 1, 0), center, radius) == np.inf  # behind


@given(normal=DIRECTIONS, direction=DIRECTIONS, radius=SIZES)
def test_sphere_is_not_met_again_by_rays_that_leave_it(normal, direction, radius) -> None:
    """From points on the surface to float64, outwards: nothing, or the surface itself, within rounding."""
    n = np.array(normal) / np.linalg.norm(normal)
    d = np.array(direction) / np.linalg.norm(direction)
    d = d if d @ n > 0 else -d
    assume(d @ n > 1e-3)
    t = intersect_sphere(Vector(radius * n), Vector(d), Vector(0, 0, 0), radius)
    assert t == np.inf or t < 1e-12 * radius


# ------------------------------------------------- Plane -----------------------------------------------


@given(normal=DIRECTIONS, direction=DIRECTIONS, height=st.floats(-100, 100), distance=st.floats(-100, 100))
def test_plane_hits_where_its_equation_holds(normal, direction, height, distance) -> None:
    n, d = Vector(normal), Vector(direction)
    norm2 = sum(x * x for x in normal)
    o = n * ((height - distance) / norm2)  # so that n · o + distance = height
    slope = sum(a * b for a, b in zip(normal, direction, strict=True))
    assume(abs(slope) > 1e-6 and abs(height) > 1e-6)
    t = intersect_plane(o, d, n, distance)
    if height * slope >= 0:
        assert t == np.inf
    else:
        assert t == pytest.approx(-height / slope, rel=1e-9)
        assert intersect_plane(o, d, n * 3, 3 * distance) == pytest.approx(
            t, rel=1e-9
        )  # only the ratio counts


def test_plane_is_missed_along_it_and_from_on_it() -> None:
    n = Vector(0, 1, 0)
    assert intersect_plane(Vector(0, 1, 0), Vector(1, 0, 0), n, 0.0) == np.inf
    assert intersect_plane(Vector(0, 0, 0), Vector(1, -1, 0), n, 0.0) == np.inf
    assert intersect_plane(Vector(0, 1, 0), Vector(1, -2, 0), n, 0.0) == 0.5
    assert intersect_plane(Vector(0, -1, 0), Vector(1, 2, 0), n, 0.0) == 0.5  # from behind as well
