"""What is refused, by every door: an error of one line that names the thing and the way out, and no file."""

from __future__ import annotations

import base64
import io
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import SENSOR, SMALL, TRIANGLE, scene_xml
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.runtime import obstacle
from mrt_mitsuba.scene.model import BLUE_SKY, Camera, Cone, Cylinder, Material, Mesh, Scene, Sphere

PIPE = object()
Content = str | bytes | Path | object | None  # None: a folder; a Path: a symbolic link to it

LARGE = SENSOR.format("<integer name='width' value='99999'/><integer name='height' value='99999'/>")
FILTER = "<rfilter type='gaussian'><float name='stddev' value='1e9'/></rfilter>"
SAMPLER = """<sensor type='perspective'><sampler type='multijitter'><integer name='sample_count' value='0'/>
</sampler></sensor>"""
MODEL = "mtllib a.mtl\n" + TRIANGLE
PICTURE = "newmtl m\nKd 1 1 1\nmap_Kd p.png\n"
WHITE = base64.b64decode(  # one pixel
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4//8/AAX+Av4N70a4AAAAAElFTkSuQmCC"
)
SPECTRUM = """<shape type='sphere'><bsdf type='diffuse'><spectrum name='reflectance' filename='s.spd'/></bsdf>
</shape>"""


def xml(inside: str, sensor: str = SMALL) -> dict[str, Content]:
    return {"a.xml": scene_xml(inside, sensor)}


MISSPELT = "<shape type='sphere'><bsdf type='mrt_bsdf'><float name='aplha' value='1'/></bsdf></shape>"


def textured(picture: Content) -> dict[str, Content]:
    return {"a.obj": MODEL, "a.mtl": PICTURE, "p.png": picture}


# Files, arguments, the exit code and what the one line must hold
Case = tuple[dict[str, Content], str, int, str]

WRONG = """
out width=0 -> width=0: must be a whole number; out 17 -> SCENE 17: must be; 3 -> FILENAME is missing
doctr -> did you mean mrt doctor; exprot --xml a.xml -> mrt export
doctor now -> unexpected argument 'now' after mrt doctor; scenes all -> unexpected argument
help me -> unexpected; export -> PATH is missing; export 3 -> --xml PATH; export 3 --xml -> --xml PATH
export --xml a.xml -> PATH is missing; export 17 --xml a.xml -> SCENE 17; export 3 --obj a.xml -> --xml PATH
export 3 --xml a.xml b.xml -> unexpected argument
export 0 --xml a.xml --stock --stock -> stock is given twice; export 3 --xml a.xml aa=2 -> aa is of no use
export 3 --xml a.xml fov=30 -> only with an OBJ file; .. 3 -> names no file
export 3 scene=a.xml --xml b.xml -> unexpected argument
check -> SCENE|scene=PATH is missing; check 0 1 -> unexpected argument '1'
check 0 quick=2 -> must be 0 or 1; check 0 scene=1 -> unexpected argument
error-vs-time 0 -> cases is missing; error-vs-time 3 4 -> unexpected argument '4'
out variant=scalar_rbg -> Did you mean scalar_rgb?; out variant=fast -> This Mitsuba has scalar_rgb
sweep out -> FILE.toml is missing; sweep out no.toml -> cannot read no.toml
sweep out no.toml worker=2 -> meant workers?; check 0 out=a out=b -> out is given twice
error-vs-time 0 cases=no.toml -> cannot read no.toml: there is no such file
"""

