"""``mrt_cone`` and ``mrt_cylinder`` as meshes: what stock integrators see of them."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import AXIAL, radius

RADIUS = 0.65
ENDS = [[0.2, 1.5, -0.1], [0.5, 0.4, 0.3]]
HEIGHT = math.dist(*ENDS)
POINTS = {row.name.removeprefix("mrt_"): list(row.sample) for row in AXIAL}
SHAPES = {
    kind: {"type": f"mrt_{kind}", **dict(zip(points, ENDS, strict=True)), "radius": RADIUS}
    for kind, points in POINTS.items()
}


def area(kind: str) -> float:
    """The side and the discs of a closed one, by the profile of the float64 tracer."""
    height = np.linspace(0, 1, 10_001)
    r = RADIUS * radius(kind, height)
    slant = np.hypot(np.diff(r), HEIGHT * np.diff(height))
    return np.pi * (slant @ (r[1:] + r[:-1]) + r[0] ** 2 + r[-1] ** 2)


pytestmark = pytest.mark.usefixtures("variant")


def shape(name: str, **more):
    return mi.load_dict({**SHAPES[name], **more})


@pytest.mark.parametrize("name", SHAPES)
def test_error_falls_with_the_square_of_segments(name):
    """Each factor of four in segments is a factor of sixteen in the error of the area."""
    coarse, fine = (abs(shape(name, segments=n).surface_area() / area(name) - 1) for n in (16, 64))
    assert np.array(coarse / fine) == pytest.approx(16, abs=4)


def test_open_cone_has_no_base():
    up = mi.Ray3f([0.5, -5, 0.5], [0, 1, 0])
    for capped, t in ((True, 5.4), (False, 5 + 1.5 - 1.1 * 0.2 / RADIUS)):
        cone = shape("cone", base_center=[0.5, 0.4, 0.3], apex=[0.5, 1.5, 0.3], capped=capped)
        hit = mi.load_dict({"type": "scene", "cone": cone}).ray_intersect(up)
        assert hit.t[0] == pytest.approx(t, rel=1e-4)  # the mesh lies inside by up to 7.5e-5 of the radius


@pytest.mark.parametrize("name", SHAPES)
def test_positions_differentiate_with_the_parameters(name):
    """Derivatives of all vertices by automatic differentiation against finite differences."""
    ends = POINTS[name]
    weights = mi.Float(np.random.default_rng(4).normal(size=3 * shape(name, segments=8).vertex_count()))

    def weighted_sum(key: str, by: Any) -> Any:
        mesh = shape(name, segments=8)
        parameters = mi.traverse(mesh)
        parameters[key] = parameters[key] + by  # of a point, along (1, 1, 1)
        parameters.update()
        return dr.sum(mi.traverse(mesh)["vertex_positions"] * weights)

    for key in (*ends, "radius"):
        by = mi.Float(0)
        dr.enable_grad(by)
        dr.backward(weighted_sum(key, by))
        # a step of 1e-2 leaves a truncation of 1e-4, and a rounding of 1e-7 / 1e-2
        above, below = (weighted_sum(key, sign * 1e-2)[0] for sign in (1, -1))
        assert dr.grad(by)[0] == pytest.approx((above - below) / 2e-2, rel=2e-2, abs=2e-2)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("name", SHAPES)
def test_a_moved_shape_is_the_one_made_there(variant, name):
    """Under a transform that stretches, normals do not go with the points."""
    ends = POINTS[name]
    placed = {"segments": 16, "to_world": mi.ScalarTransform4f().rotate([1, 2, 3], 40).scale([1, 3, 0.5])}
    now = {ends[0]: [1.0, 0.2, 2.0], ends[1]: [0.1, 0.3, -0.4], "radius": 0.3}
    made = shape(name, **placed, **now)
    moved = shape(name, **placed)
    parameters = mi.traverse(moved)
    for key, value in now.items():
        parameters[key] = value
    parameters.update()
    for buffer in ("vertex_positions", "vertex_normals"):
        there, expected = (np.array(mi.traverse(mesh)[buffer]) for mesh in (moved, made))
        assert there == pytest.approx(expected, abs=1e-5)  # one of both is worked out in float32


def test_shapes_of_one_material_stay_apart():
    """Mitsuba merges meshes that share a material; a merged one would have lost its frame or equation."""
    kinds = SHAPES | {"plane": {"type": "mrt_plane", "normal": [0, 1, 0]}}
    paint = {"bsdf": {"type": "ref", "id": "paint"}}
    nodes = {f"{name}_{i}": {**kinds[name], **paint} for name in kinds for i in range(3)}
    scene = mi.load_dict({"type": "scene", "paint": {"type": "diffuse"}, **nodes})
    assert len(scene.shapes()) == 3 * len(kinds)
