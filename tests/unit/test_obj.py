"""OBJ and MTL files: what is read, in both conventions. What is refused: tests/system/test_refusals.py."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from cases import Cases
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import MrtWarning, SceneError
from mrt_mitsuba.scene.export import write_xml
from mrt_mitsuba.scene.model import Camera, Mesh
from mrt_mitsuba.scene.mtl import DEFAULT_MATERIAL
from mrt_mitsuba.scene.obj import obj_scene, read_obj

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UVS = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
NORMALS = "vn 0 0 1\n"
MTL = """newmtl red\nKd 1.9 0.1 0.1 # bright\nKs 0.2 0.3 0.4\nKa 1.2 0 0\nNi 0.25\nNs 98
newmtl painted\nKd 0.5
"""
PAINTED = MTL + "map_Kd picture.png\n"
USE_PAINTED = "mtllib model.mtl\n" + SQUARE + UVS + "usemtl painted\nf 1/1 2/2 3/3\n"


@pytest.fixture
def model(tmp_path: Path):
    """Write an OBJ file, and an MTL file next to it, and read them."""

    def read(obj: str | bytes, mtl: str | None = None, **options) -> tuple[Mesh, ...]:
        if mtl is not None:
            (tmp_path / "model.mtl").write_text(mtl)
        path = tmp_path / "model.obj"
        path.write_bytes(obj if isinstance(obj, bytes) else obj.encode())
        return read_obj(path, **options)[0]

    return read


def triangles(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


WHOLE = SQUARE + UVS + NORMALS
HALF = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
FAN = [[1, 1, 0], [0, 1, 0]], [[0, 1, 0], [0, 0, 0]], [[0, 0, 0], [1, 0, 0]]


geometry = Cases()
for face in ("1 2 3", "1/1 2/2 3/3", "1//1 2//1 3//1", "+1 2 3"):
    geometry(WHOLE + f"f {face}\n", [HALF])
for e in ("\r\n", "\r", " \t\n", " #\n"):
    geometry(f"{WHOLE}f 1/1/1 2/2/1 3/3/1\n".replace("\n", e), [HALF])
geometry(SQUARE + "f -4 -3 -2\nv 5 5 5\nf -5 -4 -1", [HALF, [[0, 0, 0], [1, 0, 0], [5, 5, 5]]])
geometry("o a\ng b\nv 0 0 0 1\nv 1 0 0 1.0\nv 1 1 0 .1\nvt .5\nvt 0 0 0\nl 1 2\nf 1 2 3", [HALF])
geometry("\ufeff" + SQUARE + "s off\nf 1 \\\n2 \\\n3\n", [HALF])
geometry(SQUARE + "f 1 2 3 4\n", [HALF, [[0, 0, 0], [1, 1, 0], [0, 1, 0]]])
geometry(SQUARE + "f 1 2 3 4 1 2\n", [HALF, *([[0, 0, 0], *ends] for ends in FAN)])


ARROW = [(0, 0), (2, 0), (2, 2), (1, 0.2), (0, 2)]
COMB = [(0, 0), (21, 0), *((k / 4, 3 - 2.5 * (k % 2)) for k in range(80, 0, -1))]
RING = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
polygons = Cases()
polygons([*ARROW[:2], (0.4, 0.4), (0, 2)], 0.8)
polygons(ARROW, 2.2)
polygons(COMB, None)
polygons(RING, 12)  # with a hole


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize(("corners", "area"), polygons)
def test_faces_that_are_not_convex_are_covered_once(model, corners, area, turn):
    """Whichever corner is first, in either winding, and in any plane: areas add up, none is turned over."""
    corners = np.roll(np.array(corners, float), turn, axis=0)
    expected = 0.5 * np.linalg.det(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)).sum()
    assert area is None or expected == pytest.approx(area)
    corners = corners[::-1] if turn % 2 else corners
    plane = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))[0]
    points = np.column_stack([corners, 0 * corners[:, 0]]) @ plane.T + 5
    lines = [f"v {x} {y} {z}" for x, y, z in points]
    (mesh,) = model("\n".join([*lines, "f " + " ".join(map(str, range(1, len(points) + 1)))]))
    assert len(mesh.faces) == len(points) - 2
    a, b, c = np.moveaxis(triangles(mesh).astype(float), 1, 0)
    areas = 0.5 * np.cross(b - a, c - a) @ plane[:, 2] * np.linalg.det(plane) * (-1) ** turn
    assert areas.min() > -1e-5
    assert areas.sum() == pytest.approx(expected, rel=1e-5)


def test_a_face_that_crosses_itself_is_a_warning(model):
    with pytest.warns(MrtWarning, match="model.obj:6: the face crosses itself"):
        (mesh,) = model("v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nv .5 2 0\nf 1 2 3 4 5\n")
    assert len(mesh.faces) == 3


@pytest.mark.parametrize(("text", "found"), geometry)
def test_geometry(model, text, found):
    (mesh,) = model(text)
    assert_array_equal(triangles(mesh), found)
    assert mesh.material == DEFAULT_MATERIAL
    assert mesh.faces.dtype == np.uint32
    assert mesh.vertices.dtype == np.float32


def test_runs_of_lines_equal_single_lines(model):
    """A comment keeps a line out of the fast path; more lines than it takes at once."""
    rng = np.random.default_rng(1)
    points = rng.integers(-999, 999, size=(4200, 3)) / 64
    faces = rng.integers(1, 4201, size=(4200, 3))
    lines = [f"v {x:.9g} {y:.9e} {z}" for x, y, z in points] + [f"f {a} {b} {c}" for a, b, c in faces]
    fast, slow = (model("".join(line + end for line in lines))[0] for end in ("\n", " #\n"))
    assert_array_equal(triangles(fast), triangles(slow))
    assert_array_equal(triangles(fast), points[faces - 1])


def test_a_mesh_for_each_material_with_its_own_vertices(model):
    faces = "f 1 2 3\nusemtl red\nf 1 3 4\nusemtl painted\nf 2 3 4\nusemtl red\nf 2 3 4"
    text = "mtllib model.mtl\n" + SQUARE + faces
    default, red, other = model(text, MTL)
    assert default.material == DEFAULT_MATERIAL
    assert other.material.diffuse == (0.5,) * 3
    assert [(len(m.faces), len(m.vertices)) for m in (default, red, other)] == [(1, 3), (2, 4), (1, 3)]
    assert_array_equal(triangles(red)[0], [[0, 0, 0], [1, 1, 0], [0, 1, 0]])
    found = red.material
    assert (found.ior, found.alpha) == (1.2, 0.25)  # from Ka and Ni
    assert found.diffuse == (1.9, 0.1, 0.1)
    assert found.specular == (0.2, 0.3, 0.4)
    found = model(text, MTL, convention="standard")[1].material
    assert (found.ior, found.alpha) == (0.25, pytest.approx(math.sqrt(2 / 100)))  # from Ni and Ns
    assert default.material.ior == 1.1022
    assert other.material.ior == 1.1022


@pytest.mark.parametrize("name", ["art\\a.png", "art/my a.png", "b #2.png", '"my a.png"', "my\\ a.png"])
def test_names_of_files(model, tmp_path, name):
    file = tmp_path / name.replace("\\ ", " ").replace("\\", "/").strip('"')
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"")
    (tmp_path / "my model.mtl").write_text(PAINTED.replace("picture.png", name))
    (mesh,) = model(USE_PAINTED.replace("model.mtl", "my model.mtl"))
    assert Path(mesh.material.texture) == file


placed = Cases()
placed("", [[0, 0], [1, 0], [1, 1]], "")
placed("-s -2 3 1 -blendu on -clamp off", [[0, 0], [-2, 0], [-2, 3]], "")
placed("-o .5 -.25 -mm 0.1 .5 -clamp on", [[0.5, -0.25], [1.5, -0.25], [1.5, 0.75]], "-clamp on")
placed("-s 2 -o 1 -bm 0.3", [[1, 0], [3, 0], [3, 1]], "-bm 0.3")


@pytest.mark.parametrize(("options", "uvs", "unused"), placed)
def test_options_of_a_texture(model, tmp_path, options, uvs, unused):
    """Obeyed, or named in a warning."""
    (tmp_path / "my picture.png").write_bytes(b"")
    mtl = PAINTED.replace("picture.png", f"{options} my picture.png # x")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (mesh,) = model(USE_PAINTED, mtl)
    texts = [str(each.message).partition(": ")[2] for each in caught]
    assert texts == [f"{unused} is not used"] * bool(unused)
    assert_allclose(mesh.uvs[mesh.faces[0]], uvs)


@pytest.mark.parametrize("convention", ["report", "standard"])
def test_a_textured_square(tmp_path, convention):
    """Grey above black; values are as stored in the report's convention, which turns pictures upside down,
    and decoded from sRGB in the standard one. Base and gain are of the values looked up, also when exported.
    """
    halves = np.zeros((4, 4, 3), np.uint8)
    halves[:2] = 128
    Image.fromarray(halves).save(tmp_path / "halves.png")
    row, grey = {"report": (-1, 128 / 255), "standard": (0, 0.21586)}[convention]
    (tmp_path / "a.mtl").write_text("newmtl a\nKs 0 0 0\nmap_Kd -mm 0.1 0.5 halves.png\n")
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{WHOLE}usemtl a\nf 1/1 2/2 3/3 4/4\n")
    view = {"camera": (0.5, 0.5, 2), "target": (0.5, 0.5, 0), "fov": 20}
    options = {"width": 8, "height": 8, "aa": 1, "aamode": "none", "layers": ["albedo"]}
    written = write_xml(tmp_path / "a.obj", tmp_path / "b.xml", convention=convention, **view)
    for scene, more in ((tmp_path / "a.obj", {**view, "convention": convention}), (written[-1], {})):
        column = mrt.render(scene, **options, **more).layers["albedo.R"][:, 4]
        assert_allclose(column[[row, -1 - row]], [0.1 + 0.5 * grey, 0.1], rtol=1e-4)


named = Cases()
named("Material #1", "Material #1", True)
named("Material #1", "Material #2", False)
named("two words # c", "two words", True)
named("two words", "two words # comment", True)
named("red # one", "red #", True)
named("red", "red #comment", True)
named("red", "Red", False)


@pytest.mark.parametrize(("name", "use", "found"), named)
def test_names_of_materials(model, name, use, found):
    text = f"mtllib model.mtl\n{SQUARE}usemtl {use}\nf 1 2 3\nusemtl {use}\nf 1 2 4\n"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (mesh,) = model(text, f"newmtl {name}\nKd 0.25\nnewmtl other\nKd 1\n")
    assert (mesh.material.diffuse == (0.25,) * 3) is found
    said = [str(each.message) for each in caught]
    assert len(said) == (not found)
    assert found or f"model.obj:6: no library has the material '{use}'" in said[0]  # where it is used first


def test_the_first_library_that_has_a_material_counts(model, tmp_path):
    for name, value in (("a.mtl", 0.25), ("b.mtl", 0.5)):
        (tmp_path / name).write_text(f"newmtl m\nKd {value}\nnewmtl {name[-5]}\nKd {value}\n")
    face = "usemtl m\nf 1 2 3\nusemtl b\nf 1 3 4\n"
    first, second = model(f"mtllib a.mtl b.mtl\n{SQUARE}{face}")
    assert (first.material.diffuse[0], second.material.diffuse[0]) == (0.25, 0.5)


def test_a_texture_is_looked_for_next_to_the_model_before_the_library(model, tmp_path):
    (tmp_path / "library").mkdir()
    near = tmp_path / "picture.png"
    far = tmp_path / "library" / "picture.png"
    (tmp_path / "library" / "model.mtl").write_text(PAINTED)
    text = USE_PAINTED.replace("model.mtl", "library/model.mtl")
    far.write_bytes(b"")
    assert model(text)[0].material.texture == str(far)
    near.write_bytes(b"")
    assert model(text)[0].material.texture == str(near)


@pytest.mark.parametrize("corners", ["1/4 2/3 3/2", "-5/-1 -4/-2 -3/-3"])
def test_faces_without_coordinates_have_no_texture(model, tmp_path, corners):
    """Of five points and four coordinates, counted from either end."""
    (tmp_path / "picture.png").write_bytes(b"")
    faces = f"v 9 9 9\nf {corners}\nf 1 3 4"
    textured, plain = model(USE_PAINTED.replace("f 1/1 2/2 3/3", faces), PAINTED)
    assert textured.material.texture == str(tmp_path / "picture.png")
    assert_array_equal(textured.uvs[textured.faces[0]], [[0, 1], [1, 1], [1, 0]])
    assert plain.material.texture is None
    assert plain.uvs is None
    assert plain.material.diffuse == (0.5,) * 3


LOST = "mtllib nowhere.mtl\n" + SQUARE + "usemtl red\nf 1 2 3\n"
BLANKS = LOST.replace("nowhere", "no where")
DROPPED = "newmtl painted\nKd 0.5\nillum 2\nd 0.5\nd 1.0\nTf 1 1 1\nmap_bump x.png\nKe 2 2 2\nKe 0.0 0 0\n"
EXTRA = SQUARE.replace("1 0\n", "1 0 1 1 1 1\n").replace("0 0\n", "0 0 1 1 1\n") + "t 1 2\nvw 1\nf 1 2 3\n"
gaps = Cases()
gaps(USE_PAINTED, PAINTED, "report", ["model.mtl:9: the texture picture.png is missing", "Kd is used"])
gaps(LOST, None, "report", ["model.obj:1: the material library nowhere.mtl is", "material 'red'"])
gaps(BLANKS, None, "report", ["model.obj:1: the material library no where.mtl is", "material 'red'"])
for each in ("standard", "report"):
    gaps(USE_PAINTED, DROPPED, each, ["model.mtl:4: d 0.5 is not used, nor map_bump, Ke"])
    colours = "1: colours of vertices are not used"
    gaps(EXTRA, None, each, [colours, "5: the statement 't' is unknown", "; 1 more"])
gaps(USE_PAINTED, "newmtl painted\nKd 0.5\nNs 9\nd 1\nKe 0 0 0", "report", [])


@pytest.mark.parametrize(("obj", "mtl", "convention", "texts"), gaps)
def test_what_is_missing_or_dropped_is_a_warning(model, obj, mtl, convention, texts):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (mesh,) = model(obj, mtl, convention=convention)
    said = "\n".join(str(each.message) for each in caught)
    assert all(text in said for text in texts)
    assert bool(said) is bool(texts)
    assert "more libraries" not in said
    assert mesh.material.texture is None
    assert (mesh.material.diffuse == (0.5,) * 3) is (mtl is not None)


def test_alpha_of_a_texture_is_a_warning(model, tmp_path):
    for alpha, kinds in ((255, 0), (9, 1)):
        Image.new("RGBA", (2, 2), (1, 2, 3, alpha)).save(tmp_path / "picture.png")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model(USE_PAINTED, PAINTED)
        assert [str(each.message).split()[1] for each in caught] == ["alpha"] * kinds


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
    start=st.sampled_from(["", SQUARE, "mtllib model.mtl\n" + WHOLE]),
    mtl=st.lists(st.sampled_from(MTL_PIECES), max_size=30).map(" ".join),
)
def test_any_text_is_read_or_refused(model, obj, start, mtl):
    """Whatever the file: meshes that hold together, or one error of one line that names a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MrtWarning)
        try:
            meshes = model(start.encode() + obj, mtl)
        except SceneError as error:
            assert re.search(r"model\.(obj|mtl)", str(error))
            return
    assert meshes
    for mesh in meshes:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.shape[1] == 3
        assert len(mesh.faces) > 0
        assert mesh.faces.max() < len(mesh.vertices)


def test_view_as_asked_for(tmp_path):
    (path := tmp_path / "a.obj").write_text(SQUARE + "f 1 2 3\n")
    view = obj_scene(path, camera=(0, 0, 5), fov=30, convention="standard")
    assert view.camera == Camera((0, 0, 5), (0.5, 0.5, 0), hfov=30)
    assert view.texturing == "standard"


def test_the_standard_uses_normals_and_the_report_does_not(model):
    """That they shade: ``tests/system/test_whitted.py``."""
    text = SQUARE + "vn 0 0 1\nvn 0 1 0\nf 1//1 2//1 3//2\n"
    assert model(text, convention="report")[0].normals is None
    (mesh,) = model(text, convention="standard")
    assert_array_equal(mesh.normals[mesh.faces[0]], [[0, 0, 1], [0, 0, 1], [0, 1, 0]])
