"""What holds of every plugin of the table."""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import documented, example, sensor
from numpy.testing import assert_allclose

from mrt_mitsuba import plugins
from mrt_mitsuba.plugins.table import PLUGINS, Plugin

pytestmark = pytest.mark.usefixtures("variant")

each_plugin = pytest.mark.parametrize("row", PLUGINS, ids=lambda row: row.name)


@each_plugin
def test_every_row_is_registered_and_has_a_place_or_a_reason(row):
    made = mi.load_dict(example(row))
    assert type(made) is plugins.class_of(row)
    assert type(made).__module__.startswith("mrt_mitsuba.plugins.")
    assert plugins.is_known(made)
    assert isinstance(made, getattr(mi, {"bsdf": "BSDF"}.get(row.kind, row.kind.title())))


def drawn(scene: dict[str, Any]) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene), spp=1))


# Some that Mitsuba's own classes read, so that it does not report them as unused
SHARED = ("to_world", "flip_normals", "face_normals", "hide_emitters", "to_uv", "bogus")
USED = {row.name: {"to_world", "flip_normals"} for row in PLUGINS if row.table == "quadrics"}
USED |= {
    "mrt_mesh": {"to_world", "flip_normals", "face_normals"},
    "mrt_plane": {"flip_normals", "face_normals"},
}


@each_plugin
@pytest.mark.parametrize("name", SHARED)
def test_a_parameter_is_used_or_refused(row, name):
    value = True if "_" in name else 1.0
    if name == "to_world":
        value = mi.ScalarTransform4f().translate([0.3, 0.2, 0.1]).scale(0.7)
    if name not in USED.get(row.name, ()):
        with pytest.raises(Exception, match=name):
            mi.load_dict(example(row, **{name: value}))
        return
    if name == "face_normals":  # it is flat anyway
        return
    pictures = []
    for given in ({}, {name: value}):
        nodes = {"type": "scene", "integrator": {"type": "mrt_whitted"}}
        nodes["sensor"] = sensor([0.5, 1.5, 4], [0, 0, 0], (24, 16))
        nodes["light"] = {"type": "mrt_light", "position": [1, 4, 5]}
        nodes["thing"] = example(row, **given, bsdf={"type": "mrt_bsdf", "alpha": 0.4})
        pictures.append(drawn(nodes))
    assert abs(pictures[0] - pictures[1]).max() > 1e-3


in_both = pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)


def another(value: Any) -> Any:
    """Another value of the same type: nearer to 0, and so in most ranges, or 0.5 in place of 0."""
    return type(value)(dr.select(value == 0, 0.5, 0.7 * value))


# Read when the plugin is made, and never again
FIXED = {"mrt_plane": {"normal", "distance", "extent"}, "mrt_whitted": {"sky", "min_contribution"}}


def numbers_in_traverse(row: Plugin) -> list[str]:
    """Return the parameters of numbers that the plugin's documentation names, without those of ``FIXED``."""
    kinds = ("float", "point", "vector", "spectrum")
    names = [name for name, kind in documented(row).items() if kind in kinds]
    assert FIXED.get(row.name, set()) <= set(names)
    return [name for name in names if name not in FIXED.get(row.name, ())]


def optional(name: str) -> dict[str, float]:
    """A parameter that is there only where it has a value, with one."""
    return {name: 0.3} if name == "f0" else {}


def room(row: Plugin, integrator: str, **more: Any) -> dict[str, Any]:
    """A hollow ball with a plugin, the "thing"; from its wall one sees all that shines out of its centre."""
    ball = {"type": "sphere", "radius": 4, "flip_normals": True}
    nodes = {"type": "scene", "integrator": {"type": integrator}, "ball": ball}
    nodes["sensor"] = sensor([2.2, 2.2, 2.2], [0, 0, 0], (24, 16), fov=140)
    thing = example(row, **more)
    if row.kind == "bsdf":
        ball["bsdf"] = thing
    else:
        nodes["thing"] = thing
    if row.kind != "emitter":
        nodes["light"] = {"type": "point", "position": [1, 2, 0.5], "intensity": 9}
    return nodes


def set_another(scene: mi.Scene, name: str) -> float | list[float]:
    """Give the plugin another value of a parameter, as plain numbers, and return it."""
    parameters = mi.traverse(scene)
    keys = [key for key in dict(parameters) if re.search(rf"\b(bsdf|thing)\.{name}(\.value)?$", key)]
    assert keys, f"traverse leaves out {name}"
    numbers = np.ravel(another(parameters[keys[0]])).tolist()
    value = numbers if len(numbers) > 1 else numbers[0]
    parameters[keys[0]] = value
    parameters.update()
    return value


@in_both
@pytest.mark.parametrize("integrator", ["direct", "mrt_whitted"])
@each_plugin
def test_a_number_that_was_set_is_that_of_a_new_plugin(row, integrator, variant):
    for name in numbers_in_traverse(row):
        scene = mi.load_dict(room(row, integrator, **optional(name)))
        old = np.array(mi.render(scene, spp=1))
        new = drawn(room(row, integrator, **{name: set_another(scene, name)}))
        assert abs(new - old).max() > 1e-3, f"{name} changes nothing that room shows: another sample may"
        assert_allclose(np.array(mi.render(scene, spp=1)), new, atol=1e-5)  # vertices in float32


@each_plugin
def test_a_number_that_is_set_needs_no_new_kernel(row):
    """Numbers are data of the kernels, whichever integrator draws them."""
    for name in numbers_in_traverse(row):
        scene = mi.load_dict(room(row, "direct", **optional(name)))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for _ in range(3):
                dr.kernel_history_clear()
                set_another(scene, name)
                dr.eval(mi.render(scene, spp=1))
        kernels = dr.kernel_history([dr.KernelType.JIT])  # of the last value and picture
        assert kernels
        assert all(kernel["cache_hit"] and not kernel["cache_disk"] for kernel in kernels)


def test_derivatives_by_shapes_warn_once(capfd):
    """AD gives +0.012 where differences give -0.160: what moves the outline is left out."""
    nodes = {"type": "scene", "integrator": {"type": "mrt_whitted", "max_depth": 1}}
    nodes["sensor"] = sensor([0, 0, 6], [0, 0, 0], (16, 12))
    nodes["light"] = {"type": "mrt_light", "position": [3, 5, 5]}
    nodes["thing"] = {"type": "mrt_cone", "apex": [0, 1, 0], "base_center": [0, -1, 0]}
    scene = mi.load_dict(nodes)
    parameters = mi.traverse(scene)
    mi.render(scene, spp=1)
    assert "outlines" not in "".join(capfd.readouterr())
    for _ in range(2):
        dr.enable_grad(parameters["thing.radius"])
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, spp=1).array))
    assert "".join(capfd.readouterr()).count("leave out how outlines") == 1
