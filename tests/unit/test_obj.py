"""OBJ and MTL files: what is read, in both conventions, and one clear error for each broken file."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import MrtWarning, SceneError
from mrt_mitsuba.scene.model import Camera, Mesh
from mrt_mitsuba.scene.mtl import DEFAULT_MATERIAL, read_mtl
from mrt_mitsuba.scene.obj import model_scene as model_view
from mrt_mitsuba.scene.obj import obj_scene, read_obj

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UVS = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
NORMALS = "vn 0 0 1\n"

MTL = """# two materials
newmtl red
Kd 1.9 0.1 0.1
Ks 0.2 0.3 0.4
Ka 1.2 0 0
Ni 0.25
Ns 98
newmtl painted
Kd 0.5
"""
PAINTED = MTL + "map_Kd picture.png\n"


@pytest.fixture
def model(tmp_path: Path):
    """Write an OBJ file, and an MTL file next to it, and read them."""

    def read(obj: str | bytes, mtl: str | None = None, **options) -> tuple[Mesh, ...]:
        if mtl is not None:
            (tmp_path / "model.mtl").write_text(mtl)
        path = tmp_path / "model.obj"
        path.write_bytes(obj if isinstance(obj, bytes) else obj.encode())
        return read_obj(path, **options)

    return read


def triangles(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


# --------------------------------------------- Geometry -------------------------------------------------


@pytest.mark.parametrize(
    "face", ["f 1 2 3", "f 1/1 2/2 3/3", "f 1//1 2//1 3//1", "f 1/1/1 2/2/1 3/3/1", "f +1 2 3"]
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "  \t\n", " # a comment\n"])
def test_forms_of_faces_and_line_ends(model, face: str, end: str) -> None:
    (mesh,) = model((SQUARE + UVS + NORMALS + face + "\n").replace("\n", end))
    np.testing.assert_array_equal(triangles(mesh), [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]])
    assert mesh.material == DEFAULT_MATERIAL
    assert mesh.faces.dtype == np.uint32 and mesh.vertices.dtype == np.float32


def test_negative_indices_count_back(model) -> None:
    (mesh,) = model(SQUARE + "f -4 -3 -2\nv 5 5 5\nf -5 -4 -1\n")
    np.testing.assert_array_equal(triangles(mesh)[0], [[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    np.testing.assert_array_equal(triangles(mesh)[1], [[0, 0, 0], [1, 0, 0], [5, 5, 5]])


@pytest.mark.parametrize("corners", [4, 5, 6, 9])
def test_polygons_become_fans(model, corners: int) -> None:
    angle = 2 * np.pi * np.arange(corners) / corners
    points = "".join(f"v {math.cos(a):.9f} {math.sin(a):.9f} 0\n" for a in angle)
    (mesh,) = model(points + "f " + " ".join(str(i + 1) for i in range(corners)) + "\n")
    a, b, c = triangles(mesh).transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert len(areas) == corners - 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(corners / 2 * math.sin(2 * math.pi / corners), rel=1e-6)


def test_extra_numbers_and_other_statements_are_skipped(model) -> None:
    points = "v 0 0 0 1\nv 1 0 0 0.1 0.2 0.3\nv 1 1 0 1 0.1 0.2 0.3\n"
    text = "o thing\ng a b\ns off\n" + points + "vt 0.5\nvt 0 0 0\nl 1 2\nf 1 2 3\n"
    (mesh,) = model(text)
    np.testing.assert_array_equal(triangles(mesh), [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]])


def test_continued_lines_keep_line_numbers(model) -> None:
    (mesh,) = model(SQUARE + "f 1 \\\n2 \\\n3\n")
    assert len(mesh.faces) == 1
    with pytest.raises(SceneError, match=r"model\.obj:8: f has the v index 9"):
        model(SQUARE + "f 1 \\\n2 \\\n3\nf 1 2 9\n")


def test_runs_of_lines_equal_single_lines(model) -> None:
    """A comment keeps a line out of the fast path; more lines than it takes at once."""
    rng = np.random.default_rng(1)
    points, faces = rng.integers(-999, 999, size=(5000, 3)) / 64, rng.integers(1, 5001, size=(9000, 3))
    lines = [f"v {x:.9g} {y:.9e} {z}" for x, y, z in points] + [f"vt {x:g} {y:g}" for x, y, _ in points]
    lines += [f"f {a}/{b} {b}/{c} {c}/{a}" for a, b, c in faces]
    fast, slow = (model("".join(line + end for line in lines))[0] for end in ("\n", " #\n"))
    np.testing.assert_array_equal(triangles(fast), triangles(slow))
    np.testing.assert_array_equal(triangles(fast), points[faces - 1])


# --------------------------------------------- Materials ------------------------------------------------


def test_conventions(model) -> None:
    text = "\ufeffmtllib model.mtl\n" + SQUARE + "usemtl red\nf 1 2 3"  # a byte order mark, no last line end
    (mesh,) = model(text, MTL)
    material = mesh.material
    assert (material.ior, material.alpha) == (1.2, 0.25)  # from Ka and Ni
    assert material.diffuse == (1.9, 0.1, 0.1) and material.specular == (0.2, 0.3, 0.4)
    (mesh,) = model(text, MTL, convention="standard")
    assert mesh.material.ior == 0.25  # Ni
    assert mesh.material.alpha == pytest.approx(math.sqrt(2 / 100))  # Ns 98


def test_a_mesh_for_each_material_with_its_own_vertices(model) -> None:
    text = (
        "mtllib model.mtl\n"
        + SQUARE
        + "f 1 2 3\nusemtl red\nf 1 3 4\nusemtl other\nf 2 3 4\nusemtl red\nf 2 3 4\n"
    )
    mtl = MTL.replace("painted", "other")
    default, red, other = model(text, mtl)
    assert (
        default.material == DEFAULT_MATERIAL
        and red.material.ior == 1.2
        and other.material.diffuse == (0.5,) * 3
    )
    assert [len(m.faces) for m in (default, red, other)] == [1, 2, 1]
    assert [len(m.vertices) for m in (default, red, other)] == [3, 4, 3]
    np.testing.assert_array_equal(triangles(red)[0], [[0, 0, 0], [1, 1, 0], [0, 1, 0]])


@pytest.mark.parametrize("name", ["art\\a.png", "art/my a.png", "-s 2 2 -o 0 0 0 -clamp on a.png"])
def test_names_of_files(model, tmp_path: Path, name: str) -> None:
    file = tmp_path / name.split("on ")[-1].replace("\\", "/")
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"")
    (tmp_path / "my model.mtl").write_text(PAINTED.replace("picture.png", name))
    (mesh,) = model("mtllib my model.mtl\n" + SQUARE + UVS + "usemtl painted\nf 1/1 2/2 3/3\n")
    assert Path(mesh.material.texture) == file


def test_texture_beside_the_obj_file(model, tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"")
    text = "mtllib model.mtl\n" + SQUARE + UVS + "usemtl painted\nf 1/4 2/3 3/2\nf 1 3 4\n"
    textured, plain = model(text, PAINTED)
    assert textured.material.texture == str(tmp_path / "picture.png")
    np.testing.assert_array_equal(textured.uvs[textured.faces[0]], [[0, 1], [1, 1], [1, 0]])
    # A face without coordinates cannot look a texture up: it gets Kd
    assert plain.material.texture is None and plain.uvs is None and plain.material.diffuse == (0.5,) * 3


def test_missing_texture_is_named_and_replaced_by_kd(model, tmp_path: Path) -> None:
    text = "mtllib model.mtl\n" + SQUARE + UVS + "usemtl painted\nf 1/1 2/2 3/3\n"
    with pytest.warns(MrtWarning, match=r"model\.mtl:10: the texture picture\.png is missing .*Kd is used"):
        (mesh,) = model(text, PAINTED)
    assert mesh.material.texture is None and mesh.material.diffuse == (0.5, 0.5, 0.5)


def test_missing_library_is_named_and_the_default_used(model) -> None:
    with pytest.warns(MrtWarning) as caught:
        (mesh,) = model("mtllib nowhere.mtl\n" + SQUARE + "usemtl red\nf 1 2 3\n")
    assert "model.obj:1: the material library nowhere.mtl is missing" in str(caught[0].message)
    assert "model.obj:6: no library has the material 'red'" in str(caught[1].message)
    assert mesh.material == DEFAULT_MATERIAL


# --------------------------------------------- Broken files ---------------------------------------------

# What files are made of, whole and in pieces
WORDS = "v vt vn f usemtl mtllib model.mtl o # \\ / // 1/2/3 1//2 -1 0 1 2 3 4 1e39 nan .5 - é"
PIECES = [*WORDS.split(), *"\n\n\n\r  \t\0", "9" * 30]
MTL_WORDS = "newmtl Kd Ks Ka Ni Ns map_Kd a -s 1 0.5 nan -1 #"
MTL_PIECES = [*MTL_WORDS.split(), "\n", "\n"]


@pytest.mark.fuzz
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    obj=st.one_of(
        st.lists(st.sampled_from(PIECES), max_size=60).map("".join).map(str.encode), st.binary(max_size=200)
    ),
    start=st.sampled_from(["", SQUARE, "mtllib model.mtl\n" + SQUARE + UVS + NORMALS]),
    mtl=st.lists(st.sampled_from(MTL_PIECES), max_size=30).map(" ".join),
)
def test_any_text_is_read_or_refused(model, obj: bytes, start: str, mtl: str) -> None:
    """Whatever the file: meshes that hold together, or one error of one line that names a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MrtWarning)
        try:
            meshes = model(start.encode() + obj, mtl)
        except SceneError as error:
            message = str(error)
            assert "model.obj" in message or "model.mtl" in message
            return
    assert meshes
    for mesh in meshes:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.shape[1] == 3 and len(mesh.faces) > 0
        assert mesh.faces.max() < len(mesh.vertices)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def test_view_as_asked_for(tmp_path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(TRIANGLE)
    placed = obj_scene(path)
    assert model_view(path).camera == placed.camera and model_view(path).lights == placed.lights
    view = model_view(path, camera=(0, 0, 5), fov=30, light=(1, 2, 3), texturing="standard")
    assert view.camera == Camera((0, 0, 5), placed.camera.target, hfov=30)
    assert [light.position for light in view.lights] == [(1, 2, 3)] and view.texturing == "standard"


# ------------------------------------------- The standard's reading -------------------------------------


def test_standard_textures_stand_upright_and_the_reports_upside_down(tmp_path):
    from PIL import Image

    halves = np.zeros((4, 4, 3), np.uint8)
    halves[:2, :, 0] = halves[2:, :, 2] = 255  # red above blue
    Image.fromarray(halves).save(tmp_path / "halves.png")
    (tmp_path / "quad.mtl").write_text("newmtl m\nKd 1 1 1\nKs 0 0 0\nmap_Kd halves.png\n")
    corners = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "quad.obj").write_text(f"mtllib quad.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    view = {"camera": (0, 0, 3), "fov": 40, "light": (0, 0, 9), "width": 8, "height": 8, "aa": 1}
    for convention, above in (("standard", 0), ("report", 2)):
        image = mrt.render(tmp_path / "quad.obj", convention=convention, **view).image
        assert image[2, 4].argmax() == above and image[5, 4].argmax() == 2 - above


def test_the_standard_uses_normals_and_the_report_does_not(tmp_path):
    """A coarse ball: with the normals of a sphere, it is shaded as one."""
    long, wide = 8, 5
    angle, height = np.meshgrid(np.arange(long) * 2 * np.pi / long, np.linspace(-1.4, 1.4, wide))
    points = np.stack([np.cos(height) * np.sin(angle), np.sin(height), np.cos(height) * np.cos(angle)], -1)
    text = "".join(f"v {x} {y} {z}\nvn {x} {y} {z}\n" for x, y, z in points.reshape(-1, 3))
    for row in range(wide - 1):
        for k in range(long):
            low, right = row * long + 1, (k + 1) % long
            around = [low + k, low + right, low + long + right, low + long + k]
            text += "f " + " ".join(f"{i}//{i}" for i in around) + "\n"
    (tmp_path / "ball.mtl").write_text("newmtl m\nKd 1 1 1\nKs 0 0 0\n")
    (tmp_path / "ball.obj").write_text("mtllib ball.mtl\nusemtl m\n" + text)
    view = {"light": (600, 0, 1000), "camera": (0, 0, 4), "fov": 30, "width": 32, "height": 32, "aa": 1}
    steps = []
    for convention in ("report", "standard"):
        image = mrt.render(tmp_path / "ball.obj", convention=convention, **view).image[16, 8:24, 0]
        steps.append(np.abs(np.diff(image)).max())
    assert steps[1] < steps[0] / 2


def test_what_the_standard_drops_is_said_once(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 1 1\nillum 2\nd 0.5\nd 1.0\nmap_bump x.png\n")
    with pytest.warns(MrtWarning, match=r"a.mtl:4: d 0.5 is not used \(and so do 1 more statements\)"):
        read_mtl(tmp_path / "a.mtl", convention="standard")
    read_mtl(tmp_path / "a.mtl")  # the report's reading is what it uses
