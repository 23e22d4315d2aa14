"""Work that ``mrt_whitted`` leaves out: too little to be seen, or not there at all."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import rgb, sensor

pytestmark = pytest.mark.usefixtures("variant")

STEP = 1 / 255  # of an 8-bit picture


def glass(specular: float = 0.2, **more: Any) -> dict[str, Any]:
    return {"type": "mrt_bsdf", "specular_reflectance": specular, "fresnel": "dielectric", **more}


def balls(**more: Any) -> dict[str, Any]:
    """Two spheres side by side, each in the other's reflection."""
    return {
        "left": {"type": "sphere", "center": [-1.02, 0, 0], "bsdf": glass()},
        "right": {"type": "sphere", "center": [1.02, 0, 0], "bsdf": glass()},
        "light": {"type": "mrt_light", "position": [1, 4, 5]},
        **more,
    }


def facing_mirrors(**more: Any) -> dict[str, Any]:
    """A corridor between two mirrors, with small lights behind a screen that nothing else is lit by."""
    mirror = {"type": "mrt_bsdf", "fresnel": "unity", "specular_reflectance": 0.98, "alpha": 1.0}
    scene = {
        "front": {"type": "mrt_plane", "normal": [1, 0, 0], "distance": 1.5, "bsdf": mirror},
        "back": {"type": "mrt_plane", "normal": [-1, 0, 0], "distance": 1.5, "bsdf": mirror},
        "lid": {"type": "sphere", "center": [0, 8, 0], "radius": 5.0, "bsdf": glass(0.0)},
    }
    for k in range(6):
        intensity = rgb(*[3.5e-4] * 3)
        scene[f"light{k}"] = {"type": "mrt_light", "position": [0.2 * k, 8, 0], "intensity": intensity}
    return scene | more


def hidden_lights() -> dict[str, Any]:
    """Many lights behind a lid, each of a third of what is cut off."""
    scene = {name: thing for name, thing in facing_mirrors().items() if name == "lid"}
    for k in range(8):
        light = {"type": "mrt_light", "position": [0.2 * k, 8, 0], "intensity": rgb(*[5e-4] * 3)}
        scene[f"light{k}"] = light
    return scene | {"floor": {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0, "bsdf": glass(0.0)}}


def loaded(content: dict[str, Any]) -> mi.Scene:
    view = sensor([0.3, 1, 6], [0, 0.1, 0], (96, 64), fov=40)
    return mi.load_dict({"type": "scene", "sensor": view, **content})


def picture(scene: mi.Scene, **options: Any) -> np.ndarray:
    integrator = mi.load_dict({"type": "mrt_whitted", "bounce_budget": "plain", **options})
    return np.array(mi.render(scene, integrator=integrator, spp=1, seed=3))


@pytest.mark.parametrize(
    ("content", "options"),
    [
        (balls(), {}),
        (balls(sky={"type": "constant", "radiance": 1000.0}), {}),
        (balls(), {"sky": 1000.0}),
        (balls(light={"type": "mrt_light", "position": [1, 4, 5], "intensity": 1e4}), {"clamp": False}),
        (balls(light={"type": "point", "position": [1, 4, 5], "intensity": 1e5}), {"clamp": False}),
        (balls(lamp={"type": "sphere", "center": [0, 3, 0], "radius": 0.3,
                     "emitter": {"type": "area", "radiance": 500.0}}), {}),
        (facing_mirrors(), {}),
        (hidden_lights(), {}),
    ],
    ids=["plain", "sky 1000", "own sky", "unclamped", "with falloff", "lamp", "mirrors", "lights"],
)  # fmt: skip
def test_what_is_cut_off_is_not_seen(content: dict[str, Any], options: dict[str, Any]) -> None:
    scene = loaded(content)
    whole = picture(scene, min_contribution=0.0, **options)
    assert np.abs(whole - picture(scene, **options)).max() < STEP / 16


LIGHT = {"type": "mrt_light", "position": [1, 4, 5]}


def test_facing_planes_of_any_reflectance_give_numbers() -> None:
    """A throughput that leaves float32, times no light, is no light."""
    mirror = {"type": "mrt_bsdf", "fresnel": "unity", "specular_reflectance": 1e5}
    planes = {
        f"plane{side}": {"type": "mrt_plane", "normal": [0, 0, -side], "distance": 7.0, "bsdf": mirror}
        for side in (1, -1)
    }
    image = picture(loaded(planes), max_depth=40)
    assert (image == 0).all()
    lit = picture(loaded(planes | {"light": LIGHT}), max_depth=40)
    assert not np.isnan(lit).any()
