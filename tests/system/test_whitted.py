"""Promises of ``mrt_whitted`` about lights, surfaces and mirrors, seen along single rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import sensor

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

WHITTED = {"type": "mrt_whitted", "clamp": False, "min_contribution": 0.0, "bounce_budget": "plain"}
MATTE = {"type": "mrt_bsdf", "specular_reflectance": 0.0}
MIRROR = {"type": "mrt_bsdf", "fresnel": "unity", "diffuse_reflectance": 0.0, "alpha": 0.01}
FLOOR = {"type": "mrt_plane", "normal": [0, 0, 1]}


@dataclass(frozen=True)
class Traced:
    """The findings of the integrator along N rays."""

    radiance: np.ndarray  # [N, 3]
    found: np.ndarray  # [N]
    t: np.ndarray  # [N]
    p: np.ndarray  # [N, 3]
    n: np.ndarray  # [N, 3]


def trace(nodes: dict[str, Any], o: Any, d: Any, **integrator: Any) -> Traced:
    """Trace rays [N, 3] through a scene."""
    scene = mi.load_dict({"type": "scene", **nodes})
    tracer = mi.load_dict({**WHITTED, **integrator})
    rays = mi.Ray3f(mi.Point3f(np.atleast_2d(o).T), mi.Vector3f(np.atleast_2d(d).T))
    found = tracer.trace(scene, None, rays)
    si = found.hit.si
    points = (np.array(v).T for v in (si.p, si.n))
    return Traced(np.array(found.radiance).T, np.array(found.hit.found), np.array(si.t), *points)


def radiance(nodes: dict[str, Any], o: Any, d: Any, **integrator: Any) -> np.ndarray:
    return trace(nodes, o, d, **integrator).radiance


@pytest.mark.parametrize("count", [8, 9])
def test_every_light_counts(count: int) -> None:
    """However many there are: the light of all is the sum of that of each, in the code and in a loop."""
    lights = {
        f"light_{k}": {"type": "mrt_light", "position": [k - 3, 1, 2], "intensity": 0.5 + 0.1 * k}
        for k in range(count)
    }
    floor, ray = {**FLOOR, "bsdf": MATTE}, ((0.3, 0.2, 5), (0, 0, -1))
    each = [radiance({"floor": floor, name: light}, *ray) for name, light in lights.items()]
    assert min(values.min() for values in each) > 1e-3
    np.testing.assert_allclose(radiance({"floor": floor, **lights}, *ray), sum(each), rtol=1e-5)


@pytest.mark.parametrize(
    "others",
    [
        {},
        {"other": {"type": "rectangle"}},
        {"other": {"type": "mrt_cylinder", "p0": [9] * 3, "p1": [9, 9, 10]}},
    ],
)
def test_hits_lie_on_their_sphere(others: dict[str, Any]) -> None:
    """Hits from 1e4 radii away, alone and with other shapes, are as near as float32 can write them."""
    center, radius = np.array([0.1, 0.2, -3.0]), 0.5
    rng = np.random.default_rng(1)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    sphere = {"type": "sphere", "center": center.tolist(), "radius": radius}
    found = trace({"sphere": sphere, **others}, center - 5000 * d + 0.2 * rng.normal(size=(2000, 3)), d)
    distance = np.linalg.norm(found.p - center, axis=1)
    met = found.found & (distance < 1)
    assert met.mean() > 0.5
    few = 8 * 2.0**-24 * 3.5  # some roundings of coordinates below 3.5
    assert np.abs(distance - radius)[met].max() < few
    # The normal is the direction from the centre; that of a hit 5000 away is known to 5000 roundings of it
    outwards = (found.p - center)[met] / distance[met, None]
    assert np.abs(found.n[met] - outwards).max() < (few / radius if not others else 1e-3)


def test_mirrors_follow_the_interpolated_normal() -> None:
    """A flat triangle whose normals lean by 30°, seen from above, shows what is at 60° from the zenith."""
    mesh = mi.Mesh("leaning", 3, 1, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    lean = np.radians(30)
    parameters["vertex_positions"] = [-1.0, -1, 0, 3, -1, 0, -1, 3, 0]
    parameters["vertex_normals"] = [np.sin(lean), 0.0, np.cos(lean)] * 3
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    mesh.set_bsdf(mi.load_dict(MIRROR))
    # Two walls: the mirror ray at 60° towards +x meets the nearer one where it is lit by its own light
    wall = {"type": "mrt_plane", "normal": [-1, 0, 0], "distance": 2.0, "bsdf": MATTE}
    light = {"type": "mrt_light", "position": [1, 0, 2 / np.tan(np.radians(60))]}
    found = radiance({"mesh": mesh, "wall": wall, "light": light}, (0, 0, 5), (0, 0, -1))
    # straight across from the light: cos 0, the diffuse part alone
    np.testing.assert_allclose(found, 0.5 / np.pi, rtol=1e-4)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_a_plane_hides_lights_behind_it_only(scale: float) -> None:
    floor = {**FLOOR, "bsdf": MATTE}
    for height, lit in ((0.5, False), (1.5, True)):
        wall = {"type": "mrt_plane", "normal": [0, 0, -1], "distance": height * scale}
        light = {"type": "mrt_light", "position": [0, 0, scale]}
        d = np.array([1, 0, -0.2])
        found = radiance({"floor": floor, "wall": wall, "light": light}, -0.1 * scale * d, d)
        assert (found > 0.1).all() if lit else (found == 0).all()


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("kind", ["rectangle", "sphere", "disk"])
def test_a_lamp_is_not_in_its_own_shadow(variant: str, kind: str) -> None:
    place = mi.ScalarTransform4f().translate([0.3, 0.2, 3]).rotate([1, 0, 0], 180)
    scene = mi.load_dict({
        "type": "scene",
        "integrator": WHITTED,
        "sensor": sensor([0, 0, 1], [0, 0, 0], (32, 24)),
        "floor": {**FLOOR, "bsdf": MATTE},
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
    found = radiance(
        {"floor": floor, "sky": sky}, np.tile([0.0, 0, 1], (3, 1)), d, min_contribution=1 / 16 / 255
    )
    np.testing.assert_allclose(found[:, 0], 0.5 * (f0 + (1 - f0) * (1 - cos) ** 5), rtol=1e-4)


@pytest.mark.parametrize(("ior", "bounces"), [(1.5, 9), (0.9, 9), (0.89, 4), (0.57, 1), (0.5, 1), (1e-6, 0)])
def test_a_bounce_costs_what_the_index_leaves_of_ten(ior: float, bounces: int) -> None:
    """Straight between two mirrors: max(1, 10 - int(10 ior)) of a budget of ten for each."""
    mirror = {**MIRROR, "int_ior": ior}
    walls = {f"wall{k}": {**FLOOR, "normal": [0, 0, k], "distance": 1.0, "bsdf": mirror} for k in (1, -1)}
    scene = mi.load_dict({"type": "scene", **walls})
    tracer = mi.load_dict({**WHITTED, "bounce_budget": "report", "sky": 1.0})
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(0, 0, -1))
    assert np.array(tracer.trace(scene, None, ray).bounces).item() == bounces


def test_mirror_rays_are_counted_where_there_are_none() -> None:
    scene = {
        "type": "scene",
        "sensor": sensor([0, 0, 5], [0, 0, 0], (8, 6)),
        "floor": {**FLOOR, "bsdf": MATTE},
    }
    result = mrt.render(scene, integrator=WHITTED, aa=2, aamode="none", lattice="report", layers=["bounces"])
    assert result.layers["bounces.Y"].shape == (6, 8) and not result.layers["bounces.Y"].any()
