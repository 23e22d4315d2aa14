"""``check_scene`` and ``mrt check``: every plugin of a scene, and the pixel that is no number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.command import main as cli

pytestmark = pytest.mark.usefixtures("variant")

SCENE = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="24"/><integer name="height" value="16"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant" id="sky"/>
    <shape type="sphere" id="ball"><bsdf type="{bsdf}" id="paint"/></shape>
</scene>"""


def poisoned() -> None:
    """Register a diffuse BSDF that is no number where it is seen at less than 6 degrees from the normal."""

    class Poisoned(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return dr.select((si.wi.z > 0) & (wo.z > 0), dr.inv_pi * wo.z, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            poison = dr.select(si.wi.z > 0.995, dr.nan, 0.5)
            lit = active & (si.wi.z > 0) & (wo.z > 0)
            return mi.Spectrum(dr.select(lit, poison * dr.inv_pi * wo.z, 0))

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            bs = mi.BSDFSample3f()
            bs.wo, bs.eta = mi.warp.square_to_cosine_hemisphere(sample2), mi.Float(1)
            bs.pdf = self.pdf(ctx, si, bs.wo, active)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            bs.sampled_component = mi.UInt32(0)
            return bs, mi.Spectrum(dr.select(bs.pdf > 0, 0.5, 0))

    mi.register_bsdf("poisoned", Poisoned)


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    """Writes the scene with a BSDF on its ball."""

    def write(bsdf: str) -> str:
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(bsdf=bsdf))
        return str(path)

    return write


def test_a_sound_scene(scene, capsys, tmp_path: Path) -> None:
    assert cli.main(["check", f"scene={scene('diffuse')}", "quick=1", f"out={tmp_path / 'out'}"]) == 0
    printed = capsys.readouterr().out
    for name in ("BSDF SmoothDiffuse paint", "shape Sphere ball", "emitter ConstantBackgroundEmitter sky"):
        assert f"{name} in llvm_ad_rgb: passed" in printed
    assert "every pixel is finite" in printed
    assert "SmoothDiffuse paint" in (tmp_path / "out" / "index.html").read_text()


def test_the_pixel_and_its_object_are_found(scene, capsys) -> None:
    poisoned()
    path = scene("poisoned")
    found = mrt.check_scene(path, quick=True)
    assert set(found.failed) == {"BSDF Poisoned paint: finite", "pixels"}, str(found)
    assert found.fault.crop[2:] == (1, 1)
    assert found.fault.culprit == "the BSDF Poisoned 'paint', on Sphere 'ball'"
    x, y = found.fault.crop[:2]
    assert abs(x - 12) <= 2 and abs(y - 8) <= 2  # the middle of the picture is seen along the normal
    assert cli.main(["check", path, "quick=1"]) == 1
    assert "the smallest crop: 1x1" in capsys.readouterr().out
    assert "Made by the BSDF" in found._repr_html_()


def test_a_light_that_is_no_number_and_instances() -> None:
    group, place = (
        {"type": "shapegroup", "a": {"type": "sphere"}},
        mi.ScalarTransform4f().translate([0, 0, -3]),
    )
    nodes = {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "group": group,
        "one": {"type": "instance", "to_world": place, "g": {"type": "ref", "id": "group"}},
        "ball": {"type": "sphere", "center": [0, 0, 4]},
        "lamp": {"type": "point", "intensity": {"type": "rgb", "value": float("nan")}},
    }
    found = mrt.check_scene(mi.load_dict(nodes), quick=True)
    assert found.failed == ["emitter PointLight lamp: finite", "pixels"], str(found)
    assert found.fault.culprit == "the emitter PointLight 'lamp'"
    assert found.left_out == ("1 instances are not checked: give a dict of one with its group",)
    assert mrt.check_shape({"type": "instance", "to_world": place, "g": group}, quick=True).failed == [
        "scale"
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "SCENE|scene=PATH is missing"),
        (["3", "scene=a.xml"], "unexpected argument 'a.xml'"),
        (["3", "quick=yes"], "must be 0 or 1"),
        (["3", "fast=1"], "unknown option 'fast'"),
        (["99"], "99"),
        (["scene=none.xml"], "no such file"),
    ],
)
def test_wrong_usage(arguments: list[str], message: str, capsys) -> None:
    assert cli.main(["check", *arguments]) == 2
    assert message in capsys.readouterr().err
