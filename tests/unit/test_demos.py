"""Scenes 5 to 8 and the models in them; scenes from OBJ files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba.scene import shapes as models
from mrt_mitsuba.scene.model import Mesh, Sphere
from mrt_mitsuba.scene.mtl import DEFAULT_MATERIAL
from mrt_mitsuba.scene.obj import obj_scene
from mrt_mitsuba.scene.report import NUMBERS, report_scene

SIZE = {"width": 96, "height": 72, "aa": 1}


def volume(mesh: Mesh) -> float:
    """By the divergence theorem: negative inside out, wrong where there is a hole."""
    corners = mesh.vertices[mesh.faces].astype(float)
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def is_closed(mesh: Mesh) -> bool:
    """Does every edge between two places belong to two triangles, once in each direction?"""
    _, place = np.unique(mesh.vertices.round(5), axis=0, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return sorted(map(tuple, edges.tolist())) == sorted(map(tuple, edges[:, ::-1].tolist()))


@pytest.mark.parametrize(
    ("mesh", "expected", "tolerance"),
    [
        (models.torus((1, 2, 3), 1, 0.3, DEFAULT_MATERIAL, rings=200, sides=100), 2 * np.pi**2 * 0.09, 2e-3),
        (models.block((1, 2, 3), (1, 2, 3), DEFAULT_MATERIAL, turn=30), 6, 1e-5),
        (models.tent((1, 0, 3), 1, 1.5, 2, DEFAULT_MATERIAL, turn=30), 1.5, 1e-5),
        (
            models.rock((1, 0, 3), 1, DEFAULT_MATERIAL, seed=1),
            2.536 * 0.7,
            0.25,
        ),  # of an icosahedron, moved about
    ],
)
def test_models_are_closed_and_face_outwards(mesh: Mesh, expected: float, tolerance: float) -> None:
    assert is_closed(mesh)
    centred = Mesh(mesh.vertices - mesh.vertices.mean(axis=0), mesh.faces, mesh.material)
    assert volume(centred) == pytest.approx(expected, rel=tolerance)


def test_pines_are_closed_and_as_many_as_asked_for() -> None:
    crowns, trunks = models.pines([(0, 0, 0), (3, 0, 1)], 1.0, DEFAULT_MATERIAL, DEFAULT_MATERIAL)
    assert is_closed(crowns) and is_closed(trunks)
    assert volume(crowns) > 0 and volume(trunks) > 0
    assert len(trunks.faces) == 2 * 8 and len(crowns.faces) == 2 * 3 * 14


def test_terrain_is_whole_faces_up_and_is_split_by_height() -> None:
    other = report_scene(0).spheres[0].material
    pieces = models.terrain(lambda x, z: x, 2, 10, [(0.0, DEFAULT_MATERIAL), (9, other)])
    assert [m.material for m in pieces] == [DEFAULT_MATERIAL, other]
    assert sum(len(m.faces) for m in pieces) == 200
    assert pieces[0].vertices[pieces[0].faces].mean(axis=1)[:, 1].max() <= 0
    for piece in pieces:
        a, b, c = piece.vertices[piece.faces].transpose(1, 0, 2)
        assert (np.cross(b - a, c - a)[:, 1] > 0).all()


def test_picture_of_the_block_is_the_one_that_is_shipped() -> None:
    np.testing.assert_array_equal(np.array(Image.open(models.BLOCK_PICTURE)), models.block_picture())


def test_there_are_ten_scenes() -> None:
    assert tuple(range(10)) == NUMBERS
    assert len({report_scene(number).title for number in NUMBERS}) == 10


def test_what_the_scenes_hold() -> None:
    lake = report_scene(7)
    assert sum(len(m.faces) for m in lake.meshes) >= 3080  # the size of the report's landscape
    assert len({m.material for m in lake.meshes}) >= 5
    glossy = [s for s in report_scene(5).spheres if isinstance(s, Sphere) and max(s.material.specular) > 0.5]
    assert len(glossy) == 2 and len(report_scene(5).meshes) >= 3
    assert report_scene(6).cones and report_scene(6).cylinders and report_scene(6).meshes
    assert Path(report_scene(8).meshes[0].material.texture).is_file()


@pytest.mark.parametrize("number", range(10))
def test_watertight_triangles_are_asked_for_where_there_are_any(number: int) -> None:
    """The report's own scenes hold none, and their pictures shall not change by a bit."""
    flag = mrt.scene_dict(number).get("embree_use_robust_intersections", False)
    assert flag is (number in (5, 6, 7, 8))


@pytest.mark.parametrize("number", [5, 6, 7, 8])
def test_scenes_render_and_repeat(number: int) -> None:
    result = mrt.render(number, **SIZE)
    image = result.image
    assert np.isfinite(image).all()
    assert 0.1 < image.mean() < 0.8 and image.std() > 0.1
    assert np.array_equal(image, mrt.render(number, **SIZE).image)


def test_arrow_on_the_block_points_up() -> None:
    """Above the middle of the block's front the picture is blue, below it is wood: v = 0 is the first row."""
    image = mrt.render(8, width=240, height=180, aa=1).image
    blue = (image[..., 2] > 1.3 * image[..., 0]) & (image[..., 2] > 0.25)
    rows, columns = np.nonzero(blue[60:150, 100:140])
    widths = [np.ptp(columns[rows == row]) for row in np.unique(rows)]
    assert np.mean(widths[: len(widths) // 3]) < np.max(widths)  # a tip
    assert np.argmax(widths) < len(widths) / 2  # the head is above the shaft


def test_scene_of_an_obj_file(tmp_path: Path) -> None:
    """All of the model is in view, from in front, whatever its size and place."""
    for scale in (1e-3, 1, 1e3):
        lines = [
            f"v {scale * (7 + x)} {scale * (y - 2)} {scale * z}"
            for x in (0, 1)
            for y in (0, 1)
            for z in (0, 1)
        ]
        faces = ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
        (tmp_path / "cube.obj").write_text("\n".join(lines + faces))
        result = mrt.render(str(tmp_path / "cube.obj"), **SIZE, layers=["depth"])
        hit = np.isfinite(result.layers["depth.Z"])
        assert 0.1 < hit.mean() < 0.6
        assert not (hit[0].any() or hit[-1].any() or hit[:, 0].any() or hit[:, -1].any())
        assert result.image[hit].mean() > 0.1
    assert obj_scene(tmp_path / "cube.obj").title == "cube.obj"