OUTPUTS: list[Case] = [
    *(({}, words, 2, text) for words, text in re.findall(r"(\S.*?) -> (.*?)(?:; |\n)", WRONG)),
    *[({}, "out variant=cuda_ad_rgb", 1, "Use llvm_ad_rgb or scalar_rgb")] * bool(obstacle("cuda_ad_rgb")),
    ({"out.png": None}, "out", 1, "out.png: it is a folder; choose another name"),
    ({"file": ""}, "file/out", 1, "is a file, not a folder; choose another place"),
    ({}, "none/out", 1, "does not exist; create it first"),
    ({"out.exr": Path("b.exr"), "b.exr": Path("out.exr")}, "out", 1, "links lead in a circle"),
    ({"out.png": PIPE}, "out", 1, "out.png: it is not a regular file"),
    ({"out_mesh_0.ply": None}, "export 8 --xml out.xml", 1, "out_mesh_0.ply: it is a folder"),
    ({}, "export 0 --xml none/a.xml", 1, "does not exist; create it first"),
    ({"a.xml": None}, "export 0 --xml a.xml", 1, "a.xml: it is a folder"),
    (textured(WHITE), "p scene=a.obj aa=1", 1, "cannot write p.png: what is written is made from"),
    (textured(WHITE) | {"a.obj": MODEL.replace("/1", "")}, "p scene=a.obj aa=1", 1, "cannot write p.png"),
    (xml("") | {"out.exr": Path("a.xml")}, "out scene=a.xml", 1, "out.exr: what is written is made from"),
    (textured(WHITE) | {"out.exr": Path("a.mtl")}, "out scene=a.obj", 1, "out.exr: what is written is made"),
    (xml("") | {"l.xml": Path("a.xml")}, "export scene=l.xml --xml ./a.xml", 1, "a.xml: what is written is"),
    (textured(WHITE), "export scene=a.obj --xml a.mtl", 1, "a.mtl: what is written is made from this file"),
    (xml(SPECTRUM) | {"s.spd": "4 1\n7 1\n"}, "export scene=a.xml --xml s.spd", 1, "s.spd: what is written"),
    ({}, "export scene=no.xml --xml b.xml", 1, "cannot read no.xml: there is no such file"),
    (xml(""), "export scene=a.xml --xml b.xml --stock", 2, "flavor=stock is of no use with an XML file"),
    (xml(""), "export scene=a.xml --xml b.xml width=3", 2, "width is of no use with an XML file"),
]

SIZES: list[Case] = [
    ({}, "out width=16384 height=16384 aa=1 memory=512M", 2, "needs 4.1 GiB of memory, and 512 MiB"),
    ({}, "out width=65536 height=65536 aa=1 memory=16G", 2, "choose a smaller width and height"),
    (xml("", LARGE), "out scene=a.xml memory=512M", 2, "a picture of 99999x99999 pixels needs"),
]

FILES: list[Case] = [
    ({}, "out scene=a.obj", 1, "cannot read a.obj: there is no such file in"),
    ({}, "out scene=a.xml", 1, "cannot read a.xml: there is no such file in"),
    ({"d.xml": None}, "out scene=d.xml", 1, "cannot read d.xml: it is a folder; name a file in it"),
    ({"a.xml": PIPE}, "out scene=a.xml", 1, "it is not a regular file; copy its content into one"),
    ({"a.obj": Path("a.obj")}, "out scene=a.obj", 1, "levels of symbolic links"),
    ({"a\nb.obj": None}, "out scene=a\nb.obj", 1, "cannot read a\\nb.obj: it is a folder; name a file"),
    ({"a.ply": ""}, "out scene=a.ply", 2, "a scene file ends in .xml or .obj"),
]

SCENES: list[Case] = [
    ({"a.xml": ""}, "out scene=a.xml", 1, "cannot load a.xml"),
    ({"a.xml": b"\xff\xfe\0"}, "out scene=a.xml", 1, "cannot load a.xml"),
    ({"a.xml": f"<scene>{SMALL}</scene>"}, "out scene=a.xml", 1, "missing version attribute"),
    (xml("<shape type='sphere'/>", ""), "out scene=a.xml", 1, "a.xml has no sensor: add one"),
    (xml("<shape type='potato'/>"), "out scene=a.xml", 1, 'Plugin "potato" not found'),
    (xml("<include filename='a.xml'/>"), "out scene=a.xml", 1, "recursion depth"),
    (xml("", SENSOR.format("<integer name='height' value='0'/>")), "out scene=a.xml", 1, "768x0: give it"),
    (xml("", "<sensor type='irradiancemeter'/>"), "out scene=a.xml", 1, "irradiancemeter outside of a shape"),
    (xml("", SENSOR.format(FILTER)), "out scene=a.xml", 1, "a.xml has a filter of radius"),
    (xml("", SAMPLER), "out scene=a.xml", 1, "multijitter: sample_count is 0; give 1 to 16777216"),
    (xml(""), "out scene=a.xml fresnel=schlick", 2, "it is a parameter of mrt_bsdf"),
]

