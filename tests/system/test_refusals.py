"""What is refused, by every door: an error of one line that names the thing and the way out, and no file."""

from __future__ import annotations

import base64
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import SENSOR, SMALL, TRIANGLE, scene_xml

import mrt_mitsuba as mrt
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.plugins.quadric_kinds import CLOSED
from mrt_mitsuba.runtime import obstacle
from mrt_mitsuba.scene.model import BLUE_SKY, Camera, Cone, Material, Mesh, Scene, Sphere

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


def xml(inside: str, sensor: str = SMALL) -> dict[str, Content]:
    return {"a.xml": scene_xml(inside, sensor)}


MISSPELT = "<shape type='sphere'><bsdf type='mrt_bsdf'><float name='aplha' value='1'/></bsdf></shape>"


def textured(picture: Content) -> dict[str, Content]:
    return {"a.obj": MODEL, "a.mtl": PICTURE, "p.png": picture}


COMMANDS = Cases()


def refused(words: str, says: str, files: dict[str, Content] | None = None, *, code: int = 1) -> None:
    """Add a command that must fail next to such files, and what its one line must hold."""
    COMMANDS(files or {}, words, code, says)


def misused(words: str, says: str, files: dict[str, Content] | None = None) -> None:
    refused(words, says, files, code=2)


# --------------------------------------------- Arguments ---------------------------------------------

misused("3", "FILENAME is missing")
misused("exprot --xml a.xml", "mrt export")
misused("help me", "no command 'me': choose one of help, doctor")
misused("export --xml a.xml", "SCENE or scene=PATH is missing")
misused("export 3 scene=a.xml --xml b.xml", "both SCENE 3 and scene=a.xml")
misused("check roughconductor", "a file is scene=PATH")
misused("sweep out", "required: FILE.toml")
misused("error-vs-time 0 cases=no.toml", "cannot read no.toml: there is no such file")
if obstacle("cuda_ad_rgb"):
    refused("out variant=cuda_ad_rgb", "Use llvm_ad_rgb or scalar_rgb")

# ---------------------------------------------- Outputs ----------------------------------------------

refused("out", "out.png: it is a folder; choose another name", {"out.png": None})
refused("file/out", "is a file, not a folder; choose another folder", {"file": ""})
refused("none/out", "does not exist; create it first")
refused("out", "links lead in a circle", {"out.exr": Path("b.exr"), "b.exr": Path("out.exr")})
refused("export 8 --xml out.xml", "out_mesh_0.ply: it is a folder", {"out_mesh_0.ply": None})
linked_mtl = textured(WHITE) | {"out.exr": Path("a.mtl")}
linked_scene = xml("") | {"l.xml": Path("a.xml")}
refused("out scene=a.obj", "out.exr: what is written is made", linked_mtl)
refused("export scene=l.xml --xml ./a.xml", "a.xml: what is written is", linked_scene)
misused("export scene=a.xml --xml b.xml --stock", "flavor=stock is of no use with an XML file", xml(""))

misused("out width=16384 height=16384 aa=1 memory=512M", "needs 4.9 GiB of memory, and 512 MiB")
misused("out scene=a.xml memory=512M", "a picture of 99999x99999 pixels needs", xml("", LARGE))

# ----------------------------------------------- Files -----------------------------------------------

refused("out scene=a.obj", "cannot read a.obj: there is no such file in")
refused("out scene=d.xml", "cannot read d.xml: it is a folder; name a file in it", {"d.xml": None})
refused("out scene=a.xml", "it is not a regular file; copy its content into one", {"a.xml": PIPE})
refused("out scene=a\nb.obj", "cannot read a\\nb.obj: it is a folder; name a file", {"a\nb.obj": None})
misused("out scene=a.ply", "a scene file ends in .xml or .obj", {"a.ply": ""})

# ----------------------------------------------- Scenes ----------------------------------------------

no_height = SENSOR.format("<integer name='height' value='0'/>")
no_place = "<sensor type='irradiancemeter'/>"
refused("out scene=a.xml", "cannot load a.xml", {"a.xml": b"\xff\xfe\0"})
refused("out scene=a.xml", "a.xml has no sensor: add one", xml("<shape type='sphere'/>", ""))
refused("out scene=a.xml", 'Plugin "potato" not found', xml("<shape type='potato'/>"))
refused("out scene=a.xml", "recursion depth", xml("<include filename='a.xml'/>"))
refused("out scene=a.xml", "768x0: give it", xml("", no_height))
refused("out scene=a.xml", "irradiancemeter outside of a shape", xml("", no_place))
refused("out scene=a.xml", "a.xml has a filter of radius", xml("", SENSOR.format(FILTER)))
refused("out scene=a.xml", "multijitter: sample_count is 0; give 1 to 16777216", xml("", SAMPLER))
misused("out scene=a.xml fresnel=schlick", "it is a parameter of mrt_bsdf", xml(""))

