"""Values of a scene that are set once it is loaded: by ``params``, and after ``mi.traverse``."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import sensor
from numpy.testing import assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import UsageError

pytestmark = pytest.mark.usefixtures("variant")

SIZE = {"width": 32, "height": 24, "aa": 1}


def test_a_render_with_params_is_that_of_the_scene_changed_by_hand():
    values = {"material_0.alpha": 0.5, "light_1.intensity.value": [0.2, 0.4, 0.6]}
    scene = mi.load_dict(mrt.scene_dict(3, width=32, height=24))
    parameters = mi.traverse(scene)
    parameters["material_0.alpha"] = mi.Float(0.5)
    parameters["light_1.intensity.value"] = mi.Color3f(0.2, 0.4, 0.6)
    parameters.update()
    with pytest.raises(UsageError, match="change a loaded one"):
        mrt.render(scene, params=values)
    result = mrt.render(3, params=values, focaldist=0, **SIZE)
    assert_array_equal(result.image, mrt.render(scene, aa=1, lattice="report").image)
    assert result.options["params"] == values
    assert abs(result.image - mrt.render(3, focaldist=0, **SIZE).image).max() > 0.1


refused = Cases()
refused({"material_0.alpa": 1}, "no parameter material_0.alpa: did you mean material_0.alpha?")
refused({"x.y": 1}, r"no parameter x.y: print\(mi.traverse\(scene\)\) lists all")
refused({"material_0.alpha": "rough"}, "material_0.alpha='rough': must be a Float")
refused({"light_0.intensity.value": [1, 2]}, "must be a Color3f")
refused({"alpha": 1}, "alpha is not a key of mi.traverse")
refused(3, "must be a dict of values")


@pytest.mark.parametrize(("params", "message"), refused)
def test_what_cannot_be_set(params, message):
    with pytest.raises(UsageError, match=message):
        mrt.render(3, params=params, **SIZE)


def drawn(scene: mi.Scene) -> float:
    return float(np.median(np.array(mi.render(scene, spp=1))))


def update(scene: mi.Scene, name: str, value: Any) -> None:
    parameters = mi.traverse(scene)
    parameters[name] = value
    parameters.update()


def test_light_buffers_follow_the_light_and_the_spheres():
    """A floor under two balls, and so many others that there are lists of what is in the way of the light."""
    ours = {"bsdf": {"type": "mrt_bsdf"}}
    others = {f"s{i}": {"type": "sphere", "center": [i, 90, 0], "radius": 0.2, **ours} for i in range(70)}
    nodes = {"type": "scene", "integrator": {"type": "mrt_whitted"}}
    nodes["sensor"] = sensor([0, 0, 5], [0, 0, 0], (32, 24), fov=1)
    nodes["light"] = {"type": "mrt_light", "position": [4, 0, 8]}
    nodes["floor"] = {"type": "mrt_plane", "normal": [0, 0, 1], **ours}
    for name, x in (("ball", 2), ("twin", -2)):
        nodes[name] = {"type": "sphere", "center": [x, 0, 4], "radius": 0.5, **ours}
    scene = mi.load_dict(nodes | others)
    assert drawn(scene) == 0
    assert scene.integrator().prepare(scene).plan.light_buffers
    update(scene, "light.position", [-4, 0, 8])
    assert drawn(scene) == 0
    update(scene, "twin.to_world", mi.ScalarTransform4f().translate([-2, 9, 4]).scale(0.5))
    assert drawn(scene) > 0.1
    update(scene, "light.position", [4, 0, 8])
    assert drawn(scene) == 0