TABLES: list[Case] = [
    ({"a.toml": text}, words.format("a.toml"), 2, message)
    for words, text, message in [
        ("error-vs-time 3 cases={}", "cases = {}", "no entry 'reference'"),
        ("error-vs-time 3 cases={}", "repeat = 2\n[cases]\na = {aa = 1}\n", "unknown entry 'repeat'"),
        ("sweep out {} workers=x", "", "must be a whole number"),
        ("sweep out {}", "a =", "cannot read"),
        ("sweep out {}", "grid = 3", "grid must be a table"),
        ("sweep out {}", "out = 'x'", "out cannot be set in a file"),
        ("sweep out {}", "[grid]\nmaterial_0.alpha = []", "material_0.alpha is an empty list"),
    ]
]

MODELS: list[Case] = [
    (xml(MISSPELT), "out scene=a.xml", 1, '- float "aplha"'),
    (textured("no picture"), "out scene=a.obj", 1, "p.png', which cannot be read"),
    (textured(b"\x89PNG\r\n\x1a\n\0\0"), "out scene=a.obj", 1, "p.png', which cannot be read"),
    ({"a.obj": TRIANGLE}, "out scene=a.obj camera=0,9,0 target=0,0,0", 2, "choose another up"),
]

NAMED = "<string name='filename' value='{}'/>"
TEXTURED = "<shape type='sphere'><bsdf type='{}'><texture name='{}' type='{}'>{}</texture></bsdf></shape>"
TEXTURES = [
    TEXTURED.format(*bsdf, kind, NAMED)
    for bsdf in (("mrt_bsdf", "diffuse_reflectance"), ("diffuse", "reflectance"))
    for kind in ("mrt_texture", "bitmap")
]
READ = [
    *("<include filename='{}'/>", "<default name='p' value='{}'/><include filename='$p'/>"),
    "<include filename='p&#105;pe'/>",
    *(f"<emitter type='envmap'>{NAMED}</emitter>", f"<shape type='ply'>{NAMED}</shape>"),
    f"<path value='in'/>{SPECTRUM.replace('s.spd', 'spectrum')}",
]
PIPES = {"in": None, "pipe": PIPE, "in/spectrum": PIPE}
BLACK = io.BytesIO()  # 6 kB, and 0.7 GB of texels at work
Image.new("1", (4000, 4000)).save(BLACK, "PNG")
LARGE_TEXTURE, SAID = {"b.png": BLACK.getvalue()}, "b.png of 4000x4000 texels, "
HOSTILE: list[Case] = [
    *((xml(t.format("pipe")) | PIPES, "out scene=a.xml", 1, "not a regular file") for t in READ + TEXTURES),
    *((xml(t.format("b.png")) | LARGE_TEXTURE, "out scene=a.xml memory=64M", 2, SAID) for t in TEXTURES),
]

CASES = OUTPUTS + SIZES + FILES + SCENES + TABLES + MODELS + HOSTILE