refused("out scene=a.xml", '- float "aplha"', xml(MISSPELT))
refused("out scene=a.obj", "p.png', which cannot be read", textured("no picture"))
misused("out scene=a.obj camera=0,9,0 target=0,0,0", "choose another up", {"a.obj": TRIANGLE})

# ------------------------------------------- Tables in TOML ------------------------------------------


def toml(text: str) -> dict[str, Content]:
    return {"a.toml": text}


misused("error-vs-time 3 cases=a.toml", "no entry 'cases'", toml("reference = {}"))
misused("error-vs-time 3 cases=a.toml", "unknown entry 'repeat'", toml("repeat = 2\n[cases]\na = {aa = 1}\n"))
misused("sweep out a.toml", "grid must be a table", toml("grid = 3"))
misused("sweep out a.toml", "out cannot be set in a file", toml("out = 'x'"))

# ----------------------------------- Files without an end, or too large -----------------------------------

NAMED = "<string name='filename' value='{}'/>"
TEXTURED = "<shape type='sphere'><bsdf type='{}'><texture name='{}' type='{}'>{}</texture></bsdf></shape>"
PIPES = {"pipe": PIPE}


def unending(inside: str) -> None:
    refused("out scene=a.xml", "not a regular file", xml(inside.format("pipe")) | PIPES)


unending("<include filename='p&#105;pe'/>")
unending(f"<emitter type='envmap'>{NAMED}</emitter>")
unending(f"<shape type='ply'>{NAMED}</shape>")
for kind in ("mrt_texture", "bitmap"):
    unending(TEXTURED.format("mrt_bsdf", "diffuse_reflectance", kind, NAMED))


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
    assert errors.startswith("mrt: "), errors
    assert errors.count("\n") == 1, errors
    assert "Traceback" not in errors, errors
    assert "MRT_TRACEBACK" not in errors, errors
    return code, errors


@pytest.mark.parametrize(("files", "words", "code", "text"), COMMANDS)
def test_command_refuses(tmp_path, monkeypatch, capfd, files, words, code, text):
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
def test_file_that_may_not_be_read(tmp_path, monkeypatch, capfd, name):
    (tmp_path / name).touch(mode=0o200)
    monkeypatch.chdir(tmp_path)
    code, message = refusal(capfd, ["out", f"scene={name}"])
    assert code == 1
    assert f"try chmod +r {name}" in message


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UVS = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1 2 3\n"
MODELS = Cases()


def broken_obj(text: str, line: int | None, says: str) -> None:
    """Add the text of a file, the line that the error names, and what is said of it."""
    MODELS("a.obj", text, line, says, name=f"obj: {says}")


def broken_mtl(text: str, line: int | None, says: str) -> None:
    MODELS("a.mtl", text, line, says, name=f"mtl: {says}")


broken_obj("", None, "has no faces; export the model with its geometry")
broken_obj(SQUARE + 2 * FACE + "f 1 2 9\n", 7, "v index 9, but the file has 4")
broken_obj(SQUARE + "f 1 \\\n2 \\\n3\nf 1 2 9\n", 8, "v index 9")
broken_obj(SQUARE + "f 0 1 2\n", 5, "v index of 0, or before the first; indices count from 1")
broken_obj(SQUARE + "f 1/-1 2/-1 3/-1\n", 5, "vt index of 0, or before the first")
broken_obj(SQUARE + UVS + "f 1/1 2 3/3\n", 9, "all v, v/vt, v//vn or v/vt/vn")
broken_obj("v 0 0 0\nv 0 1e39 0\n" + SQUARE + "f 1 2 3\n", 2, "too large")
broken_obj("v 0,5 0 0\n" + SQUARE + "f 1 2 3\n", 1, "but is 'v 0,5 0 0'")
broken_obj("v 0 0 0\n\0\1\2", None, "zero byte")
broken_obj(SQUARE + "usemtl\n" + FACE, 5, "usemtl has no name")

