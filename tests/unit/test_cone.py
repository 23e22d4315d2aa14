"""``mrt_cone`` and ``mrt_cylinder`` as meshes: what stock integrators see of them."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba import runtime

SHAPES = {
    "cone": {"type": "mrt_cone", "apex": [0.2, 1.5, -0.1], "base_center": [0.5, 0.4, 0.3], "radius": 0.65},
    "cylinder": {"type": "mrt_cylinder", "p0": [0.2, 1.5, -0.1], "p1": [0.5, 0.4, 0.3], "radius": 0.65},
}
PARTS = {"cone": 2, "cylinder": 3}
HEIGHT, RADIUS = math.sqrt(0.3**2 + 1.1**2 + 0.4**2), 0.65
AREA = {
    "cone": np.pi * RADIUS * (RADIUS + np.hypot(HEIGHT, RADIUS)),
    "cylinder": 2 * np.pi * RADIUS * (RADIUS + HEIGHT),
}


pytestmark = pytest.mark.usefixtures("variant")


def shape(name: str, **more):
    return mi.load_dict({**SHAPES[name], **more})


def triangles_of(mesh) -> np.ndarray:
    buffers = mi.traverse(mesh)
    vertices = buffers["vertex_positions"].numpy().reshape(-1, 3).astype(np.float64)
    return vertices[buffers["faces"].numpy().reshape(-1, 3)]


def area(mesh) -> float:
    """Return the area in float64: Mitsuba's own sum over the triangles loses 3e-5 of it."""
    a, b, c = triangles_of(mesh).transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def rays_at(count: int, seed: int = 1):
    """Rays from a sphere of radius 4 around the shapes towards points near their axis."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(count, 3))
    o = 4 * o / np.linalg.norm(o, axis=1, keepdims=True) + np.array([0.35, 0.95, 0.1])
    towards = np.array([0.35, 0.95, 0.1]) + rng.uniform(-0.4, 0.4, size=(count, 3))
    return mi.Ray3f(mi.Point3f(o.T), dr.normalize(mi.Vector3f((towards - o).T)))


def errors_of(name: str, segments: int, **scene):
    """Errors of a mesh against the surface: relative distance, normal and uv on the same part."""
    mesh = shape(name, segments=segments)
    ray = rays_at(50_000)
    loaded = mi.load_dict({"type": "scene", "shape": mesh, **scene})
    si = loaded.ray_intersect(ray)
    hit = mi.load_dict({"type": "mrt_whitted"}).trace(loaded, None, ray).hit
    exact = hit.si
    distance = dr.abs(si.t - exact.t) / exact.t
    normal = dr.norm(si.sh_frame.n - exact.n)
    du = dr.abs(si.uv.x - exact.uv.x)
    uv = dr.maximum(dr.minimum(du, 1 - du), dr.abs(si.uv.y - exact.uv.y))
    pick = dr.compress(si.is_valid() & hit.found & (normal < 0.5))  # a ray near a rim may meet another part
    assert dr.width(pick) > 25_000
    return [dr.gather(mi.Float, x, pick).numpy() for x in (distance, normal, uv)]


@pytest.mark.parametrize("name", SHAPES)
def test_error_falls_with_the_square_of_segments(name: str) -> None:
    """Slope 2 in distance and area: each factor of four in segments is a factor of sixteen in error."""
    counts = (16, 64, 256)
    distances = [np.median(errors_of(name, n)[0]) for n in counts]
    areas = [abs(area(shape(name, segments=n)) / AREA[name] - 1) for n in counts]
    for coarse, fine in pairwise(distances):
        assert 12 < coarse / fine < 20
    for coarse, fine in pairwise(areas):
        assert 12 < coarse / fine < 20


@pytest.mark.parametrize("name", SHAPES)
def test_normals_and_uv_are_those_of_the_exact_surface(name: str) -> None:
    _, normal, uv = errors_of(name, 256)
    # A normal turns by 2π/256 across a side of the mesh. On a cylinder its interpolation is off by the square
    # of half of that; a triangle of a cone has one normal at its tip, wrong by up to half the turn there
    assert np.median(normal) < (np.pi / 256 / 4 if name == "cone" else 5e-4)
    assert normal.max() < 2 * np.pi / 256
    assert np.median(uv) < 5e-4
    assert np.quantile(uv, 0.95) < 0.02  # the triangles at a cone's tip


def test_open_cone_has_no_base() -> None:
    up = mi.Ray3f([0.5, -5, 0.5], [0, 1, 0])
    for capped, t in ((True, 5.4), (False, 5 + 1.5 - 1.1 * 0.2 / RADIUS)):
        cone = shape("cone", base_center=[0.5, 0.4, 0.3], apex=[0.5, 1.5, 0.3], capped=capped)
        hit = mi.load_dict({"type": "scene", "cone": cone}).ray_intersect(up)
        assert hit.t[0] == pytest.approx(t, rel=1e-4)  # the mesh lies inside by up to 7.5e-5 of the radius


@pytest.mark.parametrize("name", SHAPES)
def test_positions_differentiate_with_the_parameters(name: str) -> None:
    """Derivatives of all vertices by automatic differentiation against finite differences."""
    ends = [key for key in SHAPES[name] if key not in ("type", "radius")]
    weights = mi.Float(np.random.default_rng(4).normal(size=3 * len(shape(name, segments=8).unit.points)))
    steps = [(ends[0], (1, 0, 0)), (ends[0], (0, 1, 0)), (ends[1], (0, 0, 1)), ("radius", 1)]

    def weighted_sum(key: str, step: Any, by: Any) -> Any:
        mesh = shape(name, segments=8)
        parameters = mi.traverse(mesh)
        value = parameters[key]
        parameters[key] = value + by if key == "radius" else mi.Point3f(value + mi.Vector3f(step) * by)
        parameters.update()
        return dr.sum(mi.traverse(mesh)["vertex_positions"] * weights)

    for key, step in steps:
        by = mi.Float(0)
        dr.enable_grad(by)
        dr.backward(weighted_sum(key, step, by))
        # a step of 1e-2 leaves a truncation of 1e-4, and a rounding of 1e-7 / 1e-2
        above, below = (weighted_sum(key, step, sign * 1e-2)[0] for sign in (1, -1))
        assert dr.grad(by)[0] == pytest.approx((above - below) / 2e-2, rel=2e-2, abs=2e-2)


def test_update_of_parameters_equals_construction() -> None:
    for variant in ("llvm_ad_rgb", "scalar_rgb"):
        runtime.use(variant)
        mesh, wanted = shape("cone"), shape("cone", apex=[0, 2, 0])
        parameters = mi.traverse(mesh)
        parameters["apex"] = mi.Point3f(0, 2, 0)
        parameters.update()
        got, same = (np.array(mi.traverse(m)["vertex_positions"]) for m in (mesh, wanted))
        np.testing.assert_allclose(got, same, atol=4e-7)  # some float32 roundings of coordinates up to 2
        assert np.allclose(list(mesh.exact_frame.z), list(wanted.exact_frame.z))


def test_scenes_keep_the_shapes_apart() -> None:
    """Mitsuba merges meshes that share a material; a merged cone would have lost its frame."""
    scene = mi.load_dict({
        "type": "scene", "matter": {"type": "diffuse"},
        **{f"{name}_{i}": {**SHAPES[name], "bsdf": {"type": "ref", "id": "matter"}}
           for name in SHAPES for i in range(3)},
    })  # fmt: skip
    assert sorted(s.kind for s in scene.shapes()) == ["cone"] * 3 + ["cylinder"] * 3
