"""The numbered scenes as numbers and pictures; scenes from OBJ files."""

from __future__ import annotations

import hashlib
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Camera, Material, Scene, Sphere
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.scene.report import NUMBERS, report_scene

SIZE = {"width": 96, "height": 72, "aa": 1}


CHECKSUMS = {0: "feba33f127b306e6", 1: "1e50e54ba02c76ea", 2: "b1370db4e03bb43f"}
CHECKSUMS |= {3: "1283761a604bf9e8", 4: "dd85fef2a53f26c1", 9: "ee199ea7fa12b9c4"}


@pytest.mark.parametrize("number", CHECKSUMS)
def test_no_number_has_changed(number):
    """Nine digits count; the checksums were taken once the numbers had been compared with the original's."""
    found = re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", repr(report_scene(number)))
    text = " ".join(f"{float(x) + 0.0:.9g}" for x in found)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == CHECKSUMS[number]


def test_there_are_ten_scenes_each_read_once():
    assert tuple(range(10)) == NUMBERS
    assert len({report_scene(number).title for number in NUMBERS}) == 10
    assert report_scene(3) is report_scene(3)


@pytest.mark.parametrize("number", range(10))
def test_watertight_triangles_are_asked_for_where_there_are_any(number):
    """The report's own scenes have none, and their pictures must not change by a bit."""
    flag = mrt.scene_dict(number).get("embree_use_robust_intersections", False)
    assert flag is (number in (5, 6, 7, 8))


@pytest.mark.parametrize(("number", "triangles"), [(5, 1588), (6, 646), (7, 7620), (8, 12)])
def test_scenes_of_models_render_and_repeat(number, triangles):
    """Mitsuba leaves merged meshes in another order every time, and with it their numbers in layers; these
    keep that of the scene."""
    assert sum(len(mesh.faces) for mesh in report_scene(number).meshes) == triangles
    image = mrt.render(number, **SIZE).image
    assert np.isfinite(image).all()
    assert 0.1 < image.mean() < 0.8
    assert image.std() > 0.1
    assert np.array_equal(image, mrt.render(number, **SIZE).image)
    nodes = mrt.scene_dict(number)
    names = [shape.id() for shape in open_scene(number).scene.shapes()]
    assert names == [name for name in nodes if name in names]
    assert "mesh_0" in names


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scene_of_an_obj_file(tmp_path, scale):
    """All of the model is in view, from in front, whatever its size and place."""
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    lines = [f"v {scale * (7 + x)} {scale * (y - 2)} {scale * z}" for x, y, z in corners]
    faces = ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
    (tmp_path / "cube.obj").write_text("\n".join(lines + faces))
    result = mrt.render(str(tmp_path / "cube.obj"), **SIZE, layers=["depth"])
    hit = np.isfinite(result.layers["depth.Z"])
    assert 0.1 < hit.mean() < 0.6
    assert not (hit[0].any() or hit[-1].any() or hit[:, 0].any() or hit[:, -1].any())
    assert result.image[hit].mean() > 0.1


@pytest.mark.parametrize("scale", [1e-3, 1, 1e5])
@pytest.mark.parametrize("integrator", ["mrt_whitted", "path"])
def test_a_scene_of_any_size_is_seen_whole(scale, integrator):
    """Neither clipped in front nor at the back: a black ball under a sky."""
    black = Material(1.5, 0.1, (0, 0, 0), (0, 0, 0))
    ball = Sphere((0, 0, 0), scale, black)
    scene = Scene(Camera((0, 0, 5 * scale), (0, 0, 0)), (0.25, 0.5, 1), (), spheres=(ball,))
    image = mrt.render(scene, width=16, height=12, aa=1, aamode="none", integrator=integrator).image
    assert_array_equal(image[5:7, 7:9], 0)
    assert_allclose(image[[0, -1]], np.broadcast_to([0.25, 0.5, 1], (2, 16, 3)), rtol=1e-6)