broken_mtl("Kd 1 1 1\n", 1, "before any newmtl")
broken_mtl("newmtl a\nKs 0 -1 0\n", 2, "finite and not negative")
broken_mtl("newmtl a\nKd 1 1\n", 2, "one or three numbers, finite and not negative, but is '1 1'")
broken_mtl("newmtl a\nmap_Kd\n", 2, "names no file")
LIBRARY = "mtllib a.mtl\n" + SQUARE + FACE


@pytest.mark.parametrize(("name", "text", "line", "words"), MODELS)
def test_models_name_file_and_line(tmp_path, name, text, line, words):
    (tmp_path / "a.obj").write_text(LIBRARY)
    (tmp_path / name).write_text(text)
    with pytest.raises(mrt.SceneError) as caught:
        mrt.render(tmp_path / "a.obj")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (f"{name}:{line}: " if line else f"{name}: ") in str(caught.value)


TINY: dict[str, Any] = {"width": 8, "height": 6, "aa": 1}
MATTE = Material(1.5, 0.1, (0, 0, 0), (0.5, 0.5, 0.5))
EMPTY = Scene(Camera((0, 0, 5), (0, 0, 0)), BLUE_SKY, ())
NAN = math.nan
INFINITE = math.inf
POINTS = np.zeros((3, 3))
BALL = Sphere((0, 0, 0), 1, MATTE)


ARGUMENTS = Cases()


def wrong(says: str, error: type[Exception] = mrt.UsageError, **arguments: Any) -> None:
    """Add arguments that ``render`` must refuse, and what the error must say."""
    ARGUMENTS(error, arguments, says, name=says)


def no_scene(scene: Any, says: str) -> None:
    wrong(says, mrt.SceneError, scene=scene)


def nothing_but(says: str, **parts: Any) -> None:
    """Add an empty scene with some parts that it cannot have."""
    no_scene(replace(EMPTY, **parts), says)


wrong("render() got an unexpected keyword argument 'widht'", TypeError, widht=8)
wrong("there is no scene 99: choose one of 0, 1, 2, 3", scene=99)
wrong("scene is 1.5: give a number, a Scene, a dict, a Mitsuba scene or a path", scene=1.5)
wrong("the integrator is 3: it must be one, such as path", integrator=3)
wrong("ParticleTracerIntegrator gives whole pictures", integrator="ptracer", aamode="sobel")

no_scene("a\nb.xml", "cannot read a\\nb.xml: there is no such file")
no_scene("a\0b.xml", "embedded null")
no_scene({"type": "scene"}, "a dict has no sensor: add one")
no_scene({"type": "sphere"}, "a dict is a Shape, not a scene: put it into one")
nowhere = {"type": "sphere", "center": None}
no_scene({"type": "scene", "ball": nowhere}, "ball.center is None; give it a")
no_scene({"type": "mrt_bsdf", "alpha": "big"}, "mrt_bsdf: \"alpha\" is 'big', but must be a number")

nothing_but("sky is (0, nan, 0), but must be three finite", sky=(0, NAN, 0))
nothing_but("texturing is 'nice', but must be report or standard", texturing="nice")
nothing_but("are the same point", camera=Camera((1, 1, 1), (1, 1, 1)))
nothing_but("less than 180 degrees", camera=replace(EMPTY.camera, hfov=180))
nothing_but("spheres[1] is Sphere(", spheres=(BALL, replace(BALL, radius=0)))
endless = Cone((0, 0, INFINITE), (0, 0, 0), 1, MATTE)
torn = Mesh(POINTS, np.array([[0, 1, 7]]), MATTE)
nothing_but("cones[0] is", cones=(endless,))
nothing_but('"faces" holds 7, but there', meshes=(torn,))


@pytest.mark.parametrize(("error", "arguments", "text"), ARGUMENTS)
def test_render_refuses(error, arguments, text):
    size = {"aa": 1} if isinstance(arguments.get("scene"), dict | str) else TINY
    with pytest.raises(error, match=re.escape(text)) as caught:
        mrt.render(**{**size, **arguments})
    assert not re.search(r"\n|Traceback|\.cpp:", str(caught.value))


def test_objects_of_another_variant_are_named():
    mi.set_variant("scalar_rgb")
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}})
    integrator = mi.load_dict({"type": "path"})
    mi.set_variant("llvm_ad_rgb")
    for given in ({"scene": scene}, {"integrator": integrator}):
        with pytest.raises(mrt.UsageError, match="was loaded in the variant scalar_rgb, and llvm_ad_rgb is"):
            mrt.render(**TINY | given)


