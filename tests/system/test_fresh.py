"""A picture is that of the scene as it is: to the bit that of a scene made anew by the same edits."""

from __future__ import annotations

import os
import sys
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

RED, GREEN = ({"type": "mrt_bsdf", "diffuse_reflectance": {"type": "rgb", "value": c}} for c in
              ([0.8, 0.1, 0.1], [0.1, 0.8, 0.1]))  # fmt: skip


def content(plane: bool, fresnel: str = "schlick") -> dict[str, Any]:
    look = mi.ScalarTransform4f().look_at([0, 2, 7], [0, 0.5, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 12, "height": 9, "rfilter": {"type": "box"}}
    inside = {"type": "shapegroup", "box": {"type": "cube", "bsdf": {"type": "diffuse"}}}
    place = mi.ScalarTransform4f().translate([2.5, 0.5, 0]).scale(0.4)
    floor = {"floor": {"type": "mrt_plane", "normal": [0, 1, 0], "bsdf": {**RED, "fresnel": fresnel}}}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": look, "film": film},
        "light": {"type": "mrt_light", "position": [3, 5, 4]},
        "sky": {"type": "constant", "radiance": 0.3},
        **{f"s{k}": {"type": "sphere", "center": [1.2 * k - 2, 0.5, 0], "radius": 0.5,
                     "bsdf": {**(GREEN if k % 2 else RED), "fresnel": fresnel}} for k in range(4)},
        "cone": {"type": "mrt_cone", "apex": [0, 2, -1], "base_center": [0, 0, -1], "bsdf": GREEN},
        "mesh": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([-2, 2, -1]).scale(0.5)},
        "group": inside,
        "instance": {"type": "instance", "to_world": place, "of": {"type": "ref", "id": "group"}},
        **(floor if plane else {}),
    }  # fmt: skip


def edit(scene: mi.Scene, rng: np.random.Generator) -> None:
    """Change something, in one of several ways."""
    parameters, kind = mi.traverse(scene), rng.integers(6)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    if kind == 0:
        shapes[f"s{rng.integers(4)}"].set_bsdf(shapes[f"s{rng.integers(4)}"].bsdf())
        return
    if kind == 1:
        for _ in range(2):  # several updates before a render, in the same bounding box
            points = np.array(parameters["mesh.vertex_positions"]).reshape(-1, 3)
            parameters["mesh.vertex_positions"] = mi.Float(np.roll(points, 3, axis=0).ravel())
            parameters.update()
        return
    if kind == 2:
        faces = np.array(parameters["mesh.faces"]).reshape(-1, 3)
        parameters["mesh.faces"] = mi.UInt32(np.roll(faces, 1, axis=0)[:, ::-1].ravel())
    elif kind == 3:
        parameters["sky.radiance.value"] = mi.Float(float(rng.uniform(0, 2)))
    elif kind == 4:
        parameters["light.position"] = mi.Point3f(*rng.uniform(2, 5, 3).tolist())
    else:
        parameters["cone.apex"] = mi.Point3f(0, float(rng.uniform(1, 3)), -1)
    parameters.update()


def picture(scene: mi.Scene, integrator: Any) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=1, seed=1))


def interrupted(scene: mi.Scene, integrator: Any, calls: int) -> None:
    """Render, and stop at some call of a function."""
    left = [calls]

    def count(*_: Any) -> None:
        left[0] -= 1
        if left[0] == 0:
            sys.setprofile(None)
            raise KeyboardInterrupt

    sys.setprofile(count)
    try:
        integrator.prepare(scene)
    except KeyboardInterrupt:
        pass
    finally:
        sys.setprofile(None)


@pytest.mark.attack
@pytest.mark.parametrize("plane", [True, False], ids=["plane", "no plane"])
def test_a_picture_is_that_of_the_scene_as_it_is(plane: bool) -> None:
    integrator, scene = mi.load_dict({"type": "mrt_whitted"}), mi.load_dict(content(plane))
    rounds = int(os.environ.get("MRT_ATTACK_ROUNDS", "0")) or 12
    seeds, rng = list[int](), np.random.default_rng(7)
    picture(scene, integrator)
    for _ in range(rounds):
        seeds.append(int(rng.integers(2**31)))
        edit(scene, np.random.default_rng(seeds[-1]))
        interrupted(scene, integrator, int(rng.integers(1, 400)))
        anew = mi.load_dict(content(plane))
        for seed in seeds:
            edit(anew, np.random.default_rng(seed))
        expected = picture(anew, mi.load_dict({"type": "mrt_whitted"}))
        np.testing.assert_array_equal(picture(scene, integrator), expected)


def test_an_integrator_may_serve_several_scenes() -> None:
    """Of the same loaded objects, or alike but for a property that is no array."""
    integrator = mi.load_dict({"type": "mrt_whitted"})
    schlick, exact = (mi.load_dict(content(True, name)) for name in ("schlick", "dielectric"))
    both = {f"shape{k}": shape for k, shape in enumerate(exact.shapes()) if shape.class_name() == "Sphere"}
    again = mi.load_dict({"type": "scene", "sensor": exact.sensors()[0], "sky": exact.environment(), **both})
    for scene in (schlick, exact, again, exact, schlick, again):
        expected = picture(scene, mi.load_dict({"type": "mrt_whitted"}))
        np.testing.assert_array_equal(picture(scene, integrator), expected)


@pytest.mark.parametrize("loaded", [True, False])
def test_a_prepared_scene_gives_what_render_gives(loaded: bool) -> None:
    options = {"width": 16, "height": 12, "aa": 1 if loaded else 2, "aamode": "none"}
    nodes = mrt.scene_dict(3)
    again, other = mrt.prepare(mi.load_dict(nodes), **options), mi.load_dict(nodes)
    parameters = mi.traverse(other)
    keys = [key for key in parameters.keys() if key.endswith("reflectance.value")]  # noqa: SIM118
    for seed, value in enumerate((0.0, 0.3, 0.9)):
        for key in keys:
            again.params[key] = parameters[key] = mi.Color3f(value, 0.5 * value, 0.2 * value)
        parameters.update()
        expected = mrt.render(other, seed=seed, **options).image
        np.testing.assert_array_equal(again(seed=seed).image, expected)