def put(path: Path, content: Content) -> None:
    if content is None:
        path.mkdir()
    elif content is PIPE:
        os.mkfifo(path)
    elif isinstance(content, Path):
        path.symlink_to(content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


def refusal(capture: pytest.CaptureFixture[str], words: list[str]) -> tuple[int, str]:
    """Exit code and the one line of a run that must fail."""
    code = cli.main([*words, "quiet=1"] if words[0] in ("out", "p") else words)
    errors = capture.readouterr().err
    assert errors.startswith("mrt: ") and errors.count("\n") == 1, errors
    assert "Traceback" not in errors and "MRT_TRACEBACK" not in errors, errors
    return code, errors


@pytest.mark.parametrize(("files", "words", "code", "text"), CASES, ids=range(len(CASES)))
def test_command_refuses(
    tmp_path: Path, monkeypatch, capfd, files: dict[str, Content], words: str, code: int, text: str
) -> None:
    for name, content in files.items():
        put(tmp_path / name, content)
    monkeypatch.chdir(tmp_path)
    found, message = refusal(capfd, words.split(" "))
    assert text in message
    assert found == code
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")}
    assert left == files.keys(), "files were left behind"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read anything")
@pytest.mark.parametrize("name", ["a.obj", "a.xml"])
def test_file_that_may_not_be_read(tmp_path: Path, monkeypatch, capfd, name: str) -> None:
    (tmp_path / name).touch(mode=0o200)
    monkeypatch.chdir(tmp_path)
    code, message = refusal(capfd, ["out", f"scene={name}"])
    assert code == 1 and f"try chmod +r {name}" in message


def test_pictures_of_every_kind_are_read(variant: str, tmp_path: Path) -> None:
    """Black and white, grey, palette, alpha, 16 bits."""
    levels = np.arange(12).reshape(3, 4) * 20
    for mode in ("1", "L", "LA", "P", "RGBA", "I;16"):
        image = Image.fromarray(levels.astype(np.uint16 if mode == "I;16" else np.uint8))
        (image if mode == "I;16" else image.convert(mode)).save(tmp_path / "p.png")
        texture = mi.load_dict({"type": "mrt_texture", "filename": str(tmp_path / "p.png")})
        assert list(texture.resolution()) == [4, 3]


SQUARE, UVS, NORMAL = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n", "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n", "vn 0 0 1\n"
FACE = "f 1 2 3\n"
# The text, the line that is named, and what is said of it
BROKEN_OBJ: list[tuple[str, int | None, str]] = [
    ("", None, "has no faces; export the model with its geometry"),
    (SQUARE + 2 * FACE + "f 1 2 9\n", 7, "v index 9, but the file has 4"),
    (SQUARE + "f 1 \\\n2 \\\n3\nf 1 2 9\n", 8, "v index 9"),
    (SQUARE + "f 0 1 2\n", 5, "v index of 0, or before the first; indices count from 1"),
    (SQUARE + UVS + "f 1/1 2/2 3/5\n", 9, "vt index 5, but the file has 4"),
    (SQUARE + "f 1/-1 2/-1 3/-1\n", 5, "vt index of 0, or before the first"),
    (SQUARE + "f 1 2\n", 5, "must have 3 corners or more"),
    (SQUARE + UVS + "f 1/1 2 3/3\n", 9, "all v, v/vt, v//vn or v/vt/vn"),
    (SQUARE + "f a b c\n", 5, "'f a b c'"),
    (SQUARE + "f 1 2 99999999999999999999\n", 5, "9999"),
    ("v 0 0 0\nv 0 1e39 0\n" + SQUARE + "f 1 2 3\n", 2, "too large"),
    ("v 0 0\n" + SQUARE + "f 1 2 3\n", 1, "must have 3 to 7 numbers"),
    ("v 0,5 0 0\n" + SQUARE + "f 1 2 3\n", 1, "but is 'v 0,5 0 0'"),
    (SQUARE + "vn 0 1\n" + FACE, 5, "vn must have 3 numbers"),
    (SQUARE + "vertex 1 2 3\n" + FACE, 5, "unknown statement 'vertex'"),
    ("v 0 0 0\n\0\1\2", None, "zero byte"),
    (SQUARE + "usemtl\n" + FACE, 5, "usemtl has no name"),
    ("mtllib\n" + SQUARE + "f 1 2 3\n", 1, "mtllib has no name"),
]
BROKEN_MTL: list[tuple[str, int | None, str]] = [
    ("Kd 1 1 1\n", 1, "before any newmtl"),
    ("newmtl\n", 1, "newmtl has no name"),
    ("newmtl a\nKs 0 -1 0\n", 2, "finite and not negative"),
    ("newmtl a\nKd 1 1\n", 2, "one or three numbers, finite and not negative, but is '1 1'"),
    ("newmtl a\nNi\n", 2, "Ni must be one number"),
    ("newmtl a\nNi glass\n", 2, "'glass'"),
    ("newmtl a\nKd 1e39 0 0\n", 2, "but is '1e39 0 0'"),
    ("newmtl a\nKd spectral file.rfl\n", 2, "but is 'spectral file.rfl'"),
    ("newmtl a\nmap_Kd\n", 2, "names no file"),
    ("newmtl a\n\0", None, "zero byte"),
]
LIBRARY = "mtllib a.mtl\n" + SQUARE + FACE


@pytest.mark.parametrize(
    ("name", "text", "line", "words"),
    [("a.obj", *row) for row in BROKEN_OBJ] + [("a.mtl", *row) for row in BROKEN_MTL],
    ids=range(len(BROKEN_OBJ) + len(BROKEN_MTL)),
)
def test_models_name_file_and_line(
    tmp_path: Path, name: str, text: str, line: int | None, words: str
) -> None:
    (tmp_path / "a.obj").write_text(LIBRARY)
    (tmp_path / name).write_text(text)
    with pytest.raises(mrt.SceneError) as caught:
        mrt.render(tmp_path / "a.obj")
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert (f"{name}:{line}: " if line else f"{name}: ") in str(caught.value)


TINY: dict[str, Any] = {"width": 8, "height": 6, "aa": 1}
MATTE = Material(1.5, 0.1, (0, 0, 0), (0.5, 0.5, 0.5))
EMPTY = Scene(Camera((0, 0, 5), (0, 0, 0)), BLUE_SKY, ())
NAN, INFINITE = math.nan, math.inf
POINTS, BALL = np.zeros((3, 3)), Sphere((0, 0, 0), 1, MATTE)


ARGUMENTS: list[tuple[type[Exception], dict[str, Any], str]] = [
    (TypeError, {"widht": 8}, "'widht' is not an option of render: did you mean width?"),
    *(
        (mrt.UsageError, arguments, text)
        for arguments, text in [
            ({"scene": 99}, "there is no scene 99: choose one of 0, 1, 2, 3"),
            ({"scene": -1}, "there is no scene -1: choose one of 0, 1, 2, 3"),
            ({"scene": 1.5}, "scene is 1.5: give a number, a Scene, a dict, a Mitsuba scene or a path"),
            ({"scene": None}, "scene is None: give a number"),
            ({"width": 0}, "width=0: must be a whole number from 1 to 65536"),
            ({"motion": (1, 2)}, "motion=(1, 2): must be three finite numbers"),
            ({"aamode": "none", "layers": ["edges"]}, "edges"),
            ({"fresnel": "exact"}, "fresnel='exact': must be schlick or dielectric"),
            ({"integrator": 3}, "the integrator is 3: it must be one, such as path"),
            ({"integrator": "ptracer", "aamode": "sobel"}, "ParticleTracerIntegrator gives whole pictures"),
        ]
    ),
    *(
        (mrt.SceneError, {"scene": scene}, text)
        for scene, text in [
            ("", "cannot read '': there is no such file"),
            ("a\nb.xml", "cannot read a\\nb.xml: there is no such file"),
            ("a\0b.xml", "embedded null"),
            ({"type": "scene"}, "a dict has no sensor: add one"),
            ({"type": "potato"}, 'Plugin "potato" not found'),
            ({"type": "sphere"}, "a dict is a Shape, not a scene: put it into one"),
            ({"type": 3}, "type is 3; give the name of a plugin"),
            ({"type": "scene", "ball": {"type": "sphere", "center": None}}, "ball.center is None; give it a"),
            ({"type": "mrt_bsdf", "alpha": "big"}, "mrt_bsdf: \"alpha\" is 'big', but must be a number"),
            (replace(EMPTY, sky=(0, NAN, 0)), "sky is (0, nan, 0), but must be three finite"),
            (replace(EMPTY, texturing="nice"), "texturing is 'nice', but must be report or standard"),
            (replace(EMPTY, camera=Camera((1, 1, 1), (1, 1, 1))), "are the same point"),
            (replace(EMPTY, camera=Camera((0, NAN, 0), (0, 0, 0))), "position is (0, nan, 0)"),
            (replace(EMPTY, camera=Camera((0, 0, 5), (0, 0, 0), hfov=180)), "less than 180 degrees"),
            (replace(EMPTY, camera=Camera((0, 0, 5), (0, 0, 0), hfov="wide")), "hfov is 'wide'"),
            (replace(EMPTY, spheres=(BALL, replace(BALL, radius=0))), "spheres[1] is Sphere("),
            (replace(EMPTY, cones=(Cone((0, 0, INFINITE), (0, 0, 0), 1, MATTE),)), "cones[0] is"),
            (replace(EMPTY, cylinders=(Cylinder((0, 0, 0), (0, 0, 0), 1, MATTE),)), "two points"),
            (
                replace(EMPTY, meshes=(Mesh(POINTS, np.array([[0, 1, 7]]), MATTE),)),
                '"faces" holds 7, but there',
            ),
        ]
    ),
]


@pytest.mark.parametrize(("error", "arguments", "text"), ARGUMENTS, ids=range(len(ARGUMENTS)))
def test_render_refuses(error: type[Exception], arguments: dict[str, Any], text: str) -> None:
    size = {"aa": 1} if isinstance(arguments.get("scene"), dict | str) else TINY
    with pytest.raises(error, match=re.escape(text)) as caught:
        mrt.render(**{**size, **arguments})
    assert not re.search(r"\n|Traceback|\.cpp:", str(caught.value))


def test_objects_of_another_variant_are_named() -> None:
    mi.set_variant("scalar_rgb")
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}})
    integrator = mi.load_dict({"type": "path"})
    mi.set_variant("llvm_ad_rgb")
    for given in ({"scene": scene}, {"integrator": integrator}):
        with pytest.raises(mrt.UsageError, match="was loaded in the variant scalar_rgb, and llvm_ad_rgb is"):
            mrt.render(**TINY | given)


