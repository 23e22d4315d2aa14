"""Work that ``mrt_whitted`` leaves out: too little to be seen, or not there at all."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import rgb, sensor

pytestmark = pytest.mark.usefixtures("variant")

STEP = 1 / 255  # of an 8-bit picture


def glass(specular: float = 0.2, **more: Any) -> dict[str, Any]:
    return {"type": "mrt_bsdf", "specular_reflectance": specular, "fresnel": "dielectric", **more}


LIGHT = {"type": "mrt_light", "position": [1, 4, 5]}
FLOOR = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0, "bsdf": glass(0.0)}
LAMP = {"type": "sphere", "center": [0, 3, 0], "radius": 0.3, "emitter": {"type": "area", "radiance": 500.0}}


def balls(**more: Any) -> dict[str, Any]:
    """Two spheres side by side, each in the other's reflection."""
    both = {f"ball{k}": {"type": "sphere", "center": [1.02 * k, 0, 0], "bsdf": glass()} for k in (-1, 1)}
    return {**both, "light": LIGHT, **more}


def mirrors(distance: float, **material: Any) -> dict[str, Any]:
    """Two planes that face each other."""
    plane = {
        "type": "mrt_plane",
        "distance": distance,
        "bsdf": {"type": "mrt_bsdf", "fresnel": "unity", **material},
    }
    return {f"plane{x}": {**plane, "normal": [x, 0, 0]} for x in (1, -1)}


def hidden_lights(count: int, intensity: float) -> dict[str, Any]:
    """Many lights in a ball, each of less than what is cut off."""
    scene: dict[str, Any] = {
        "lid": {"type": "sphere", "center": [0, 8, 0], "radius": 5.0, "bsdf": glass(0.0)}
    }
    for k in range(count):
        scene[f"light{k}"] = LIGHT | {"position": [0.2 * k, 8, 0], "intensity": rgb(*[intensity] * 3)}
    return scene


def loaded(content: dict[str, Any]) -> mi.Scene:
    view = sensor([0.3, 1, 6], [0, 0.1, 0], (96, 64), fov=40)
    return mi.load_dict({"type": "scene", "sensor": view, **content})


def picture(scene: mi.Scene, **options: Any) -> np.ndarray:
    integrator = mi.load_dict({"type": "mrt_whitted", "bounce_budget": "plain", **options})
    return np.array(mi.render(scene, integrator=integrator, spp=1, seed=3))


cut = Cases()
cut(balls(), {}, name="plain")
cut(balls(sky={"type": "constant", "radiance": 1000.0}), {}, name="sky 1000")
GREY = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32)), "scale": 1000.0}
cut(balls(sky=GREY), {}, name="map 1000")
cut(balls(), {"sky": 1000.0}, name="own sky")
cut(balls(light=LIGHT | {"intensity": 1e4}), {"clamp": False}, name="unclamped")
cut(balls(light=LIGHT | {"type": "point", "intensity": 1e5}), {"clamp": False}, name="with falloff")
cut(balls(lamp=LAMP), {}, name="lamp")
cut(mirrors(1.5, specular_reflectance=0.98, alpha=1.0) | hidden_lights(6, 3.5e-4), {}, name="mirrors")
cut(hidden_lights(8, 5e-4) | {"floor": FLOOR}, {}, name="lights")


@pytest.mark.parametrize(("content", "options"), cut)
def test_what_is_cut_off_is_not_seen(content, options):
    scene = loaded(content)
    whole = picture(scene, min_contribution=0.0, **options)
    assert np.abs(whole - picture(scene, **options)).max() < STEP / 16


def test_a_mirror_whose_bounces_cost_more_bounds_nothing():
    """Rays may keep to the cheaper ones, which it leaves as many bounces as they had."""
    dear = glass(0.9, int_ior=0.5, fresnel="unity")
    planes = mirrors(1.5, specular_reflectance=0.98) | {"light": LIGHT}
    integrator = mi.load_dict({"type": "mrt_whitted"})
    without = integrator.prepare(loaded(planes)).plan.contribution_bounds
    ball = {"type": "sphere", "radius": 0.2, "bsdf": dear}
    found = integrator.prepare(loaded(planes | {"ball": ball})).plan.contribution_bounds
    assert found == pytest.approx(without)
    assert without[1] > 8  # a light, seen at all hits


def test_the_brightest_lamp_bounds_what_a_path_may_still_bring():
    dim = {**LAMP, "center": [3, 3, 0], "emitter": {"type": "area", "radiance": 1e-3}}
    integrator = mi.load_dict({"type": "mrt_whitted"})
    for lamps in ({"a": LAMP, "b": dim}, {"a": dim, "b": LAMP}):
        assert integrator.prepare(loaded(balls(**lamps))).plan.contribution_bounds[0] > 500


def test_facing_planes_of_any_reflectance_give_numbers():
    """A throughput that leaves float32, times no light, is no light."""
    planes = mirrors(7.0, specular_reflectance=1e5)
    behind = LIGHT | {"position": [9, 4, 5]}
    assert (picture(loaded(planes | {"light": behind}), max_depth=40) == 0).all()
    assert not np.isnan(picture(loaded(planes | {"light": LIGHT}), max_depth=40)).any()
