"""The kernel plan: what is decided from the facts, and that the kernels obey every decision."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import group, mesh, rgb, sensor

from mrt_mitsuba.plugins.kernel_plan import RULES, KernelPlan, held

pytestmark = pytest.mark.usefixtures("variant")

TEXTURE = {"type": "checkerboard", "color0": 0.2, "color1": 0.8}
CORNERS = [(-1, 0, -1), (1, 0, -1), (0, 1, -1)]
MESH = mesh(CORNERS, [(0, 1, 2)])
SMOOTH = mesh(CORNERS, [(0, 1, 2)], normals=[(-0.6, 0, 0.8), (0.6, 0, 0.8), (0, 0, 1)])
SPHERE: dict[str, Any] = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "mrt_bsdf"}}
CONE = {"type": "mrt_cone", "apex": [0, 1, 1], "base_center": [0, 0, 1], "radius": 0.4}
LIGHT = {"type": "mrt_light", "position": [2, 4, 3]}
LAMP = {"type": "sphere", "center": [0, 3, 0], "radius": 0.2, "emitter": {"type": "area"}}
BRUSHED = {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4}
GLASS = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "dielectric"}}
CROWD = {
    f"ball_{i}": {**SPHERE, "center": [i % 8 - 4, i // 8 - 4, -(i % 3)], "radius": 0.3} for i in range(64)
}
GROUP = group(
    [[*ball["center"], 0.3] for ball in CROWD.values()],
    face_gloss=mi.Bitmap(np.linspace(0.1, 0.9, 64, dtype=np.float32)[:, None]),
    bsdf={"type": "mrt_bsdf", "specular_reflectance": {"type": "mesh_attribute", "name": "face_gloss"}},
)
MATTE = {"type": "mrt_bsdf", "specular_reflectance": 0.0}
GLOSSY = {"type": "mrt_bsdf", "alpha": 0.4, "int_ior": 1.2, "ext_ior": 1.1}
GLOSSY |= {"diffuse_reflectance": rgb(0.1, 0.5, 0.9), "specular_reflectance": rgb(0.9, 0.3, 0.7)}


def scene(**content: Any) -> mi.Scene:
    view = sensor([0, 1, 6], [0, 0.4, 0], (24, 16), rfilter="gaussian", fov=40)
    return mi.load_dict({"type": "scene", "integrator": {"type": "mrt_whitted"}, "sensor": view, **content})


def kernel(loaded: mi.Scene) -> tuple[np.ndarray, list[str]]:
    """The picture, and what identifies the kernels that traced it."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        image = np.array(mi.render(loaded, spp=4, seed=1))
        return image, [k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])]


CHECKED = {"type": "diffuse", "reflectance": TEXTURE}
# For each decision: what a scene holds that has it, another choice, and whether the picture stays the same
CHOICES = {
    "bvh": ({"a": SPHERE, "light": LIGHT}, None, True),
    "coherent": ({"a": MESH, "light": LIGHT}, False, True),
    "spheres": ({"a": SPHERE, "light": LIGHT}, "corrected", True),
    "quadrics": ({"a": CONE, "b": SPHERE, "light": LIGHT}, (), False),
    "planes": ({"a": {"type": "mrt_plane", "normal": [0, 1, 0]}, "b": SPHERE, "light": LIGHT}, False, False),
    "lights": ({"a": SPHERE, "light": LIGHT}, "loop", True),
    "buffers": ({**CROWD, "light": LIGHT}, False, True),
    "eye": ({"a": GROUP, "light": LIGHT}, False, True),
    "random": ({"a": SPHERE, "lamp": LAMP}, False, False),
    "emission": ({"a": SPHERE, "lamp": LAMP}, False, False),
    "sky": ({"a": SPHERE, "sky": {"type": "constant"}, "light": LIGHT}, "none", False),
    "mirrors": ({"a": SPHERE, "sky": {"type": "constant"}, "light": LIGHT}, False, False),
    "cut_off": ({"a": SPHERE, "b": CONE, "sky": {"type": "constant"}}, (math.inf, 9.0), True),
    "lobes": ({"a": SPHERE, "light": LIGHT}, ("diffuse",), False),
    "textures": ({"a": {**SPHERE, "bsdf": CHECKED}, "light": LIGHT}, False, False),
    "shading_frames": ({"a": SMOOTH, "b": SPHERE, "light": LIGHT}, False, False),
    "tangents": ({"a": {**SPHERE, "bsdf": BRUSHED}, "light": LIGHT}, False, False),
    "merged": ({"a": SPHERE, "b": {**CONE, "bsdf": GLOSSY}, "light": LIGHT}, False, True),
    "two_sided": ({"a": GLASS, "light": LIGHT}, False, True),
}


