"""``register()``: once and for all variants, whatever the order of the switches between them.

Each test has a process of its own, since what is registered stays so until a process ends.
"""

from __future__ import annotations

import pytest

from mrt_mitsuba import runtime

pytestmark = pytest.mark.skipif(
    runtime.obstacle(runtime.FAST) is not None, reason="no second kind of variant without LLVM"
)

# Draws one lit pixel of an mrt_plane with an mrt_bsdf under an mrt_light; what each variant should see of it
DRAW = """
import mrt_mitsuba
import mitsuba as mi

def scene(integrator):
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene", "integrator": {"type": integrator},
        "sensor": {"type": "perspective", "fov": 0.1, "to_world": look, "film": {
            "type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance",
            "component_format": "float32", "rfilter": {"type": "box"}}},
        "light": {"type": "mrt_light", "position": [0, 3, 4], "intensity": {"type": "rgb", "value": 1.0}},
        "plane": {"type": "mrt_plane", "normal": [0, 0, 1], "bsdf": {
            "type": "mrt_bsdf", "alpha": 0.01, "diffuse_reflectance": {"type": "rgb", "value": 0.5}}},
    }

def pixel(made):
    return float(mi.TensorXf(mi.render(made, spp=1)).array[0])

def draws(*integrators):
    # 0.5 / pi * 0.8, diffuse only: the lobe is too narrow. The pixel is 9e-3 wide; spectral variants sample
    tolerance = 0.1 if mi.is_spectral else 2e-3
    for integrator in integrators:
        value = pixel(mi.load_dict(scene(integrator)))
        assert abs(value / 0.127324 - 1) < tolerance, (mi.variant(), integrator, value)
"""


def lines(run_python, code: str, *arguments: str) -> list[str]:
    done = run_python(DRAW + code, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_is_idempotent_and_needs_a_variant(run_python):
    """Functions under ``dr.syntax`` are rewritten when they are called; the decorator is again Dr.Jit's."""
    code = """
import drjit as dr
from mrt_mitsuba import plugins
before = dr.syntax
try:
    plugins.register()
except RuntimeError as error:
    print("no-variant" if "no Mitsuba variant is set" in str(error) else error)
for _ in range(3):
    mrt_mitsuba.register()
    plugins.register()
first = plugins.plugin("bsdf").MrtBSDF
plugins.register()
assert plugins.plugin("bsdf").MrtBSDF is first
assert isinstance(mi.load_dict({"type": "mrt_bsdf"}), first)
draws("direct", "mrt_whitted")
assert dr.syntax is before
for _ in range(2):
    counted = dr.ast._syntax_counter
    draws("prb")
    print(dr.ast._syntax_counter - counted)  # of those that are called, and once
"""
    assert lines(run_python, code) == ["no-variant", "1", "0"]


@pytest.mark.parametrize(
    "order",
    [("scalar_rgb", "llvm_ad_rgb", "llvm_ad_spectral"), ("llvm_ad_spectral", "scalar_rgb", "llvm_ad_rgb")],
)
def test_plugins_follow_every_order_of_switches(run_python, order):
    """Registered in the first; there after each switch, also back, under stock integrators and ours."""
    code = """
import sys
variants = sys.argv[1:]
mi.set_variant(variants[0])
mrt_mitsuba.register()
for variant in [*variants, *variants]:
    mi.set_variant(variant)
    draws("direct", "path", "mrt_whitted")
print("done")
"""
    assert lines(run_python, code, *order) == ["done"]


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_a_module_is_imported_once_when_a_scene_needs_it(run_python, variant):
    """By whichever thread of Mitsuba's parallel loader comes first, and for each variant."""
    code = """
import sys
mi.set_variant(sys.argv[1])
mrt_mitsuba.register(guard=False)
from mrt_mitsuba import plugins
print(plugins.any_loaded())
many = {"type": "scene"}
for k in range(40):
    many[f"light_{k}"] = {"type": "mrt_light", "position": [0, k, 0]}
    many[f"plane_{k}"] = {"type": "mrt_plane", "normal": [0, 1, 0], "bsdf": {"type": "mrt_bsdf"}}
made = mi.load_dict(many, parallel=True)
classes = {type(thing) for s in made.shapes() for thing in (s, s.bsdf())}
classes |= {type(light) for light in made.emitters()}
print(*sorted(each.__name__ for each in classes))
print(len(plugins.classes_of("quadrics")), plugins.classes_of("lights")[0] in classes)
"""
    assert lines(run_python, code, variant) == ["False", "MrtBSDF", "MrtLight", "MrtPlane", "0", "True"]
