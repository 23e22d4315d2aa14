"""The plan decides: what it shows is what the kernels hold and which passes run, no more and no less."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from cases import Cases
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.rendering.settings import TABLE

pytestmark = pytest.mark.usefixtures("variant")

MATTE = {"type": "mrt_bsdf", "specular_reflectance": 0.0}
LIGHT = {"type": "mrt_light", "position": [3, 5, 2], "intensity": 1.0}
BALL = {"type": "sphere", "center": [0, 0, -4], "bsdf": MATTE}


def scene(**nodes: Any) -> dict[str, Any]:
    """Two balls under a lamp and the sky, with nodes put in."""
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}
    common = {"type": "scene", "integrator": {"type": "mrt_whitted"}, "light": LIGHT, "ball": BALL}
    common["sensor"] = {"type": "perspective", "film": film}
    common["sky"] = {"type": "constant", "radiance": 0.3}
    common["second"] = {**BALL, "center": [2, 0, -5]}  # a lookup among one needs no code
    return common | nodes


class Watch(Progress):
    """Keeps the text of each kernel, by its number of operations."""

    def __init__(self) -> None:
        self.found: dict[str, int] = {}

    def kernels(self, records: Any) -> None:
        own = (record for record in records if record["type"] == dr.KernelType.JIT)
        self.found |= {record["ir"].getvalue(): record["operation_count"] for record in own}


def planned(nodes: dict[str, Any], **options: Any) -> tuple[mrt.Result, str]:
    """Render; return the result and the kernel that traced the rays: the longest."""
    watch = Watch()
    result = mrt.render(nodes, **{"aa": 1, "aamode": "none", "progress": watch} | options)
    return result, max(watch.found, key=lambda text: watch.found[text])


@pytest.fixture
def base() -> tuple[mrt.Result, str]:
    return planned(scene())


alike = Cases()
alike({"ball": {**BALL, "radius": 0.5}, "light": {**LIGHT, "intensity": 3.0}}, {})
alike({"third": {**BALL, "center": [4, 0, -5], "bsdf": {**MATTE, "alpha": 0.3}}}, {})
alike({"sky": {"type": "constant", "radiance": 0.9}}, {"seed": 3})
alike({}, {"focaldist": 0.0})
alike({}, {"spp": 2})


@pytest.mark.parametrize(("nodes", "options"), alike)
def test_what_no_decision_depends_on_leaves_the_kernel(nodes, options, base):
    """Numbers are data: places, colours, how many spheres."""
    result, kernel = planned(scene(**nodes), **options)
    assert result.plan.kernel == base[0].plan.kernel
    assert kernel == base[1]


def test_what_the_integrator_does_not_say_is_not_made_up():
    plan = planned(scene(), integrator="direct")[0].plan
    assert plan.kernel is None
    assert not any("shadow" in what for what, _ in plan.left_out)


shown = Cases()
shown({"aamode": "none", "focaldist": 0}, "16 samples per pixel")
shown({"aamode": "none"}, "16 samples per pixel, with depth; depth of field: report")
shown(
    {"aamode": "none", "lattice": "centered"},
    "first hits: 1 ray through each pixel's centre, with depth; 16 samples per pixel; depth of field: report",
)
shown({"focaldist": 0, "aa": 2}, "1 sample per pixel; edge detection: sobel; 3 more samples in edge pixels")
shown(
    {"focaldist": 0, "aa": 2, "lattice": "centered", "aamode": "geometry"},
    "1 sample per pixel, with depth, normal; edge detection: geometry; 4 more samples in edge pixels",
)
shown({"focaldist": 0, "aa": 1}, "1 sample per pixel")
shown({"focaldist": 0, "aa": 1, "layers": ["edges"]}, "1 sample per pixel; edge detection: sobel")


@pytest.mark.parametrize(("options", "passes"), shown)
def test_the_plan_shows_the_passes_that_run(options, passes):
    result = mrt.render(3, width=16, height=12, **options)
    lines = str(result.plan).splitlines()
    assert "; ".join(line.removeprefix("  pass    ") for line in lines if "  pass" in line) == passes
    assert list(result.timings.passes) == [step.name for step in result.plan.passes]


UNSEEN = {"memory"}  # it decides how many rays are traced at once, which no picture shows
# A value of each other option that makes a difference
VALUES = {
    "width": 20,
    "height": 20,
    "aa": 1,
    "aamode": "none",
    "target": 0.5,
    "metric": "display",
    "denoise": True,
    "maxspp": 64,
    "integrator": "path",
    "maxseconds": 60,
    "lattice": "centered",
    "fresnel": "dielectric",
    "focaldist": 1,
    "focalrange": 9,
    "dof": "corrected",
    "layers": ["normal"],
    "motion": (1, 0, 0),
    "motionsamples": 3,
    "convention": "standard",
    "camera": (0.5, 0.5, 2),
    "up": (1, 0, 0),
    "fov": 20,
    "variant": "scalar_rgb",
    "seed": 1,
    "sensor": 1,
    "spp": 2,
}
TARGET = {"target": 0.9}
MOTION = {"motion": (1, 0, 0)}
MODEL = {"scene": "model.obj"}
IN_FRONT = scene(ball={**BALL, "center": [0, 0, 4]})
# What an option needs to make a difference; the others make one in scene 3
NEEDED = {
    "metric": TARGET,
    "denoise": {**TARGET, "focaldist": 0},
    "maxspp": TARGET,
    "maxseconds": TARGET,
    "motionsamples": MOTION,
    "convention": MODEL,
    "camera": MODEL,
    "up": MODEL,
    "fov": MODEL,
    "variant": {"aa": 1},
    "seed": {"integrator": "path"},
    "sensor": {"scene": {**IN_FRONT, "tele": {**IN_FRONT["sensor"], "fov": 20}}},
}


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A triangle with a texture and a mirror, as model.obj in the current folder."""
    monkeypatch.chdir(tmp_path)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    Path("model.obj").write_text(f"mtllib model.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3\n")
    Path("model.mtl").write_text("newmtl m\nKd 1 1 1\nKs 1 1 1\nNi 0.4\nmap_Kd model.png\n")
    Image.fromarray(np.array([[0, 90], [180, 250]], np.uint8)).convert("RGB").save("model.png")


@pytest.mark.parametrize("name", sorted(TABLE.keys() - UNSEEN))
@pytest.mark.usefixtures("model")
def test_every_option_makes_a_difference(name):
    """To the text of the plan or to the picture."""
    assert name in VALUES, f"VALUES has no value of {name} that makes a difference"
    options = {"scene": 3, "width": 16, "height": 12} | NEEDED.get(name, {})
    before = mrt.render(**options)
    after = mrt.render(**options | {name: VALUES[name]})
    same = str(before.plan) == str(after.plan) and np.array_equal(before.image, after.image)
    assert not same, f"{name}={VALUES[name]} makes no difference"
