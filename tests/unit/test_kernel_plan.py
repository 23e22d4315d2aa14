"""The kernel plan: what is decided from the facts, and that the kernels obey every decision."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import group, mesh, rgb, sensor

from mrt_mitsuba.plugins.table import names_in
from mrt_mitsuba.plugins.whitted.plan import OTHER_SHAPES, WHAT, KernelPlan, contents

pytestmark = pytest.mark.usefixtures("variant")

TEXTURE = {"type": "checkerboard", "color0": 0.2, "color1": 0.8}
CORNERS = [(-1, 0, -1), (1, 0, -1), (0, 1, -1)]
MESH = mesh(CORNERS, [(0, 1, 2)])
SMOOTH = mesh(CORNERS, [(0, 1, 2)], normals=[(-0.6, 0, 0.8), (0.6, 0, 0.8), (0, 0, 1)])
SPHERE: dict[str, Any] = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "mrt_bsdf"}}
CONE = {"type": "mrt_cone", "apex": [0, 1, 1], "base_center": [0, 0, 1], "radius": 0.4}
LIGHT = {"type": "mrt_light", "position": [2, 4, 3]}
LIGHTS = {f"light{k}": {**LIGHT, "position": [2, k - 4, 3], "intensity": 0.1 * k} for k in range(9)}
LAMP = {"type": "sphere", "center": [0, 3, 0], "radius": 0.2, "emitter": {"type": "area"}}
BRUSHED = {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4}
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
GLOSSY["f0"] = rgb(0.9, 0.2, 0.5)


def scene(**content: Any) -> mi.Scene:
    view = sensor([0, 1, 6], [0, 0.4, 0], (24, 16), rfilter="gaussian", fov=40)
    return mi.load_dict({"type": "scene", "integrator": {"type": "mrt_whitted"}, "sensor": view, **content})


def kernel(loaded: mi.Scene) -> tuple[np.ndarray, list[str]]:
    """The picture, and what identifies the kernels that traced it."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        image = np.array(mi.render(loaded, spp=4, seed=1))
        return image, [k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])]


@dataclass(frozen=True)
class Choice:
    """A scene whose plan has a decision, and another decision that the kernels must obey as well."""

    content: dict[str, Any]
    other: Any  #: None: there is none
    same: bool  #: does the picture stay the same?


CHOICES: dict[str, Choice] = {}


def choice(name: str, other: Any, *, same: bool = False, **content: Any) -> None:
    CHOICES[name] = Choice(content, other, same)


BRUSHED_BALL = {**SPHERE, "bsdf": BRUSHED}
GLOSSY_CONE = {**CONE, "bsdf": GLOSSY}
MATTE_BALL = {**SPHERE, "bsdf": MATTE}
PLANE = {"type": "mrt_plane", "normal": [0, 1, 0]}
SKY = {"type": "constant"}
choice("bvh", None, same=True, a=SPHERE, light=LIGHT)
choice("coherent", False, same=True, a=MESH, light=LIGHT)
choice("spheres", "corrected", same=True, a=SPHERE, light=LIGHT)
choice("quadrics", (), a=CONE, b=SPHERE, light=LIGHT)
choice("planes", False, a=PLANE, b=SPHERE, light=LIGHT)
choice("lights", "loop", same=True, a=SPHERE, **LIGHTS)  # of a table
choice("light_buffers", False, same=True, **CROWD, light=LIGHT)
choice("eye_buffer", False, same=True, a=GROUP, light=LIGHT)
choice("sky", "none", a=SPHERE, sky=SKY, light=LIGHT)
choice("mirrors", False, a=SPHERE, sky=SKY, light=LIGHT)
choice("contribution_bounds", (math.inf, 9.0), same=True, a=SPHERE, b=CONE, sky=SKY)
choice("lobes", ("diffuse",), a=SPHERE, light=LIGHT)
choice("tangents", False, a=BRUSHED_BALL, light=LIGHT)
choice("merged", False, same=True, a=SPHERE, b=GLOSSY_CONE, light=LIGHT)


def test_every_decision_is_tried():
    assert {*CHOICES, "reasons"} == {f.name for f in fields(KernelPlan)}
    assert list(WHAT) == [f.name for f in fields(KernelPlan)][:-1]


