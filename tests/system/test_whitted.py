"""Promises of ``mrt_whitted`` about lights, surfaces and mirrors, seen along single rays."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import mesh, sensor
from numpy.testing import assert_allclose

import mrt_mitsuba as mrt
from mrt_mitsuba.plugins.parameters import PluginError

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
def test_every_light_counts(count):
    """However many there are: the light of all is the sum of that of each, in the code and in a loop."""
    lights = {
        f"light_{k}": {"type": "mrt_light", "position": [k - 3, 1, 2], "intensity": 0.5 + 0.1 * k}
        for k in range(count)
    }
    ray = (0.3, 0.2, 5), (0, 0, -1)
    each = [radiance({"floor": FLOOR, name: light}, *ray) for name, light in lights.items()]
    assert min(values.min() for values in each) > 1e-3
    assert_allclose(radiance({"floor": FLOOR, **lights}, *ray), sum(each), rtol=1e-5)


CYLINDER = {"type": "mrt_cylinder", "p0": [9, 9, 9], "p1": [9, 9, 10]}


@pytest.mark.parametrize("others", [{}, {"other": {"type": "rectangle"}}, {"other": CYLINDER}])
def test_hits_lie_on_their_sphere(others):
    """Hits from 1e4 radii away, alone and with other shapes, are as near as float32 can write them."""
    center = np.array([0.1, 0.2, -3.0])
    radius = 0.5
    rng = np.random.default_rng(1)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    sphere = {"type": "sphere", "center": center.tolist(), "radius": radius}
    o = center - 5000 * d + 0.2 * rng.normal(size=(2000, 3))
    hit = trace({"sphere": sphere, **others}, o, d).hit
    from_center = np.array(hit.si.p).T - center
    n = np.array(hit.si.n).T
    distance = np.linalg.norm(from_center, axis=1)
    met = np.array(hit.found) & (distance < 1)
    assert met.mean() > 0.5
    few = 8 * 2.0**-24 * 3.5  # some roundings of coordinates below 3.5
    assert np.abs(distance - radius)[met].max() < few
    # The normal is the direction from the centre; that of a hit 5000 away is known to 5000 roundings of it
    outwards = from_center[met] / distance[met, None]
    assert np.abs(n[met] - outwards).max() < (few / radius if not others else 1e-3)


def test_mirrors_follow_the_interpolated_normal():
    """A flat triangle whose normals lean by 30°, seen from above, shows what is at 60° from the zenith."""
    corners = [(-1, -1, 0), (3, -1, 0), (-1, 3, 0)]
    lean = [(0.5, 0, 0.75**0.5)] * 3
    leaning = mesh(corners, [(0, 1, 2)], normals=lean) | {"bsdf": MIRROR}
    # Two walls: the mirror ray at 60° towards +x meets the nearer one where it is lit by its own light
    wall = {"type": "mrt_plane", "normal": [-1, 0, 0], "distance": 2.0, "bsdf": MATTE}
    light = {"type": "mrt_light", "position": [1, 0, 2 / np.tan(np.radians(60))]}
    found = radiance({"mesh": leaning, "wall": wall, "light": light}, (0, 0, 5), (0, 0, -1))
    # straight across from the light: cos 0, the diffuse part alone
    assert_allclose(found, 0.5 / np.pi, rtol=1e-4)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_a_plane_hides_lights_behind_it_only(scale):
    for height, lit in ((0.5, False), (0.9999, False), (1.5, True)):
        wall = {"type": "mrt_plane", "normal": [0, 0, -1], "distance": height * scale}
        light = {"type": "mrt_light", "position": [0, 0, scale]}
        d = np.array([1, 0, -0.2])
        found = radiance({"floor": FLOOR, "wall": wall, "light": light}, -0.1 * scale * d, d)
        assert (found > 0.1).all() if lit else (found == 0).all()


@pytest.mark.parametrize("normal", [(0.3, -0.2, 1), (1, 1, 1), (-0.1, 0.7, 0.2)])
def test_a_slanted_plane_is_not_in_its_own_shadow(normal):
    """Points on it are off it by a rounding, to either side."""
    rng = np.random.default_rng(4)
    up = np.array(normal) / np.linalg.norm(normal)
    floor = {**FLOOR, "normal": list(normal), "distance": 1 / 3}
    light = {"type": "mrt_light", "position": (3 * up).tolist()}
    d = rng.uniform(-0.4, 0.4, (2000, 3)) - up
    assert (radiance({"floor": floor, "light": light}, np.tile(2 * up, (2000, 1)), d) > 0.01).all()


@pytest.mark.parametrize("kind", ["rectangle", "disk", "mrt_cone", "mrt_plane"])
@pytest.mark.parametrize("side", [1, -1])
def test_a_mirror_shows_the_sky_from_both_sides(kind, side):
    """By one mirror ray, which begins on the side that it goes to."""
    mirror = {"type": "twosided", "nested": {"type": "conductor", "material": "none"}}
    shape: dict[str, Any] = {"type": kind, "bsdf": mirror}
    if kind == "mrt_plane":
        shape["normal"] = [0, 0, 1]
    elif kind == "mrt_cone":  # whose base is met
        shape |= {"apex": [0, 0, -side], "base_center": [0, 0, 0], "radius": 1.0}
    sky = {"type": "constant", "radiance": 0.5}
    found = trace({"shape": shape, "sky": sky}, (0.1, 0.2, 2 * side), (0, 0.02, -side))
    assert_allclose(np.array(found.radiance), 0.5, rtol=1e-5)
    assert np.array(found.bounces).item() == 1


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("kind", ["rectangle", "sphere", "disk"])
def test_a_lamp_is_not_in_its_own_shadow(variant, kind):
    place = mi.ScalarTransform4f().translate([0.3, 0.2, 3]).rotate([1, 0, 0], 180)
    nodes = {"type": "scene", "integrator": WHITTED, "floor": FLOOR}
    nodes["sensor"] = sensor([0, 0, 1], [0, 0, 0], (32, 24))
    nodes["lamp"] = {"type": kind, "to_world": place, "emitter": {"type": "area", "radiance": 1.0}}
    assert (np.array(mi.render(mi.load_dict(nodes), spp=1)) > 1e-3).all()


@pytest.mark.parametrize("f0", [0.0, 0.02])
def test_schlick_mirrors_at_grazing_angles_whatever_is_reflected_at_normal_incidence(f0):
    """F(θ) = f0 + (1 − f0)(1 − cos θ)⁵ of the sky, for every f0; dim paths are cut as by default."""
    floor = {**FLOOR, "bsdf": {"type": "mrt_bsdf", "f0": f0, "diffuse_reflectance": 0.0}}
    sky = {"type": "constant", "radiance": 0.5}
    cos = np.array([0.05, 0.2, 0.5])
    d = np.stack([np.sqrt(1 - cos**2), np.zeros(3), -cos], axis=1)
    nodes = {"floor": floor, "sky": sky}
    start = np.tile([0.0, 0, 1], (3, 1))
    found = radiance(nodes, start, d, min_contribution=1 / 16 / 255)
    assert_allclose(found[:, 0], 0.5 * (f0 + (1 - f0) * (1 - cos) ** 5), rtol=1e-4)


@pytest.mark.parametrize(("ior", "bounces"), [(1.5, 9), (0.9, 9), (0.89, 4), (0.57, 1), (0.5, 1), (1e-6, 0)])
def test_a_bounce_costs_what_the_index_leaves_of_ten(ior, bounces):
    """Straight between two mirrors: max(1, 10 - int(10 ior)) of a budget of ten for each."""
    mirror = {**MIRROR, "int_ior": ior}
    walls = {f"wall{k}": {**FLOOR, "normal": [0, 0, k], "distance": 1.0, "bsdf": mirror} for k in (1, -1)}
    found = trace(walls, (0, 0, 0.5), (0, 0, -1), bounce_budget="report", sky=1.0)
    assert np.array(found.bounces).item() == bounces


@pytest.mark.parametrize("reflectance", [0.1, 1.0])
def test_no_shadow_ray_for_light_that_a_mirror_makes_too_dim(reflectance):
    """What a light may add to the picture decides, not what it adds to the wall that the mirror shows."""
    nodes = {"floor": {**FLOOR, "bsdf": {**MIRROR, "specular_reflectance": reflectance}}}
    nodes["ceiling"] = {**FLOOR, "normal": [0, 0, -1], "distance": 2.0}
    nodes["light"] = {"type": "mrt_light", "position": [0.5, 0, 0.5], "intensity": 0.8}
    # 0.5 / pi * 0.8 of cos 18°: 0.12 in the mirror, or a tenth of that
    found = trace(nodes, (0, 0, 1), (0, 0, -1), min_contribution=0.05)
    assert np.array(found.bounces).item() == 1
    assert np.array(found.shadow_rays).item() == (reflectance == 1)
    assert (np.array(found.radiance) > 0.01).all()


def test_a_faint_mirror_shows_a_bright_lamp():
    """No path is cut off whose lamp would be seen, however little the mirror reflects."""
    nodes: dict[str, Any] = {"floor": {**FLOOR, "bsdf": {**MIRROR, "specular_reflectance": 1e-5}}}
    lamp = {"type": "area", "radiance": 1000.0}
    nodes["lamp"] = {"type": "sphere", "center": [0, 0, 3], "radius": 0.5, "emitter": lamp}
    nodes["sensor"] = sensor([0, 0, 1], [0, 0, 0], (4, 3), up=(0, 1, 0), fov=5)
    nodes["integrator"] = {"type": "mrt_whitted"}
    picture = np.array(mi.render(mi.load_dict({"type": "scene", **nodes}), spp=1))
    assert np.median(picture) == pytest.approx(0.01, rel=0.01)  # next to what the lamp lights directly


def test_rays_that_are_switched_off_see_nothing():
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}})
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1))
    active = mi.Bool([True, False])
    spectrum, valid, _ = mi.load_dict(WHITTED).sample(
        scene, mi.load_dict({"type": "independent"}), ray, active=active
    )
    assert np.array(spectrum)[0].tolist() == [1, 0]
    assert dr.none(valid)


def test_rays_after_a_render_see_the_scene_that_they_are_given():
    """``render`` reads its scene once for all of its rays; ``sample`` by itself must not go on with that."""
    integrator = mi.load_dict(WHITTED)
    view = sensor([0, 0, 5], [0, 0, 0], (4, 3))
    for light in (0.25, 0.5):
        sky = {"type": "constant", "radiance": light}
        scene = mi.load_dict({"type": "scene", "sensor": view, "sky": sky})
        ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1))
        seen, _, _ = integrator.sample(scene, mi.load_dict({"type": "independent"}), ray)
        assert_allclose(np.array(seen), light, rtol=1e-6)
        mi.render(scene, integrator=integrator, spp=1)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
def test_an_error_inside_a_plugin_names_it(variant):
    """Dr.Jit's own says "see above"."""
    rows: list[int] = []

    class Torn(mi.Texture):
        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.UnpolarizedSpectrum(rows[7])

        def is_spatially_varying(self) -> bool:
            return True

    mi.register_texture("torn", Torn)
    ball = {"type": "sphere", "bsdf": {"type": "mrt_bsdf", "diffuse_reflectance": {"type": "torn"}}}
    nodes = {"type": "scene", "sensor": sensor([0, 0, 5], [0, 0, 0], (4, 4)), "ball": ball}
    scene = mi.load_dict(nodes | {"light": {"type": "mrt_light", "position": [0, 0, 4]}})
    with pytest.raises(PluginError, match=r"^mrt_whitted: Torn.eval raised IndexError: list index out of "):
        mrt.render(scene, integrator="mrt_whitted", spp=1)
    rows += 8 * [0]  # another scene's kernels may call it
