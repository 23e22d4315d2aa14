"""The plan decides: what it shows is what the kernels hold and which passes run, no more and no less."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.plugins.kernel_plan import KernelPlan
from mrt_mitsuba.rendering.plan import Plan
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.rendering.settings import RenderSettings

pytestmark = pytest.mark.usefixtures("variant")

# ------------------------------------------------ Kernels ------------------------------------------------

MATTE = {"type": "mrt_bsdf", "specular_reflectance": 0.0}
GLOSSY = {"type": "mrt_bsdf", "specular_reflectance": 0.9, "int_ior": 3.0}
DIFFUSE = {"type": "diffuse"}
BRUSHED = {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.3}
LIGHT = {"type": "mrt_light", "position": [3, 5, 2], "intensity": 1.0}
BALL = {"type": "sphere", "center": [0, 0, -4], "bsdf": MATTE}
CONE = {"type": "mrt_cone", "apex": [0, 1, -4], "base_center": [0, 0, -4], "radius": 0.5, "bsdf": MATTE}
ROD = {"type": "mrt_cylinder", "p0": [0, 1, -4], "p1": [0, 0, -4], "radius": 0.5, "bsdf": MATTE}
PANE = {"type": "rectangle", "bsdf": MATTE}
LAMP = {"type": "sphere", "center": [0, 4, -4], "emitter": {"type": "area", "radiance": 5.0}}
FLOOR = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0, "bsdf": MATTE}


def scene(**nodes: Any) -> dict[str, Any]:
    """Two balls under a lamp and the sky, with nodes put in, or taken out where they are None."""
    base = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": {
            "type": "perspective",
            "film": {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}},
        },
        "sky": {"type": "constant", "radiance": 0.3},
        "light": LIGHT,
        "ball": BALL,
        "second": {**BALL, "center": [2, 0, -5]},  # a lookup among one needs no code
    }
    return {name: node for name, node in (base | nodes).items() if node is not None}


class Watch(Progress):
    """Keeps the text of each kernel, by its number of operations."""

    def __init__(self) -> None:
        self.found: dict[str, int] = {}

    def kernels(self, records: Any) -> None:
        own = (record for record in records if record["type"] == dr.KernelType.JIT)
        self.found |= {record["ir"].getvalue(): record["operation_count"] for record in own}


def watched(nodes: dict[str, Any], **options: Any) -> tuple[mrt.Result, dict[str, int]]:
    """Render; return the result and the kernels with their numbers of operations."""
    watch = Watch()
    return mrt.render(nodes, **{"aa": 1, "aamode": "none", "progress": watch} | options), watch.found


def planned(nodes: dict[str, Any], **options: Any) -> tuple[mrt.Result, str]:
    """Render; return the result and the kernel that traced the rays: the longest."""
    result, kernels = watched(nodes, **options)
    return result, max(kernels, key=lambda text: kernels[text])


def painted() -> dict[str, Any]:
    return {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.3, np.float32))}


def textured() -> dict[str, Any]:
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}
    return {**BALL, "bsdf": {**MATTE, "diffuse_reflectance": picture}}


# Each decision with a change of the scene that turns it
CHANGES: dict[str, tuple[str, dict[str, Any]]] = {
    "bvh": ("bvh", {"ball": None, "second": None, "cone": CONE}),
    "coherent": ("coherent", {"box": {"type": "cube", "bsdf": MATTE}}),
    "shading normals": ("shading_frames", {"box": {"type": "cube", "bsdf": MATTE}}),
    "a sphere facing inwards": ("spheres", {"ball": {**BALL, "flip_normals": True}}),
    "no sphere": ("spheres", {"ball": PANE, "second": PANE}),
    "a cone": ("quadrics", {"cone": CONE}),
    "an open cone": ("quadrics", {"cone": {**CONE, "capped": False}}),
    "two kinds of quadrics": ("quadrics", {"cone": CONE, "rod": ROD}),
    "planes": ("planes", {"floor": FLOOR}),
    "no light": ("lights", {"light": None}),
    "many lights": ("lights", {f"light_{i}": {**LIGHT, "position": [i, 5, 2]} for i in range(8)}),
    "many spheres": ("buffers", {f"ball_{i}": {**BALL, "center": [i, 0, -9]} for i in range(64)}),
    "a light on a sphere": ("touching", {"ball": BALL, "light": {**LIGHT, "position": [0, 1, -4]}}),
    "random": ("random", {"lamp": LAMP}),
    "emission": ("emission", {"lamp": LAMP}),
    "no sky": ("sky", {"sky": None}),
    "mirrors": ("mirrors", {"ball": {**BALL, "bsdf": GLOSSY}}),
    "mirror rays": ("mirror_rays", {"ball": {**BALL, "bsdf": GLOSSY}}),
    "a cut-off": ("cut_off", {"ball": {**BALL, "bsdf": GLOSSY}}),
    "a guard": ("guarded", {"ball": {**BALL, "bsdf": {**GLOSSY, "specular_reflectance": 1e5}}}),
    "lobes": ("lobes", {"ball": {**BALL, "bsdf": GLOSSY}}),
    "textures": ("textures", {"ball": textured}),
    "tangents": ("tangents", {"ball": {**BALL, "bsdf": BRUSHED}}),
    "merged": ("merged", {"ball": {**BALL, "bsdf": DIFFUSE}}),
    "two-sided": ("two_sided", {"ball": {**BALL, "bsdf": {"type": "twosided", "bsdf": DIFFUSE}}}),
    "a sky of the integrator": ("sky", {"integrator": {"type": "mrt_whitted", "sky": 0.3}}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_decision_that_the_plan_shows_changes_the_kernel(change: str) -> None:
    decision, nodes = CHANGES[change]
    # a sky of one colour is the same code wherever it comes from
    common = {"sky": painted()} if "integrator" in nodes else {}
    nodes = {name: node() if callable(node) else node for name, node in nodes.items()}
    before, after = planned(scene(**common)), planned(scene(**common, **nodes))
    plans = before[0].plan, after[0].plan
    assert getattr(plans[0].kernel, decision) != getattr(plans[1].kernel, decision)
    shown = [set(str(plan).splitlines()) for plan in plans]
    assert shown[0] - shown[1] and shown[1] - shown[0]
    assert before[1] != after[1]


def test_every_decision_is_turned() -> None:
    decisions = {field.name for field in fields(KernelPlan)} - {"reasons"}
    assert {decision for decision, _ in CHANGES.values()} == decisions


@pytest.fixture
def base() -> tuple[mrt.Result, str]:
    return planned(scene())


@pytest.mark.parametrize(
    ("nodes", "options"),
    [
        ({"ball": {**BALL, "radius": 0.5}, "light": {**LIGHT, "intensity": 3.0}}, {}),
        ({"third": {**BALL, "center": [4, 0, -5], "bsdf": {**MATTE, "alpha": 0.3}}}, {}),
        ({"sky": {"type": "constant", "radiance": 0.9}}, {"seed": 3}),
        ({}, {"focaldist": 0.0}),
    ],
)
def test_what_no_decision_depends_on_leaves_the_kernel(
    nodes: dict[str, Any], options: dict[str, Any], base: tuple[mrt.Result, str]
) -> None:
    """Numbers are data: places, colours, how many spheres."""
    result, kernel = planned(scene(**nodes), **options)
    assert result.plan.kernel == base[0].plan.kernel
    assert kernel == base[1]


TENT = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "tent"}}

# What turns fields of the plan and, with them, kernels: nodes, options, and the fields
TURNS: list[tuple[dict[str, Any], dict[str, Any], set[str]]] = [
    ({}, {"layers": ["depth"]}, {"layers", "passes"}),
    ({}, {"layers": ["normal"]}, {"layers", "passes"}),
    ({}, {"count_rays": True}, {"passes"}),
    ({}, {"motion": [0.1, 0, 0]}, {"motion"}),
    ({}, {"focaldist": 3.0}, {"focus", "blur", "passes"}),
    ({}, {"aamode": "geometry", "aa": 2}, {"detector", "passes"}),
    ({}, {"lattice": "report"}, {"lattice"}),
    ({}, {"integrator": "direct"}, {"integrator", "traceable", "random", "kernel"}),
    ({}, {"variant": "llvm_ad_mono"}, {"variant"}),
    ({"sensor": {"type": "perspective", "film": TENT}}, {}, {"film"}),
    ({}, {"width": 20, "height": 14}, {"width", "height"}),  # constants to Mitsuba's ``ImageBlock``
]
# Numbers that kernels take as data, and what follows from other fields
DATA = {"scene", "region", "repeats", "motion_samples", "parts", "left_out"}


@pytest.mark.parametrize(("nodes", "options", "turned"), TURNS, ids=lambda x: ",".join(sorted(x)))
def test_what_turns_the_plan_turns_kernels(
    nodes: dict[str, Any], options: dict[str, Any], turned: set[str]
) -> None:
    (before, kernels), (after, other_kernels) = watched(scene()), watched(scene(**nodes), **options)
    assert kernels.keys() != other_kernels.keys()
    assert all(getattr(before.plan, name) != getattr(after.plan, name) for name in turned)
    assert str(before.plan) != str(after.plan)


@pytest.mark.parametrize(
    ("common", "change"),
    [({}, {"region": (2, 2, 8, 6)}), ({"motion": [0.1, 0, 0]}, {"motionsamples": 5}), ({}, {"spp": 2})],
)
def test_numbers_of_the_plan_are_data(common: dict[str, Any], change: dict[str, Any]) -> None:
    before, after = planned(scene(), **common), planned(scene(), **common | change)
    assert before[0].plan != after[0].plan and before[1] == after[1]


def test_every_field_of_the_plan_turns_a_kernel_or_is_data() -> None:
    turned = set().union(*(names for _, _, names in TURNS))
    assert turned.isdisjoint(DATA) and turned | DATA == {field.name for field in fields(Plan)}


def test_what_the_integrator_does_not_say_is_not_made_up() -> None:
    plan = planned(scene(), integrator="direct")[0].plan
    assert plan.kernel is None and not any("shadow" in omission.what for omission in plan.left_out)


# ------------------------------------------------ Passes -------------------------------------------------


@pytest.mark.parametrize(
    ("options", "passes"),
    [
        ({"aamode": "none", "focaldist": 0}, ["16 samples a pixel"]),
        (
            {"aamode": "none", "lattice": "centered"},
            [
                "first hits: 1 ray through the centre of a pixel, with depth",
                "16 samples a pixel",
                "depth of field: report",
            ],
        ),
        ({"aamode": "none"}, ["16 samples a pixel, with depth", "depth of field: report"]),
        ({"focaldist": 0, "aa": 2}, ["1 sample a pixel", "edges: sobel", "3 further samples in edge pixels"]),
        (
            {"focaldist": 0, "aa": 2, "lattice": "centered", "aamode": "geometry"},
            ["1 sample a pixel, with depth, normal", "edges: geometry", "4 further samples in edge pixels"],
        ),
        ({"focaldist": 0, "aa": 1}, ["1 sample a pixel"]),
        ({"focaldist": 0, "aa": 1, "layers": ["edges"]}, ["1 sample a pixel", "edges: sobel"]),
    ],
)
def test_the_plan_shows_the_passes_that_run(options: dict[str, Any], passes: list[str]) -> None:
    result = mrt.render(3, width=16, height=12, **options)
    assert [
        line.removeprefix("  pass    ") for line in str(result.plan).splitlines() if "  pass" in line
    ] == passes
    assert list(result.timings.passes) == [step.name for step in result.plan.passes]


def test_settings_are_the_options_of_render() -> None:
    """One table: what ``render`` takes is what ``RenderSettings`` checks, with the same defaults."""
    taken = dict(inspect.signature(mrt.render).parameters)
    assert {name: taken.pop(name).default for name in ("scene", "progress")} == {"scene": 0, "progress": None}
    held = {field.name: field.default for field in fields(RenderSettings)}
    assert {name: parameter.default for name, parameter in taken.items()} == held


NEW_LAYER = """
import mrt_mitsuba as mrt
from mrt_mitsuba.output import layers, read_exr

row = layers.Layer("tangent", "XYZ", layers.FIRST_HIT, "tangent along u", lambda r: r.si.sh_frame.s)
layers.TABLE["tangent"] = layers.LAYERS["tangent"] = row
for integrator in ("mrt_whitted", "path"):
    result = mrt.render(9, width=8, height=6, layers=["tangent"], integrator=integrator, seed=1)
    result.save("a.exr")
    assert {"tangent.X", "tangent.Y", "tangent.Z"} <= read_exr("a.exr").layers.keys()
    assert "with tangent" in str(result.plan)
from mrt_mitsuba.command.listings import usage
assert "tangent" in usage()
"""


def test_a_new_layer_takes_one_row(run_python) -> None:
    """Plan, tracer, files and help read it from there."""
    done = run_python(NEW_LAYER)
    assert done.returncode == 0, done.stderr