CORNERS = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
MESH = {"type": "mrt_mesh", "positions": CORNERS, "faces": np.array([[[0, 1, 2]]], np.uint32)}
ONE = np.array([[0, 0, 0, 1]], np.float32)
GROUP = {"type": "mrt_group"}
UP = {"type": "mrt_plane", "normal": [0, 1, 0]}
TIP = {"type": "mrt_cone", "apex": [0, 0, 1], "base_center": [0, 0, 0]}
ADAPTIVE = {"type": "mrt_adaptive", "nested": {"type": "path"}}
PLUGINS: list[tuple[dict[str, Any], str]] = [
    ({"type": "mrt_adaptive"}, "give one integrator inside"),
    (ADAPTIVE | {"tarqet": 1.0}, '"tarqet" is none of its parameters'),
    (ADAPTIVE | {"target": 0.0}, '"target" is 0.0, but must be a finite number > 0'),
    (ADAPTIVE | {"target": 0.1, "spp": 64}, 'give "target" or "spp", not both'),
    ({"type": "mrt_bsdf", "alpha": NAN}, '"alpha" is nan, but must be a finite number'),
    ({"type": "mrt_bsdf", "alpha": True}, '"alpha" is True, but must be a number'),
    ({"type": "mrt_bsdf", "int_ior": 0.0}, '"int_ior" is 0.0, but must be a finite number > 0'),
    ({"type": "mrt_bsdf", "diffuse_reflectance": "red"}, "is 'red', but must be a number, a colour"),
    ({"type": "mrt_bsdf", "specular_reflectance": {"type": "rgb", "value": [1, -1, 1]}}, "not negative"),
    ({"type": "mrt_bsdf", "fresnel": {"type": "rgb", "value": 1}}, "one of schlick, dielectric, unity"),
    ({"type": "mrt_bsdf", "f0": 0.1, "fresnel": "unity"}, '"f0" has no meaning with fresnel="unity"'),
    ({"type": "mrt_bsdf", "sample_visible": 1}, '"sample_visible" is 1, but must be true or false'),
    ({"type": "mrt_bsdf", "aplha": 0.1}, '"aplha"'),
    ({"type": "mrt_light", "position": [0, NAN, 0]}, '"position" is'),
    ({"type": "mrt_light", "to_world": 1.0}, '"to_world"'),
    ({"type": "mrt_plane"}, '"normal" is missing; give three numbers'),
    (UP | {"normal": [0, 0, 0]}, '"normal" is [0, 0, 0], but must be a vector of non-zero length'),
    (UP | {"extent": 0.0}, '"extent" is 0.0, but must be a finite number > 0'),
    (UP | {"to_world": 2.0}, 'mrt_plane: "to_world" is not accepted'),
    ({"type": "mrt_whitted", "sky": -1.0}, '"sky" is -1.0, but must be finite and not negative'),
    ({"type": "mrt_whitted", "max_depth": 2**32}, "but must be an integer from 1 to 4294967295"),
    ({"type": "mrt_texture"}, "give one of"),
    ({"type": "mrt_texture", "filename": "nothing.png"}, "nothing.png"),
    ({"type": "mrt_texture", "bitmap": 3}, '"bitmap" is 3, but must be a mi.Bitmap'),
    ({"type": "mrt_cone"}, '"apex" is missing'),
    (TIP | {"radius": -1.0}, '"radius" is -1'),
    (TIP | {"segments": 2}, '"segments" is 2, but must be an integer from 3 to 65536'),
    (TIP | {"apex": [0, 0, 0]}, "two points"),
    (TIP | {"capped": 1}, "true or false"),
    (TIP | {"to_world": mi.scalar_rgb.ScalarTransform4f().scale([0.0, 1, 1])}, "not invertible"),
    (MESH | {"faces": None}, '"faces" must be'),
    (MESH | {"faces": np.array([[[0, 1, 3]]], np.uint32)}, '"faces" holds 3, but there are 3'),
    (MESH | {"positions": CORNERS * np.float32(np.nan)}, '"positions" holds a number that is not finite'),
    (MESH | {"texcoords": CORNERS[:, :2]}, '"texcoords" has 2 entries for 3 positions'),
    (MESH | {"faces": np.array([[[0, 1, -2]]], np.float32)}, '"faces" holds -2'),
    (GROUP, '"numbers" must be a mi.Bitmap'),
    (GROUP | {"numbers": ONE[:, :3]}, "3 numbers for an object, but must have 4"),
    (GROUP | {"numbers": ONE * np.float32("nan")}, "row 0 of "),
    (GROUP | {"numbers": np.ones((1, 7), np.float32), "kind": "cone"}, "axis of no length"),
    (GROUP | {"numbers": ONE, "face_x": np.ones((2, 1), np.float32)}, "has 2 rows for 1 objects"),
    (GROUP | {"numbers": ONE, "kind": "cube"}, "sphere, cone, cylinder"),
]


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize(("plugin", "text"), PLUGINS, ids=range(len(PLUGINS)))
def test_plugins_name_the_parameter(variant: str, plugin: dict[str, Any], text: str) -> None:
    given = {name: mi.Bitmap(v) if isinstance(v, np.ndarray) else v for name, v in plugin.items()}
    with pytest.raises(RuntimeError, match=re.escape(text)) as caught:
        mi.load_dict({name: v for name, v in given.items() if v is not None})
    assert plugin["type"] in str(caught.value)