def test_every_decision_is_tried() -> None:
    assert {*CHOICES, "reasons"} == {f.name for f in fields(KernelPlan)}
    assert [rule.name for rule in RULES] == [f.name for f in fields(KernelPlan)][:-1]


@pytest.mark.parametrize("name", CHOICES)
def test_kernel_obeys(name: str) -> None:
    content, other, same = CHOICES[name]
    loaded = scene(**content)
    integrator = loaded.integrator()
    plan = integrator.prepare(loaded).plan
    if other is None:
        with pytest.raises(ValueError, match="untraced: set its bvh to True"):
            integrator.prepare(loaded, replace(plan, **{name: False}))
        return
    assert getattr(plan, name) != other
    image, kernels = kernel(loaded)
    turned, facts = replace(plan, **{name: other}), integrator.prepare(loaded).facts
    assert held(turned, facts) != held(plan, facts)  # as ``plan=show`` tells
    integrator.kernel_plan = lambda facts: turned
    changed, other_kernels = kernel(loaded)
    assert kernels != other_kernels
    if same:
        assert np.allclose(image, changed, atol=1e-5)  # the same formulas in another order


REASONS = [
    ({"a": CONE}, "bvh", "no shapes but analytic ones"),
    ({"a": SPHERE}, "coherent", "no mesh in the scene"),
    ({"a": MESH}, "spheres", "no sphere in the scene"),
    ({"a": SPHERE, "b": MESH}, "spheres", "other shapes, or spheres that emit or face inwards"),
    ({"a": SPHERE}, "lights", "no light"),
    ({"a": SPHERE, "light": LIGHT}, "random", "every light is a point or a direction"),
    ({"a": SPHERE, "light": LIGHT}, "buffers", "few objects"),
    ({**CROWD, "light": {"type": "point"}}, "buffers",
     "a light other than mrt_light, or one with derivatives"),
    ({**CROWD, "light": LIGHT, "b": MESH}, "buffers", "other shapes, or spheres that emit or face inwards"),
    ({"a": CONE}, "eye", "few cones and cylinders"),
    ({"a": GROUP, "sensor": {"type": "orthographic"}}, "eye", "the camera is no pinhole"),
    ({"a": {**SPHERE, "bsdf": MATTE}}, "mirrors", "no material reflects visibly"),
    ({"a": SPHERE, "integrator": {"type": "mrt_whitted", "max_depth": 1}}, "mirrors",
     "max_depth admits no mirror ray"),
    ({"a": GROUP}, "merged", "a material varies over its surface"),
    ({"a": SPHERE}, "tangents", "no material depends on the direction of texture coordinates"),
    ({"a": {**SPHERE, "bsdf": BRUSHED}}, "spheres", "a material needs the frame along texture coordinates"),
    ({"a": {**SPHERE, "bsdf": MATTE}}, "lobes", "no material has the specular one"),
    ({"a": SPHERE, "b": CONE, "lamp": LAMP, "integrator": {"type": "mrt_whitted", "clamp": False}}, "cut_off",
     "what may still arrive has no known bound"),
    ({"a": SPHERE}, "two_sided", "no material is lit from behind"),
    ({"a": {"type": "sphere"}}, "merged", "a material other than mrt_bsdf"),
    ({"a": {**SPHERE, "bsdf": {"type": "mrt_bsdf", "alpha": TEXTURE}}}, "merged",
     "a material varies over its surface"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "name", "reason"), REASONS)
def test_reasons(content: dict[str, Any], name: str, reason: str) -> None:
    loaded = scene(**content)
    assert loaded.integrator().prepare(loaded).plan.reason(name) == reason


def test_no_lists_where_they_would_be_too_long() -> None:
    loaded = scene(**CROWD, light=LIGHT)
    integrator = loaded.integrator()
    facts = integrator.prepare(loaded).facts
    facts.lights = 2**11
    assert integrator.kernel_plan(facts).buffers
    facts.lights += 1
    assert integrator.kernel_plan(facts).reason("buffers") == "too many lights and objects"
    facts.quadrics = (("cone", 2**14),)
    assert integrator.kernel_plan(facts).eye
    facts.quadrics = (("cone", 2**14 + 1),)
    assert integrator.kernel_plan(facts).reason("eye") == "too many cones and cylinders"
