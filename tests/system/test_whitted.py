"""Promises of ``mrt_whitted`` about lights, surfaces and mirrors, seen along single rays."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import mesh, sensor

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

WHITTED = {"type": "mrt_whitted", "clamp": False, "min_contribution": 0.0, "bounce_budget": "plain"}
MATTE = {"type": "mrt_bsdf", "specular_reflectance": 0.0}
MIRROR = {"type": "mrt_bsdf", "fresnel": "unity", "diffuse_reflectance": 0.0, "alpha": 0.01}
FLOOR = {"type": "mrt_plane", "normal": [0, 0, 1], "bsdf": MATTE}


def trace(nodes: dict[str, Any], o: Any, d: Any, **integrator: Any) -> Any:
    """What the integrator finds along rays [N, 3] through a scene."""
    scene = mi.load_dict({"type": "scene", **nodes})
    rays = mi.Ray3f(mi.Point3f(np.atleast_2d(o).T), mi.Vector3f(np.atleast_2d(d).T))
    found = mi.load_dict({**WHITTED, **integrator}).trace(scene, None, rays)
    dr.eval(found.radiance, found.bounces, found.hit.found, found.hit.si)  # while the scene is there
    return found


def radiance(*arguments: Any, **integrator: Any) -> np.ndarray:
    return np.array(trace(*arguments, **integrator).radiance).T


@pytest.mark.parametrize("count", [8, 9])
def test_every_light_counts(count: int) -> None:
    """However many there are: the light of all is the sum of that of each, in the code and in a loop."""
    lights = {
        f"light_{k}": {"type": "mrt_light", "position": [k - 3, 1, 2], "intensity": 0.5 + 0.1 * k}
        for k in range(count)
    }
    ray = (0.3, 0.2, 5), (0, 0, -1)
    each = [radiance({"floor": FLOOR, name: light}, *ray) for name, light in lights.items()]
    assert min(values.min() for values in each) > 1e-3
    np.testing.assert_allclose(radiance({"floor": FLOOR, **lights}, *ray), sum(each), rtol=1e-5)


CYLINDER = {"type": "mrt_cylinder", "p0": [9, 9, 9], "p1": [9, 9, 10]}


@pytest.mark.parametrize("others", [{}, {"other": {"type": "rectangle"}}, {"other": CYLINDER}])
def test_hits_lie_on_their_sphere(others: dict[str, Any]) -> None:
    """Hits from 1e4 radii away, alone and with other shapes, are as near as float32 can write them."""
    center, radius = np.array([0.1, 0.2, -3.0]), 0.5
    rng = np.random.default_rng(1)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    sphere = {"type": "sphere", "center": center.tolist(), "radius": radius}
    hit = trace({"sphere": sphere, **others}, center - 5000 * d + 0.2 * rng.normal(size=(2000, 3)), d).hit
    from_center, n = np.array(hit.si.p).T - center, np.array(hit.si.n).T
    distance = np.linalg.norm(from_center, axis=1)
    met = np.array(hit.found) & (distance < 1)
    assert met.mean() > 0.5
    few = 8 * 2.0**-24 * 3.5  # some roundings of coordinates below 3.5
    assert np.abs(distance - radius)[met].max() < few
    # The normal is the direction from the centre; that of a hit 5000 away is known to 5000 roundings of it
    outwards = from_center[met] / distance[met, None]
    assert np.abs(n[met] - outwards).max() < (few / radius if not others else 1e-3)


def test_mirrors_follow_the_interpolated_normal() -> None:
    """A flat triangle whose normals lean by 30°, seen from above, shows what is at 60° from the zenith."""
    corners, lean = [(-1, -1, 0), (3, -1, 0), (-1, 3, 0)], [(0.5, 0, 0.75**0.5)] * 3
    leaning = mesh(corners, [(0, 1, 2)], normals=lean) | {"bsdf": MIRROR}
    # Two walls: the mirror ray at 60° towards +x meets the nearer one where it is lit by its own light
    wall = {"type": "mrt_plane", "normal": [-1, 0, 0], "distance": 2.0, "bsdf": MATTE}
    light = {"type": "mrt_light", "position": [1, 0, 2 / np.tan(np.radians(60))]}
    found = radiance({"mesh": leaning, "wall": wall, "light": light}, (0, 0, 5), (0, 0, -1))
    # straight across from the light: cos 0, the diffuse part alone
    np.testing.assert_allclose(found, 0.5 / np.pi, rtol=1e-4)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_a_plane_hides_lights_behind_it_only(scale: float) -> None:
    for height, lit in ((0.5, False), (0.9999, False), (1.5, True)):
        wall = {"type": "mrt_plane", "normal": [0, 0, -1], "distance": height * scale}
        light = {"type": "mrt_light", "position": [0, 0, scale]}
        d = np.array([1, 0, -0.2])
        found = radiance({"floor": FLOOR, "wall": wall, "light": light}, -0.1 * scale * d, d)
        assert (found > 0.1).all() if lit else (found == 0).all()


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("kind", ["rectangle", "sphere", "disk"])
def test_a_lamp_is_not_in_its_own_shadow(variant: str, kind: str) -> None:
    place = mi.ScalarTransform4f().translate([0.3, 0.2, 3]).rotate([1, 0, 0], 180)
    scene = mi.load_dict({
        "type": "scene",
        "integrator": WHITTED,
        "sensor": sensor([0, 0, 1], [0, 0, 0], (32, 24)),
        "floor": FLOOR,
        "lamp": {"type": kind, "to_world": place, "emitter": {"type": "area", "radiance": 1.0}},
    })  # fmt: skip
    assert (np.array(mi.render(scene, spp=1)) > 1e-3).all()


@pytest.mark.parametrize("f0", [0.0, 0.02])
def test_schlick_mirrors_at_grazing_angles_whatever_is_reflected_at_normal_incidence(f0: float) -> None:
    """F(θ) = f0 + (1 − f0)(1 − cos θ)⁵ of the sky, for every f0; dim paths are cut as by default."""
    floor = {**FLOOR, "bsdf": {"type": "mrt_bsdf", "f0": f0, "diffuse_reflectance": 0.0}}
    sky = {"type": "constant", "radiance": 0.5}
    cos = np.array([0.05, 0.2, 0.5])
    d = np.stack([np.sqrt(1 - cos**2), np.zeros(3), -cos], axis=1)
    nodes, start = {"floor": floor, "sky": sky}, np.tile([0.0, 0, 1], (3, 1))
    found = radiance(nodes, start, d, min_contribution=1 / 16 / 255)
    np.testing.assert_allclose(found[:, 0], 0.5 * (f0 + (1 - f0) * (1 - cos) ** 5), rtol=1e-4)


@pytest.mark.parametrize(("ior", "bounces"), [(1.5, 9), (0.9, 9), (0.89, 4), (0.57, 1), (0.5, 1), (1e-6, 0)])
def test_a_bounce_costs_what_the_index_leaves_of_ten(ior: float, bounces: int) -> None:
    """Straight between two mirrors: max(1, 10 - int(10 ior)) of a budget of ten for each."""
    mirror = {**MIRROR, "int_ior": ior}
    walls = {f"wall{k}": {**FLOOR, "normal": [0, 0, k], "distance": 1.0, "bsdf": mirror} for k in (1, -1)}
    found = trace(walls, (0, 0, 0.5), (0, 0, -1), bounce_budget="report", sky=1.0)
    assert np.array(found.bounces).item() == bounces


def test_a_scene_without_shapes_is_the_sky() -> None:
    view, sky = sensor([0, 0, 5], [0, 0, 0], (8, 6)), {"type": "constant", "radiance": 0.3}
    scene = mi.load_dict({"type": "scene", "integrator": WHITTED, "sensor": view, "sky": sky})
    assert np.array(mi.render(scene, spp=4)) == pytest.approx(0.3, rel=1e-6)


def test_mirror_rays_are_counted_where_there_are_none() -> None:
    view = sensor([0, 0, 5], [0, 0, 0], (8, 6))
    scene = {"type": "scene", "sensor": view, "floor": FLOOR}
    result = mrt.render(scene, integrator=WHITTED, aa=2, aamode="none", lattice="report", layers=["bounces"])
    assert result.layers["bounces.Y"].shape == (6, 8) and not result.layers["bounces.Y"].any()
