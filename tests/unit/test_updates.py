"""``mrt_whitted`` after ``mi.traverse``: a scene that was drawn before is drawn anew, as it is now."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")


def drawn(scene: mi.Scene) -> float:
    return float(np.median(np.array(mi.render(scene, spp=1))))


def update(scene: mi.Scene, name: str, value: Any) -> None:
    parameters = mi.traverse(scene)
    parameters[name] = value
    parameters.update()


def test_light_buffers_follow_the_light_and_the_spheres() -> None:
    """A floor under a ball, and so many others that there are lists of what is in the way of the light."""
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    others = {f"s{i}": {"type": "sphere", "center": [i, 90, 0], "radius": 0.2} for i in range(70)}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mrt_whitted"},
            "sensor": {"type": "perspective", "fov": 1, "to_world": look},
            "light": {"type": "mrt_light", "position": [4, 0, 8]},
            "floor": {"type": "mrt_plane", "normal": [0, 0, 1], "bsdf": {"type": "mrt_bsdf"}},
            "ball": {"type": "sphere", "center": [2, 0, 4], "radius": 0.5, "bsdf": {"type": "mrt_bsdf"}},
            **{name: {**node, "bsdf": {"type": "mrt_bsdf"}} for name, node in others.items()},
        }
    )
    assert drawn(scene) == 0
    assert scene.integrator().prepare(scene).plan.buffers
    update(scene, "light.position", [-4, 0, 8])
    assert drawn(scene) > 0.1
    update(scene, "ball.to_world", mi.ScalarTransform4f().translate([-2, 0, 4]).scale(0.5))
    assert drawn(scene) == 0
    update(scene, "light.position", [4, 0, 8])
    assert drawn(scene) > 0.1
