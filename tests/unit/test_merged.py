"""Many ``mrt_bsdf`` evaluated as one by ``mrt_whitted``."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import rgb, sensor

from mrt_mitsuba.plugins.lobes import Lobes

pytestmark = pytest.mark.usefixtures("variant")


def spheres(count: int, **more: Any) -> dict[str, Any]:
    """A row of spheres before a plane, no two materials alike: reflections of one in the other."""
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": sensor([0, 3, 9], [0, 0.5, 0], (48, 24), rfilter="gaussian", fov=50),
        "sky": {"type": "constant", "radiance": 0.3},
        "light": {"type": "mrt_light", "position": [3, 6, 5]},
        "floor": {"type": "mrt_plane", "normal": [0, 1, 0], "bsdf": {"type": "mrt_bsdf", "alpha": 0.3}},
    }
    for k in range(count):
        x = (k + 0.5) / count
        material = {
            "type": "mrt_bsdf",
            "alpha": 0.02 + 0.4 * x,
            "int_ior": 1.2 + x,
            "ext_ior": 1 + 0.1 * x,
            "diffuse_reflectance": rgb(x, 0.5, 1 - x),
            "specular_reflectance": rgb(1 - x, x, 0.7),
        }
        center = [8 * x - 4, 3 / count, 0]
        scene[f"sphere{k}"] = {"type": "sphere", "center": center, "radius": 3 / count, "bsdf": material}
    return scene | more


def picture(scene: mi.Scene) -> np.ndarray:
    return np.array(mi.render(scene, spp=4, seed=1))


def test_materials_are_recorded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    value = Lobes.value

    def counting(*arguments: Any) -> Any:
        calls.append(1)
        return value(*arguments)

    monkeypatch.setattr(Lobes, "value", counting)
    counts = []
    for count in (2, 30):
        calls.clear()
        picture(mi.load_dict(spheres(count)))
        counts.append(len(calls))
    assert counts[0] == counts[1] > 0


def test_a_scene_without_shapes_is_the_sky() -> None:
    scene = spheres(0)
    del scene["floor"]
    image = picture(mi.load_dict(scene))
    assert image == pytest.approx(0.3, rel=1e-6)
