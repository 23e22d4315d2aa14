"""Scenes as dicts and XML: the files are up to date, mean the same, and stock ones need no plugin of ours."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba.command.main import main
from mrt_mitsuba.scene.export import write_xml
from mrt_mitsuba.scene.model import FLAVORS, Camera, Cylinder
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.scenes_xml import NUMBERS, path

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("flavor", FLAVORS)
@pytest.mark.parametrize("number", NUMBERS)
def test_files_are_what_the_dicts_give(number, flavor, tmp_path):
    """``python -m mrt_mitsuba.scenes_xml`` writes them anew; the writer's version line may differ."""

    def body(text: str) -> str:
        return re.sub(r'<scene version="[^"]*">', "<scene>", text)

    (written,) = write_xml(number, tmp_path / "scene.xml", flavor=flavor)
    assert body(path(number, flavor).read_text()) == body(Path(written).read_text())


SMALL = {"width": 64, "height": 48}


@pytest.mark.parametrize("number", [3, 4, 6, 8])
def test_scenes_go_into_files_and_back(number, tmp_path):
    """Numbers are written with 17 digits, meshes as binary PLY: not a bit of the picture changes."""
    write_xml(number, tmp_path / "scene.xml")
    assert len(list(tmp_path.iterdir())) == 1 + len(report_scene(number).meshes)
    from_xml = mi.load_file(str(tmp_path / "scene.xml"), resx=64, resy=48)
    images = [mrt.render(s, aa=1).image for s in (mi.load_dict(mrt.scene_dict(number, **SMALL)), from_xml)]
    assert np.array_equal(*images)
    if number == 3:  # whose depth of field goes with it
        own, ours = (mrt.render(s, aa=1, lattice="report", **SMALL) for s in (tmp_path / "scene.xml", 3))
        assert own.plan.blur
        assert np.array_equal(own.image, ours.image)
        assert not mrt.render(tmp_path / "scene.xml", aa=1, focaldist=0).plan.blur


TUBE = Cylinder((0.2, 1.5, -0.1), (0.5, 0.4, 0.3), 0.65, report_scene(0).spheres[0].material)
ENDS = {
    name: replace(
        report_scene(0), spheres=(), planes=(), cylinders=(TUBE,), camera=Camera(place, (0.35, 0.95, 0.1))
    )
    for name, place in (("above", (0.5, 5, 1)), ("below", (1, -3, 0)))
}


@pytest.mark.parametrize("number", [3, 4, 6, 8, 9, *ENDS])
def test_stock_flavour_shows_the_same_shapes(number, tmp_path):
    """Depth says whether each shape is where it was, whatever its material; a tube is closed at both ends."""
    scene = ENDS.get(number, number)
    path = write_xml(scene, tmp_path / "scene.xml", flavor="stock", **SMALL)[-1]
    assert 'type="mrt_' not in Path(path).read_text()
    options = {"aa": 1, "layers": ["depth"], "aamode": "none"}
    ours = mrt.render(scene, **SMALL, **options).layers["depth.Z"]
    result = mrt.render(path, lattice="report", integrator="path", **options)
    assert np.isfinite(result.image).all()
    assert 0.01 < result.image.mean() < 5
    near = np.isfinite(ours) & (ours < 20)  # stock planes end, and cones and tubes have sides
    off = ~np.isclose(result.layers["depth.Z"][near], ours[near], rtol=1e-4)
    assert near.mean() > 0.05
    sides = {6: 0.01, 9: 0.01, **dict.fromkeys(ENDS, 0.02)}  # share of pixels on sides of meshes
    assert off.mean() < sides.get(number, 1e-3)


def test_writing_xml_is_checked_and_atomic(tmp_path):
    scene = report_scene(0)
    many = replace(scene, spheres=scene.spheres[:1] * 1001)
    for flavor in FLAVORS:
        with pytest.raises(mrt.SceneError, match=r"spheres cannot be written as XML.*mrt_group"):
            write_xml(many, tmp_path / "many.xml", flavor=flavor)
    for number, text in ((9, "cone_0.*mrt_cone"), (8, "mesh_0.*mrt_mesh")):
        with pytest.raises(mrt.SceneError, match=text):
            mrt.scene_dict(number, flavor="stock")
    write_xml(0, tmp_path / "scene.xml")
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.xml"]
    with pytest.raises(mrt.UsageError, match="flavor"):
        mrt.scene_dict(0, flavor="vanilla")


def test_an_xml_file_is_exported_as_it_renders(tmp_path):
    """Includes and parameters are filled in, and its pictures are found from elsewhere."""
    (tmp_path / "in").mkdir()
    Image.new("RGB", (4, 4), (200, 100, 50)).save(tmp_path / "in" / "t.png")
    (tmp_path / "in" / "sky.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    (tmp_path / "in" / "a.xml").write_text(
        """<scene version="3.0.0"><integrator type="path"/><default name="r" value="1"/>
        <default name="focaldist" value="4"/><include filename="sky.xml"/>
        <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="16"/><integer name="height" value="12"/></film></sensor>
        <shape type="sphere"><float name="radius" value="$r"/><point name="center" value="0 0 5"/>
        <bsdf type="mrt_bsdf"><texture name="diffuse_reflectance" type="mrt_texture">
        <string name="filename" value="t.png"/></texture></bsdf></shape></scene>"""
    )
    (written,) = write_xml(tmp_path / "in" / "a.xml", tmp_path / "b.xml", params={"r": 0.5})
    before = mrt.render(tmp_path / "in" / "a.xml", params={"r": 0.5})
    after = mrt.render(written)
    assert np.array_equal(before.image, after.image)
    assert before.plan.blur == after.plan.blur
    assert (after.plan.blur.focal_distance, after.plan.blur.focal_range) == (4, 2)
    assert not np.array_equal(before.image, mrt.render(tmp_path / "in" / "a.xml").image)
    for name in ("a.xml", "sky.xml", "t.png"):
        with pytest.raises(mrt.OutputError, match="what is written is made from this file"):
            write_xml(tmp_path / "in" / "a.xml", tmp_path / "in" / name)


USED = {"width": "8", "height": "6", "fresnel": "dielectric"}


@pytest.mark.parametrize("name", USED)
def test_export_uses_what_it_takes(tmp_path, name):
    assert main(["export", "3", "--xml", str(tmp_path / "a.xml")]) == 0
    assert main(["export", "3", "--xml", str(tmp_path / "b.xml"), f"{name}={USED[name]}"]) == 0
    assert (tmp_path / "a.xml").read_text() != (tmp_path / "b.xml").read_text()