@pytest.mark.parametrize("name", CHOICES)
def test_kernel_obeys(name):
    choice = CHOICES[name]
    loaded = scene(**choice.content)
    integrator = loaded.integrator()
    plan = integrator.prepare(loaded).plan
    if choice.other is None:
        integrator.kernel_plan = lambda facts: replace(plan, **{name: False})
        with pytest.raises(ValueError, match="untraced: set its bvh to True"):
            integrator.prepare(loaded)
        return
    assert getattr(plan, name) != choice.other
    image, kernels = kernel(loaded)
    turned = replace(plan, **{name: choice.other})
    facts = integrator.prepare(loaded).facts
    assert contents(turned, facts) != contents(plan, facts)  # as ``plan=show`` tells
    integrator.kernel_plan = lambda facts: turned
    changed, other_kernels = kernel(loaded)
    assert kernels != other_kernels
    if choice.same:
        assert np.allclose(image, changed, atol=1e-5)  # the same formulas in another order


left_out = Cases()


def reason(name: str, why: str, **content: Any) -> None:
    """Add a scene for whose kernels something is left out, and why."""
    left_out(content, name, why, name=f"{name}: {why}")


EXACT_CONE = {**CONE, "bsdf": {"type": "mrt_bsdf", "fresnel": "dielectric"}}
UNCLAMPED = {"type": "mrt_whitted", "clamp": False}
SHALLOW = {"type": "mrt_whitted", "max_depth": 1}
ROUGH_IN_PLACES = {**SPHERE, "bsdf": {"type": "mrt_bsdf", "alpha": TEXTURE}}
OTHER_LIGHT = f"a light other than {names_in('lights')}, or one with derivatives"
reason("bvh", "no shapes but analytic ones", a=CONE)
reason("spheres", OTHER_SHAPES, a=SPHERE, b=MESH)
reason("spheres", OTHER_SHAPES, a=SPHERE, b=LAMP)
reason("spheres", "a material needs the frame along texture coordinates", a=BRUSHED_BALL)
reason("light_buffers", OTHER_LIGHT, **CROWD, light={"type": "point"})
reason("light_buffers", OTHER_SHAPES, **CROWD, light=LIGHT, b=MESH)
reason("eye_buffer", "the camera is no pinhole", a=GROUP, sensor={"type": "orthographic"})
reason("mirrors", "no material reflects visibly", a=MATTE_BALL)
reason("mirrors", "max_depth admits no mirror ray", a=SPHERE, integrator=SHALLOW)
reason("tangents", "no material depends on the direction of texture coordinates", a=SPHERE)
reason("lobes", "no material has the specular one", a=MATTE_BALL)
unbounded = "what may still arrive has no known bound"
reason("contribution_bounds", unbounded, a=SPHERE, b=CONE, lamp=LAMP, integrator=UNCLAMPED)
INSTANCE = {"type": "instance", "of": {"type": "ref", "id": "inside"}}
reason("merged", "instances in the scene", a=SPHERE, inside={"type": "shapegroup", "b": MESH}, c=INSTANCE)
reason("merged", 'materials of different "fresnel"', a=SPHERE, b=EXACT_CONE)
reason("merged", "a material varies over its surface", a=ROUGH_IN_PLACES)


@pytest.mark.parametrize(("content", "name", "reason"), left_out)
def test_reasons(content, name, reason):
    loaded = scene(**content)
    assert dict(loaded.integrator().prepare(loaded).plan.reasons).get(name) == reason


def test_no_lists_where_they_would_be_too_long():
    loaded = scene(**CROWD, light=LIGHT)
    integrator = loaded.integrator()
    facts = integrator.prepare(loaded).facts
    facts = replace(facts, lights=2**11)
    assert integrator.kernel_plan(facts).light_buffers
    facts = replace(facts, lights=2**11 + 1)
    assert dict(integrator.kernel_plan(facts).reasons)["light_buffers"] == "too many lights and objects"
    facts = replace(facts, quadrics=(("cone", 2**14),))
    assert integrator.kernel_plan(facts).eye_buffer
    facts = replace(facts, quadrics=(("cone", 2**14 + 1),))
    assert dict(integrator.kernel_plan(facts).reasons)["eye_buffer"] == "too many cones and cylinders"
