"""Scenes as dicts and XML: the files are up to date, mean the same, and the stock flavour needs no plugin of ours."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.export import FLAVORS, write_xml, xml_text
from mrt_mitsuba.scenes_xml import NUMBERS, path


@pytest.fixture(autouse=True)
def llvm():
    mrt.register()
    mi.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize("flavor", FLAVORS)
@pytest.mark.parametrize("number", NUMBERS)
def test_files_are_what_the_dicts_give(number, flavor):
    """``python -m mrt_mitsuba.scenes_xml`` writes them anew; the writer's version line may differ."""

    def body(text: str) -> str:
        return re.sub(r'<scene version="[^"]*">', "<scene>", text)

    assert body(path(number, flavor).read_text()) == body(xml_text(number, flavor=flavor))


@pytest.mark.parametrize("number", NUMBERS)
def test_xml_renders_the_same_picture_as_the_dict(number):
    """Numbers are written with 17 digits: nothing may change, not even the last bit."""
    scene = mi.load_dict(mrt.scene_dict(number, width=64, height=48))
    from_xml = mi.load_file(str(path(number)), resx=64, resy=48)
    images = [mrt.render(s, aa=2, aamode="none").image for s in (scene, from_xml)]
    assert np.array_equal(*images)


def test_dicts_are_plain_and_share_materials():
    scene = mrt.scene_dict(4)
    materials = {name for name, node in scene.items() if isinstance(node, dict) and node["type"] == "mrt_bsdf"}
    shapes = [node for node in scene.values() if isinstance(node, dict) and node["type"] in ("sphere", "mrt_plane")]
    assert len(shapes) == 603 and len(materials) == 13
    assert all(shape["bsdf"] == {"type": "ref", "id": shape["bsdf"]["id"]} for shape in shapes)
    assert {shape["bsdf"]["id"] for shape in shapes} == materials


@pytest.mark.parametrize("number", NUMBERS)
def test_stock_flavour_opens_without_our_plugins(number, run_python):
    """In a process that never imports the package, as the ``mitsuba`` command would read it."""
    assert "mrt_" not in path(number, "stock").read_text()
    code = """
import sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
scene = mi.load_file(sys.argv[1], resx=16, resy=12)
image = mi.TensorXf(mi.render(scene, spp=4))
values = list(image.array)
assert len(values) == 16 * 12 * 3 and 0 < sum(values) < 1e4, sum(values)
"""
    done = run_python(code, str(path(number, "stock")))
    assert done.returncode == 0, done.stderr


def test_stock_lights_are_as_bright_at_the_target():
    """A point light's irradiance is intensity over squared distance; ours has none to divide by."""
    ours, stock = (mrt.scene_dict(3, flavor=flavor) for flavor in FLAVORS)
    for name in ("light_0", "light_1", "light_2"):
        squared = sum((a - b) ** 2 for a, b in zip(ours[name]["position"], (0, 0.3, 0), strict=True))
        for a, b in zip(ours[name]["intensity"]["value"], stock[name]["intensity"]["value"], strict=True):
            assert b / squared == pytest.approx(a, rel=1e-12)


def test_writing_xml_is_checked_and_atomic(tmp_path):
    target = tmp_path / "scene.xml"
    write_xml(0, target)
    assert target.read_text().startswith("<scene")
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.xml"]
    with pytest.raises(mrt.OutputError, match="does not exist"):
        write_xml(0, tmp_path / "nowhere" / "scene.xml")
    with pytest.raises(mrt.UsageError, match="flavor"):
        mrt.scene_dict(0, flavor="vanilla")


def test_export_leaves_the_variant_as_it_was():
    xml_text(0)
    assert mi.variant() == "llvm_ad_rgb"
