"""The kernel plan: what is decided from the facts, and that the kernels obey every decision."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import sensor

from mrt_mitsuba.plugins.kernel_plan import CutOff, KernelPlan, Reason

pytestmark = pytest.mark.usefixtures("variant")

TEXTURE = {"type": "checkerboard", "color0": 0.2, "color1": 0.8}
MESH = {
    "type": "mrt_mesh",
    "positions": mi.Bitmap(np.array([[(-1, 0, -1), (1, 0, -1), (0, 1, -1)]], np.float32)),
    "faces": mi.Bitmap(np.array([[(0, 1, 2)]], np.uint32)),
}
SPHERE: dict[str, Any] = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "mrt_bsdf"}}
CONE = {"type": "mrt_cone", "apex": [0, 1, 1], "base_center": [0, 0, 1], "radius": 0.4}
BRIGHT = {**SPHERE, "bsdf": {"type": "mrt_bsdf", "specular_reflectance": 1e5}}
LIGHT = {"type": "mrt_light", "position": [2, 4, 3]}
LAMP = {"type": "sphere", "center": [0, 3, 0], "radius": 0.2, "emitter": {"type": "area"}}
BRUSHED = {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4}
GLASS = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "dielectric"}}
CROWD = {
    f"ball_{i}": {**SPHERE, "center": [i % 8 - 4, i // 8 - 4, -(i % 3)], "radius": 0.3} for i in range(64)
}
GROUP = {
    "type": "mrt_group",
    "numbers": mi.Bitmap(np.array([[i % 8 - 4, i // 8 - 4, -(i % 3), 0.3] for i in range(64)], np.float32)),
    "face_gloss": mi.Bitmap(np.linspace(0.1, 0.9, 64, dtype=np.float32)[:, None]),
    "bsdf": {"type": "mrt_bsdf", "specular_reflectance": {"type": "mesh_attribute", "name": "face_gloss"}},
}
MATTE = {"type": "mrt_bsdf", "specular_reflectance": 0.0}


def smooth_mesh() -> mi.Mesh:
    """A triangle whose corners have normals of their own."""
    mesh = mi.Mesh("smooth", 3, 1, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float([-1, 0, -1, 1, 0, -1, 0, 1, -1])
    parameters["vertex_normals"] = mi.Float([-0.6, 0, 0.8, 0.6, 0, 0.8, 0, 0, 1])
    parameters["faces"] = mi.UInt32([0, 1, 2])
    parameters.update()
    return mesh


def scene(**content: Any) -> mi.Scene:
    view = sensor([0, 1, 6], [0, 0.4, 0], (24, 16), rfilter="gaussian", fov=40)
    return mi.load_dict({"type": "scene", "integrator": {"type": "mrt_whitted"}, "sensor": view, **content})


def plan_of(**content: Any) -> KernelPlan:
    loaded = scene(**content)
    integrator = loaded.integrator()
    return integrator.kernel_plan(integrator.scene_facts(loaded))


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
    "touching": ({"a": SPHERE, "light": {"type": "mrt_light", "position": [0, 0.7, 0]}}, False, False),
    "random": ({"a": SPHERE, "lamp": LAMP}, False, False),
    "emission": ({"a": SPHERE, "lamp": LAMP}, False, False),
    "sky": ({"a": SPHERE, "sky": {"type": "constant"}, "light": LIGHT}, "none", False),
    "mirrors": ({"a": SPHERE, "sky": {"type": "constant"}, "light": LIGHT}, False, False),
    "mirror_rays": ({"a": SPHERE, "sky": {"type": "constant"}}, True, True),
    "cut_off": ({"a": SPHERE, "b": CONE, "sky": {"type": "constant"}}, CutOff(math.inf, 9.0), True),
    "guarded": ({"a": BRIGHT, "b": CONE, "light": LIGHT}, False, True),
    "lobes": ({"a": SPHERE, "light": LIGHT}, ("diffuse",), False),
    "textures": ({"a": {**SPHERE, "bsdf": CHECKED}, "light": LIGHT}, False, False),
    "shading_frames": ({"b": SPHERE, "light": LIGHT}, False, False),
    "tangents": ({"a": {**SPHERE, "bsdf": BRUSHED}, "light": LIGHT}, False, False),
    "merged": ({"a": SPHERE, "b": {**CONE, "bsdf": {"type": "mrt_bsdf"}}, "light": LIGHT}, False, True),
    "two_sided": ({"a": GLASS, "light": LIGHT}, False, True),
}


def test_every_decision_is_tried() -> None:
    assert {*CHOICES, "reasons"} == {f.name for f in fields(KernelPlan)}


@pytest.mark.parametrize("name", CHOICES)
def test_kernel_obeys(name: str) -> None:
    content, other, same = CHOICES[name]
    content = content | ({"a": smooth_mesh()} if name == "shading_frames" else {})
    loaded = scene(**content)
    integrator = loaded.integrator()
    plan = integrator.prepare(loaded).plan
    if other is None:
        with pytest.raises(ValueError, match="untraced: set its bvh to True"):
            integrator.prepare(loaded, replace(plan, **{name: False}))
        return
    assert getattr(plan, name) != other
    image, kernels = kernel(loaded)
    assert integrator.prepare(loaded, replace(plan, **{name: other})).plan != plan
    changed, other_kernels = kernel(loaded)
    assert kernels != other_kernels
    if same:
        assert np.allclose(image, changed, atol=1e-5)  # the same formulas in another order


@pytest.mark.parametrize(
    ("content", "name", "reason"),
    [
        ({"a": CONE}, "bvh", Reason.NO_NATIVE_SHAPES),
        ({"a": SPHERE}, "coherent", Reason.NO_MESHES),
        ({"a": MESH}, "spheres", Reason.NO_SPHERES),
        ({"a": SPHERE, "b": MESH}, "spheres", Reason.NATIVE_SHAPES),
        ({"a": SPHERE}, "quadrics", Reason.NO_QUADRICS),
        ({"a": SPHERE}, "planes", Reason.NO_PLANES),
        ({"a": SPHERE}, "lights", Reason.NO_LIGHTS),
        ({"a": SPHERE, "light": LIGHT}, "random", Reason.DELTA_LIGHTS),
        ({"a": SPHERE, "light": LIGHT}, "touching", Reason.APART),
        ({"a": SPHERE, "light": LIGHT}, "buffers", Reason.FEW_OBJECTS),
        ({**CROWD, "light": {"type": "point"}}, "buffers", Reason.OTHER_LIGHTS),
        ({**CROWD, "light": LIGHT, "b": MESH}, "buffers", Reason.NATIVE_SHAPES),
        ({**CROWD, "a": CONE}, "eye", Reason.FEW_OBJECTS),
        ({"a": GROUP, "sensor": {"type": "orthographic"}}, "eye", Reason.OTHER_CAMERA),
        ({"a": SPHERE}, "emission", Reason.NO_SURFACE_EMITTERS),
        ({"a": SPHERE}, "sky", Reason.NO_SKY),
        ({"a": {**SPHERE, "bsdf": MATTE}}, "mirrors", Reason.NO_MIRRORS),
        ({"a": SPHERE, "integrator": {"type": "mrt_whitted", "max_depth": 1}}, "mirrors", Reason.MAX_DEPTH),
        ({"a": SPHERE}, "textures", Reason.UNIFORM),
        ({"a": GROUP}, "textures", Reason.UNIFORM),
        ({"a": SPHERE}, "tangents", Reason.ISOTROPIC),
        ({"a": {**SPHERE, "bsdf": BRUSHED}}, "spheres", Reason.TANGENTS),
        ({"a": {**SPHERE, "bsdf": MATTE}}, "lobes", Reason.NO_SPECULAR),
        ({"a": SPHERE}, "mirrors", Reason.ALONE),
        ({"a": SPHERE, "sky": {"type": "constant"}}, "mirror_rays", Reason.ALONE),
        ({"a": SPHERE, "b": CONE, "sky": {"type": "constant"}}, "guarded", Reason.BOUNDED),
        (
            {"a": SPHERE, "b": CONE, "lamp": LAMP, "integrator": {"type": "mrt_whitted", "clamp": False}},
            "cut_off",
            Reason.UNBOUNDED,
        ),
        ({"a": SPHERE}, "two_sided", Reason.ONE_SIDED),
        ({"a": {"type": "sphere"}}, "merged", Reason.OTHER_BSDF),
        ({"a": {**SPHERE, "bsdf": {"type": "mrt_bsdf", "alpha": TEXTURE}}}, "merged", Reason.VARYING),
    ],
)
def test_reasons(content: dict[str, Any], name: str, reason: Reason) -> None:
    assert plan_of(**content).reason(name) is reason


def test_no_light_buffers_where_they_would_be_too_long() -> None:
    loaded = scene(**CROWD, light=LIGHT)
    integrator = loaded.integrator()
    facts = replace(integrator.scene_facts(loaded), lights=2**11)
    assert integrator.kernel_plan(facts).buffers
    assert integrator.kernel_plan(replace(facts, lights=2**11 + 1)).reason("buffers") is Reason.MANY_PAIRS


def test_no_lists_for_the_eye_of_too_many_objects() -> None:
    loaded = scene(a=GROUP)
    integrator = loaded.integrator()
    facts = replace(integrator.scene_facts(loaded), quadrics=(("sphere", 2**14), ("cone", 1)))
    assert integrator.kernel_plan(facts).reason("eye") is Reason.MANY_OBJECTS


def test_materials_of_the_objects_of_a_group_are_looked_up_in_the_table() -> None:
    """As by a call to the BSDF, next to other shapes; not where a texture varies over an object."""
    loaded = scene(a=GROUP, b=SPHERE, c={**GROUP, "bsdf": MATTE}, light=LIGHT)
    integrator = loaded.integrator()
    plan = integrator.prepare(loaded).plan
    assert plan.merged and not plan.textures
    table = np.array(mi.render(loaded, spp=4, seed=1))
    integrator.prepare(loaded, replace(plan, merged=False))
    np.testing.assert_allclose(table, np.array(mi.render(loaded, spp=4, seed=1)), atol=1e-6)
    attribute = {"type": "mesh_attribute", "name": "vertex_gloss"}
    for texture in (TEXTURE, attribute):
        other = {**GROUP, "bsdf": {"type": "mrt_bsdf", "specular_reflectance": texture}}
        assert plan_of(a=other).reason("merged") is Reason.VARYING


def test_a_plan_holds_until_the_scene_changes() -> None:
    loaded = scene(a=SPHERE, light=LIGHT)
    integrator = loaded.integrator()
    own = replace(integrator.prepare(loaded).plan, merged=False)
    assert integrator.prepare(loaded, own).plan == integrator.prepare(loaded).plan == own
    parameters = mi.traverse(loaded)
    parameters["a.bsdf.alpha"] = mi.Float(0.3)
    parameters.update()
    assert integrator.prepare(loaded).plan.merged
