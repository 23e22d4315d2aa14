"""The numbered scenes as numbers and pictures; scenes from OBJ files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Material, Scene
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.scene.report import NUMBERS, report_scene

SIZE = {"width": 96, "height": 72, "aa": 1}


def numbers_of(scene: Scene) -> list[float]:
    """Every number of a scene, in a fixed order."""

    def material(m: Material) -> list[float]:
        return [m.ior, m.alpha, *m.specular, *m.diffuse]

    camera = scene.camera
    numbers = [*camera.position, *camera.target, *camera.up, camera.hfov, *scene.sky]
    numbers += [x for light in scene.lights for x in (*light.position, *light.color)]
    numbers += [x for s in scene.spheres for x in (*s.center, s.radius, *material(s.material))]
    numbers += [x for p in scene.planes for x in (*p.normal, p.distance, *material(p.material))]
    numbers += [x for c in scene.cones for x in (*c.apex, *c.base_center, c.radius, *material(c.material))]
    return numbers


@pytest.mark.parametrize(
    ("number", "checksum", "focus", "counts"),
    [
        (0, "a4fed8279d9f45a4", (None, 2), (2, 4, 1, 0)),
        (1, "59e6d0293dcd62af", (None, 2), (2, 21, 1, 0)),
        (2, "479f60dbec271721", (None, 2), (3, 40, 1, 0)),
        (3, "669691de4cc8b866", (2, 2), (3, 6, 3, 0)),
        (4, "8c1edd15fa716260", (0.1, 3), (3, 600, 3, 0)),
        (9, "181e4b35414501f8", (None, 2), (2, 0, 1, 1)),
    ],
)
def test_no_number_has_changed(number: int, checksum: str, focus: tuple, counts: tuple) -> None:
    """Nine digits count; the checksums were taken once the numbers had been compared with the original's."""
    scene = report_scene(number)
    assert tuple(map(len, (scene.lights, scene.spheres, scene.planes, scene.cones))) == counts
    assert (scene.focal_distance, scene.focal_range) == focus
    text = " ".join(f"{x + 0.0:.9g}" for x in numbers_of(scene))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == checksum


def test_there_are_ten_scenes_each_read_once_and_no_others() -> None:
    assert tuple(range(10)) == NUMBERS
    assert len({report_scene(number).title for number in NUMBERS}) == 10
    assert report_scene(3) is report_scene(3)
    with pytest.raises(mrt.UsageError, match="there is no scene 77: choose one of 0, 1, 2, 3, 4"):
        report_scene(77)


@pytest.mark.parametrize("number", range(10))
def test_watertight_triangles_are_asked_for_where_there_are_any(number: int) -> None:
    """The report's own scenes hold none, and their pictures shall not change by a bit."""
    flag = mrt.scene_dict(number).get("embree_use_robust_intersections", False)
    assert flag is (number in (5, 6, 7, 8))


@pytest.mark.parametrize(("number", "triangles"), [(5, 1588), (6, 646), (7, 7620), (8, 12)])
def test_scenes_of_models_render_and_repeat(number: int, triangles: int) -> None:
    """Mitsuba leaves merged meshes in another order every time, and with it their numbers in layers; these
    keep that of the scene."""
    assert sum(len(mesh.faces) for mesh in report_scene(number).meshes) == triangles
    image = mrt.render(number, **SIZE).image
    assert np.isfinite(image).all() and 0.1 < image.mean() < 0.8 and image.std() > 0.1
    assert np.array_equal(image, mrt.render(number, **SIZE).image)
    nodes = mrt.scene_dict(number)
    names = [shape.id() for shape in open_scene(number).scene.shapes()]
    assert names == [name for name in nodes if name in names] and "mesh_0" in names


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scene_of_an_obj_file(tmp_path: Path, scale: float) -> None:
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