def test_a_callback_that_changes_the_variant():
    def change(picture: Any) -> None:
        mi.set_variant("scalar_rgb")

    text = "variant was changed from llvm_ad_rgb to scalar_rgb during a render, by on_round"
    with pytest.raises(mrt.UsageError, match=text):
        mrt.render(3, **TINY | {"aamode": "noise", "spp": 16, "aa": None}, on_round=change)
    mi.set_variant("llvm_ad_rgb")


CORNERS = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
FACES = np.array([[[0, 1, 2]]], np.uint32)
FOREIGN_FACES = np.array([[[0, 1, 3]]], np.uint32)
ONE = np.array([[0, 0, 0, 1]], np.float32)
TWO_ROWS = np.ones((2, 1), np.float32)
NO_AXIS = np.ones((1, 7), np.float32)
FLAT = mi.scalar_rgb.ScalarTransform4f().scale([0.0, 1, 1])
PATH = {"type": "path"}
PLUGINS = Cases()


def spoilt(type_: str, says: str, **parameters: Any) -> None:
    """Add a plugin with wrong parameters, and what the error must say."""
    PLUGINS({"type": type_, **parameters}, says, name=f"{type_}: {says}")


def adaptive(says: str, **parameters: Any) -> None:
    spoilt("mrt_adaptive", says, nested=PATH, **parameters)


def plane(says: str, **parameters: Any) -> None:
    spoilt("mrt_plane", says, **{"normal": [0, 1, 0], **parameters})


def cone(says: str, **parameters: Any) -> None:
    spoilt("mrt_cone", says, **{"apex": [0, 0, 1], "base_center": [0, 0, 0], **parameters})


def triangle(says: str, **parameters: Any) -> None:
    spoilt("mrt_mesh", says, **{"positions": CORNERS, "faces": FACES, **parameters})


def balls(says: str, **parameters: Any) -> None:
    spoilt("mrt_group", says, **{"numbers": ONE, **parameters})


spoilt("mrt_adaptive", "give one integrator inside")
adaptive('"tarqet" is not a parameter', tarqet=1.0)
adaptive('give "target" or "spp", not both', target=0.1, spp=64)
adaptive("percentage", target="2 %")
spoilt("mrt_bsdf", '"alpha" is nan, but must be a finite number', alpha=NAN)
spoilt("mrt_bsdf", '"int_ior" is 0.0, but must be a finite number > 0', int_ior=0.0)
spoilt("mrt_bsdf", "one of schlick, dielectric, unity", fresnel={"type": "rgb", "value": 1})
spoilt("mrt_bsdf", '"f0" has no meaning with fresnel="unity"', f0=0.1, fresnel="unity")
spoilt("mrt_bsdf", '"sample_visible" is 1, but must be true or false', sample_visible=1)
spoilt("mrt_plane", '"normal" is missing; give three numbers')
plane('"normal" is [0, 0, 0], but must be a vector of non-zero length', normal=[0, 0, 0])
spoilt("mrt_whitted", '"sky" is -1.0, but must be finite and not negative', sky=-1.0)
spoilt("mrt_whitted", "but must be an integer from 1 to 4294967295", max_depth=2**32)
spoilt("mrt_texture", "give one of")
spoilt("mrt_texture", "nothing.png", filename="nothing.png")
cone('"segments" is 2, but must be an integer from 3 to 65536', segments=2)
cone("two points", apex=[0, 0, 0])
cone("not invertible", to_world=FLAT)
triangle('"faces" must be', faces=None)
triangle('"faces" holds 3, but there are 3', faces=FOREIGN_FACES)
triangle('"positions" holds a number that is not finite', positions=CORNERS * np.float32(NAN))
triangle('"texcoords" has 2 entries for 3 positions', texcoords=CORNERS[:, :2])
spoilt("mrt_group", '"numbers" must be a mi.Bitmap')
balls("3 numbers for an object, but must have 4", numbers=ONE[:, :3])
balls("axis of no length", numbers=NO_AXIS, kind="cone")
balls("has 2 rows for 1 objects", face_x=TWO_ROWS)
balls(", ".join(CLOSED), kind="cube")


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize(("plugin", "text"), PLUGINS)
def test_plugins_name_the_parameter(variant, plugin, text):
    given = {name: mi.Bitmap(v) if isinstance(v, np.ndarray) else v for name, v in plugin.items()}
    with pytest.raises(RuntimeError, match=re.escape(text)) as caught:
        mi.load_dict({name: v for name, v in given.items() if v is not None})
    assert plugin["type"] in str(caught.value)
