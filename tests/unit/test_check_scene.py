"""``check_scene`` and ``mrt check``: every plugin of a scene, and the pixel that is no number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.validation.studies.power import changed_bsdf

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
    <shape type="sphere" id="ball">{bsdf}</shape>
</scene>"""


def poisoned() -> None:
    """Register a diffuse BSDF that is no number where it is seen at less than 6 degrees from the normal."""

    def poison(value: Any, ctx: Any, wi: Any, wo: Any) -> Any:
        return dr.select((wi.z > 0.995) & (value != 0), dr.nan, value)

    changes = {"poison": ({"type": "diffuse"}, "eval", poison)}
    mi.register_bsdf("poisoned", changed_bsdf(changes))


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    """Writes the scene with a BSDF on its ball."""
    poison = '<string name="change" value="poison"/><bsdf type="diffuse" name="nested"/>'
    inside = {"diffuse": "", "poisoned": poison}

    def write(bsdf: str) -> str:
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(bsdf=f'<bsdf type="{bsdf}" id="paint">{inside[bsdf]}</bsdf>'))
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
    assert set(found.failed) == {"BSDF Changed paint: finite", "pixels"}, str(found)
    assert found.fault.crop[2:] == (1, 1)
    assert found.fault.culprit == "the BSDF Changed 'paint', on Sphere 'ball'"
    x, y = found.fault.crop[:2]
    assert abs(x - 12) <= 2 and abs(y - 8) <= 2  # the middle of the picture is seen along the normal
    assert cli.main(["check", path, "quick=1"]) == 1
    assert "the smallest crop: 1x1" in capsys.readouterr().out
    assert "Made by the BSDF" in found._repr_html_()


def test_a_light_that_is_no_number_and_instances() -> None:
    group = {"type": "shapegroup", "a": {"type": "sphere"}}
    place = mi.ScalarTransform4f().translate([0, 0, -3])
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
    instance = {"type": "instance", "to_world": place, "g": group}
    assert mrt.check_shape(instance, quick=True).failed == ["scale"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["3", "fast=1"], "unknown option 'fast'"),
        (["99"], "99"),
        (["scene=none.xml"], "no such file"),
    ],
)
def test_wrong_usage(arguments: list[str], message: str, capsys) -> None:
    assert cli.main(["check", *arguments]) == 2
    assert message in capsys.readouterr().err
