"""Scenes as dicts and XML: the files are up to date, mean the same, and the stock flavour needs no plugin of
ours."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba.plugins.intersect import Frame
from mrt_mitsuba.plugins.quadric_kinds import KINDS
from mrt_mitsuba.scene.export import FLAVORS, write_xml
from mrt_mitsuba.scene.model import Cylinder
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


def test_stock_lights_are_as_bright_at_the_target():
    """A point light's irradiance is intensity over squared distance; ours has none to divide by."""
    ours, stock = (mrt.scene_dict(3, flavor=flavor) for flavor in FLAVORS)
    for name in ("light_0", "light_1", "light_2"):
        squared = sum((a - b) ** 2 for a, b in zip(ours[name]["position"], (0, 0.3, 0), strict=True))
        for a, b in zip(ours[name]["intensity"]["value"], stock[name]["intensity"]["value"], strict=True):
            assert b / squared == pytest.approx(a, rel=1e-12)


SMALL = {"width": 64, "height": 48}


@pytest.mark.parametrize("number", range(10))
def test_every_scene_goes_into_files_and_back(number, tmp_path):
    """Numbers are written with 17 digits, meshes as binary PLY: not a bit of the picture changes."""
    write_xml(number, tmp_path / "scene.xml")
    meshes = len(report_scene(number).meshes)
    assert len(list(tmp_path.iterdir())) == 1 + meshes
    from_xml = mi.load_file(str(tmp_path / "scene.xml"), resx=64, resy=48)
    images = [mrt.render(s, aa=1).image for s in (mi.load_dict(mrt.scene_dict(number, **SMALL)), from_xml)]
    assert np.array_equal(*images)


@pytest.mark.parametrize("number", range(10))
def test_stock_flavour_of_every_scene_shows_the_same_shapes(number, tmp_path, run_python):
    """Opened without our plugins registered; depth says whether each shape is where it was, whatever its
    material."""
    write_xml(number, tmp_path / "scene.xml", flavor="stock")
    assert 'type="mrt_' not in (tmp_path / "scene.xml").read_text()
    code = """
import sys
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(sys.argv[1], resx=64, resy=48)
depth = {"type": "aov", "aovs": "d:depth"}
np.save("depth.npy", np.array(mi.render(scene, integrator=mi.load_dict(depth), spp=1, seed=1))[..., -1])
image = np.array(mi.render(scene, spp=2))
assert np.isfinite(image).all() and 0.01 < image.mean() < 5, image.mean()
"""
    # The package only chooses LLVM here: without register(), Mitsuba knows none of its plugins
    done = run_python("import mrt_mitsuba\n" + code, str(tmp_path / "scene.xml"))
    assert done.returncode == 0, done.stderr
    stock = np.load(tmp_path / "depth.npy")
    ours = mrt.render(number, **SMALL, aa=1, layers=["depth"]).layers["depth.Z"]
    # A stock ray goes through a random point of the pixel, and stock planes end; a shape that is missing or
    # misplaced shows over more of the picture than edges do
    near = np.isfinite(ours) & (ours < 20)
    off = np.abs(stock[near] - ours[near]) > 0.1 * ours[near]
    assert off.mean() < 0.12


@pytest.mark.parametrize(("number", "text"), [(9, "cone_0.*mrt_cone"), (8, "mesh_0.*mrt_mesh")])
def test_what_needs_a_file_is_named(number, text):
    with pytest.raises(mrt.SceneError, match=text):
        mrt.scene_dict(number, flavor="stock")


def test_group_cannot_be_written(tmp_path):
    scene = report_scene(0)
    many = replace(scene, spheres=scene.spheres[:1] * 1001)
    for flavor in FLAVORS:
        with pytest.raises(mrt.SceneError, match=r"spheres cannot be written as XML.*mrt_group"):
            write_xml(many, tmp_path / "many.xml", flavor=flavor)
    assert list(tmp_path.iterdir()) == []


