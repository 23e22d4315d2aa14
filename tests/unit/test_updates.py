"""``mrt_whitted`` after ``mi.traverse``: a scene that was drawn before is drawn anew, as it is now."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")


def mirror(**bsdf: Any) -> mi.Scene:
    """A plane seen from above, under a sky of 0.7: what it reflects is its specular reflectance of that."""
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 1, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 3, "component_format": "float32"}
    material = {"type": "mrt_bsdf", "fresnel": "unity", "diffuse_reflectance": 0.0, "alpha": 0.01}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mrt_whitted"},
            "sensor": {"type": "perspective", "to_world": look, "film": film},
            "sky": {"type": "constant", "radiance": 0.7},
            "light": {"type": "mrt_light", "position": [0, 3, 4]},
            "plane": {"type": "mrt_plane", "normal": [0, 0, 1], "bsdf": {**material, **bsdf}},
        }
    )


def drawn(scene: mi.Scene) -> float:
    return float(np.median(np.array(mi.render(scene, spp=1))))


def update(scene: mi.Scene, name: str, value: Any) -> None:
    parameters = mi.traverse(scene)
    parameters[name] = value
    parameters.update()


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
def test_reflections_come_and_go_with_the_material(variant: str) -> None:
    """A first picture without reflections must not leave them out of the next."""
    scene = mirror(specular_reflectance=0.0)
    assert drawn(scene) == 0
    update(scene, "plane.bsdf.specular_reflectance.value", 0.5)
    assert drawn(scene) == pytest.approx(0.35, rel=1e-4)
    update(scene, "plane.bsdf.int_ior", 0.05)  # a bounce then costs the whole budget
    assert drawn(scene) == pytest.approx(0, abs=1e-6)  # the lobe's direct light
    update(scene, "plane.bsdf.int_ior", 1.5)
    assert drawn(scene) == pytest.approx(0.35, rel=1e-4)


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


def test_materials_follow_the_objects_of_a_group() -> None:
    """Values by object are read once, and again when they change; derivatives by them are no constants."""
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 3, "component_format": "float32"}
    diffuse = {"type": "mesh_attribute", "name": "face_diffuse"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mrt_whitted", "max_depth": 1},
            "sensor": {"type": "perspective", "fov": 4, "to_world": look, "film": film},
            "light": {"type": "mrt_light", "position": [0, 0, 9]},
            "balls": {
                "type": "mrt_group",
                "numbers": mi.Bitmap(np.array([[9, 9, 9, 1], [0, 0, 0, 1]], np.float32)),
                "face_diffuse": mi.Bitmap(np.array([[0.1], [0.5]], np.float32)),
                "bsdf": {"type": "mrt_bsdf", "specular_reflectance": 0.0, "diffuse_reflectance": diffuse},
            },
        }
    )
    assert drawn(scene) == pytest.approx(0.5 / np.pi, rel=0.01)
    assert scene.integrator().prepare(scene).plan.merged
    parameters = mi.traverse(scene)
    values = np.array(parameters["balls.face_diffuse"])
    update(scene, "balls.face_diffuse", mi.Float(np.where(values == np.float32(0.5), 0.25, 0.9)))
    assert drawn(scene) == pytest.approx(0.25 / np.pi, rel=0.01)
    gray = mi.Float(0.25)
    dr.enable_grad(gray)
    parameters["balls.face_diffuse"] = dr.repeat(gray, len(values))
    parameters.update()
    image = mi.render(scene, parameters, spp=1)
    dr.backward(dr.mean(image.array))
    assert float(dr.grad(gray)[0]) == pytest.approx(1 / np.pi, rel=0.01)