def test_stock_tube_is_closed():
    """Rays from all around meet the tube and its ends at the distances of the exact shape."""
    tube = Cylinder((0.2, 1.5, -0.1), (0.5, 0.4, 0.3), 0.65, report_scene(0).spheres[0].material)
    scene = replace(report_scene(0), spheres=(), planes=(), cylinders=(tube,))
    rng = np.random.default_rng(5)
    o = rng.normal(size=(20_000, 3))
    o = 4 * o / np.linalg.norm(o, axis=1, keepdims=True) + np.array([0.35, 0.95, 0.1])
    d = np.array([0.35, 0.95, 0.1]) + rng.uniform(-0.4, 0.4, o.shape) - o
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f((d / np.linalg.norm(d, axis=1, keepdims=True)).T))
    stock = mi.load_dict(mrt.scene_dict(scene, flavor="stock"))  # lives until its rays are traced
    found = np.array(stock.ray_intersect_preliminary(ray).t)
    frame = mi.load_dict(scene.to_dict()["cylinder_0"] | {"bsdf": {"type": "diffuse"}}).frame()
    rows = (mi.Vector3f(row) for row in (frame.x, frame.y, frame.z))
    frame = Frame(mi.Point3f(frame.origin), *rows)
    exact = np.array(KINDS["cylinder"].intersect(ray.o, ray.d, frame).t)
    assert np.isfinite(exact).mean() > 0.5
    # float32 at distances of four; a grazing ray may go either way
    assert np.isclose(found, exact, rtol=1e-5).mean() > 0.999


def test_writing_xml_is_checked_and_atomic(tmp_path):
    target = tmp_path / "scene.xml"
    write_xml(0, target)
    assert mi.variant() == "llvm_ad_rgb"  # as before
    assert target.read_text().startswith("<scene")
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.xml"]
    with pytest.raises(mrt.OutputError, match="does not exist"):
        write_xml(0, tmp_path / "nowhere" / "scene.xml")
    with pytest.raises(mrt.UsageError, match="flavor"):
        mrt.scene_dict(0, flavor="vanilla")


def test_xml_of_scene_3_keeps_its_depth_of_field(tmp_path):
    write_xml(3, tmp_path / "scene.xml")
    text = (tmp_path / "scene.xml").read_text().replace('value="800"', 'value="64"').replace('"600"', '"48"')
    (tmp_path / "scene.xml").write_text(text)
    from_xml, ours = (
        mrt.render(s, aa=1, lattice="report", **size)
        for s, size in ((str(tmp_path / "scene.xml"), {}), (3, SMALL))
    )
    assert from_xml.plan.blur == "report" and np.array_equal(from_xml.image, ours.image)
    assert not mrt.render(str(tmp_path / "scene.xml"), aa=1, focaldist=0).plan.blur


def test_an_xml_file_is_exported_as_it_renders(tmp_path):
    """Includes and parameters are filled in, and its pictures are found from elsewhere."""
    (tmp_path / "in").mkdir()
    Image.new("RGB", (4, 4), (200, 100, 50)).save(tmp_path / "in" / "t.png")
    (tmp_path / "in" / "sky.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    (tmp_path / "in" / "a.xml").write_text(
        """<scene version="3.0.0"><default name="r" value="1"/><default name="focaldist" value="4"/>
        <include filename="sky.xml"/><sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="16"/><integer name="height" value="12"/></film></sensor>
        <shape type="sphere"><float name="radius" value="$r"/><point name="center" value="0 0 5"/>
        <bsdf type="mrt_bsdf"><texture name="diffuse_reflectance" type="mrt_texture">
        <string name="filename" value="t.png"/></texture></bsdf></shape></scene>"""
    )
    (written,) = write_xml(tmp_path / "in" / "a.xml", tmp_path / "b.xml", params={"r": 0.5})
    before, after = mrt.render(tmp_path / "in" / "a.xml", params={"r": 0.5}), mrt.render(written)
    assert np.array_equal(before.image, after.image) and before.plan.focus == after.plan.focus
    assert not np.array_equal(before.image, mrt.render(tmp_path / "in" / "a.xml").image)
    for name in ("a.xml", "sky.xml", "t.png"):
        with pytest.raises(mrt.OutputError, match="what is written is made from this file"):
            write_xml(tmp_path / "in" / "a.xml", tmp_path / "in" / name)


def test_an_obj_file_is_exported_as_it_renders(tmp_path):
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    view = {"width": 16, "height": 12, "camera": (0.4, 0.4, 2), "target": (0.3, 0.3, 0), "light": (1, 1, 3)}
    written = write_xml(tmp_path / "t.obj", tmp_path / "t.xml", **view)
    assert [Path(file).name for file in written] == ["t_mesh_0.ply", "t.xml"]
    before, after = (
        mrt.render(tmp_path / "t.obj", aa=1, **view),
        mrt.render(written[1], aa=1, lattice="report"),
    )
    assert np.array_equal(before.image, after.image)
