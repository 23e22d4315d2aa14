"""Bad input to the ``mrt`` command: one line that names the thing and the fix, the right exit code, no mess.

The table runs inside this process, which saves starting Mitsuba for every line; ``test_command.py`` shows
that the installed command does the same.
"""

from __future__ import annotations

import base64
import os
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrt_mitsuba.command import main as cli

SIZE = ("width=64", "height=48")
PIPE = object()
Content = str | bytes | Path | object | None  # None: a folder; a Path: a symbolic link to it

SENSOR = "<sensor type='perspective'><film type='hdrfilm'>{}</film></sensor>"
SMALL = SENSOR.format("<integer name='width' value='4'/><integer name='height' value='3'/>")
LARGE = SENSOR.format("<integer name='width' value='99999'/><integer name='height' value='99999'/>")
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
MODEL = "mtllib a.mtl\n" + TRIANGLE
PICTURE = "newmtl m\nKd 1 1 1\nmap_Kd p.png\n"
WHITE = base64.b64decode(  # one pixel
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4//8/AAX+Av4N70a4AAAAAElFTkSuQmCC"
)


def xml(inside: str, sensor: str = SMALL) -> dict[str, Content]:
    return {"a.xml": f"<scene version='3.0.0'>{sensor}{inside}</scene>"}


def ball(material: str) -> dict[str, Content]:
    return xml(f"<shape type='sphere'><bsdf type='mrt_bsdf'>{material}</bsdf></shape>")


BRIGHT = "<emitter type='mrt_light'><rgb name='intensity' value='inf'/></emitter>"
DEEP = "<integrator type='mrt_whitted'><integer name='max_depth' value='0'/></integrator>"
PAPERED = """<texture name='diffuse_reflectance' type='mrt_texture'><string name='filename' value='no.png'/>
</texture>"""
ENDS = "<point name='p0' value='1 0 0'/><point name='p1' value='{} 0 0'/><float name='radius' value='{}'/>"


def shape(kind: str, parameters: str) -> dict[str, Content]:
    return xml(f"<shape type='mrt_{kind}'>{parameters}</shape>")


def textured(picture: Content) -> dict[str, Content]:
    return {"a.obj": MODEL, "a.mtl": PICTURE, "p.png": picture}


# Files, arguments, the exit code and what the one line must hold
Case = tuple[dict[str, Content], str, int, str]

OUTPUTS: list[Case] = [
    ({"out.png": None}, "out", 1, "out.png: it is a folder; choose another name"),
    ({"file": ""}, "file/out", 1, "is a file, not a folder; choose another place"),
    ({}, "none/out", 1, "does not exist; create it first"),
    ({"out.exr": Path("b.exr"), "b.exr": Path("out.exr")}, "out", 1, "links lead in a circle"),
    ({"out.png": PIPE}, "out", 1, "out.png: it is not a regular file"),
    ({"out.png": Path("/dev/full")}, "out", 1, "out.png: it is not a regular file"),
    ({"out_mesh_0.ply": None}, "export 8 --xml out.xml", 1, "out_mesh_0.ply: it is a folder"),
    ({}, "export 0 --xml none/a.xml", 1, "does not exist; create it first"),
    ({"a.xml": None}, "export 0 --xml a.xml", 1, "a.xml: it is a folder"),
    ({}, "export 0 --xml a.xml --stock --stock", 2, "--stock is given twice. Usage: mrt export"),
    (textured(WHITE), "p scene=a.obj aa=1", 1, "cannot write p.png: what is written is made from"),
    (textured(WHITE) | {"a.obj": MODEL.replace("/1", "")}, "p scene=a.obj aa=1", 1, "cannot write p.png"),
    ({}, "out.png", 2, "write out format=png"),
    ({}, "help me", 2, "unexpected argument 'me' after mrt help"),
]

SIZES: list[Case] = [
    ({}, "out width=16384 height=16384 aa=1 memory=512M", 2, "needs 4.1 GiB of memory, and 512 MiB"),
    ({}, "out width=65536 height=65536 aa=1 memory=16G", 2, "choose a smaller width and height"),
    ({}, "out width=65537", 2, "from 1 to 65536"),
    (xml("", LARGE), "out scene=a.xml memory=512M", 2, "a picture of 99999x99999 pixels needs"),
]

FILES: list[Case] = [
    ({}, "out scene=a.obj", 1, "cannot read a.obj: there is no such file in"),
    ({}, "out scene=a.xml", 1, "cannot read a.xml: there is no such file in"),
    ({"a": ""}, "out scene=a/b.obj", 1, "cannot read a/b.obj: there is no such file in"),
    ({"d.xml": None}, "out scene=d.xml", 1, "cannot read d.xml: it is a folder; name a file in it"),
    ({"d.obj": None}, "out scene=d.obj", 1, "cannot read d.obj: it is a folder; name a file in it"),
    ({"a.xml": PIPE}, "out scene=a.xml", 1, "it is not a regular file; copy its content into one"),
    ({"a.obj": PIPE}, "out scene=a.obj", 1, "it is not a regular file; copy its content into one"),
    ({"a.obj": Path("a.obj")}, "out scene=a.obj", 1, "its symbolic links lead in a circle"),
    ({"a.xml": Path("b.xml"), "b.xml": Path("a.xml")}, "out scene=a.xml", 1, "lead in a circle"),
    ({"a.ply": ""}, "out scene=a.ply", 2, "a scene file ends in .xml or .obj"),
]

SCENES: list[Case] = [
    ({"a.xml": ""}, "out scene=a.xml", 1, "cannot load a.xml"),
    ({"a.xml": "<scene"}, "out scene=a.xml", 1, "cannot load a.xml"),
    ({"a.xml": b"\xff\xfe\0"}, "out scene=a.xml", 1, "cannot load a.xml"),
    ({"a.xml": f"<scene>{SMALL}</scene>"}, "out scene=a.xml", 1, "missing version attribute"),
    (xml("<shape type='sphere'/>", ""), "out scene=a.xml", 1, "a.xml has no sensor: add one"),
    (xml("<shape type='potato'/>"), "out scene=a.xml", 1, 'Plugin "potato" not found'),
    (xml("<include filename='a.xml'/>"), "out scene=a.xml", 1, "recursion depth"),
    (xml("<shape type='sphere'><ref id='none'/></shape>"), "out scene=a.xml", 1, 'reference to "none"'),
    (xml("<integrator type='ptracer'/>"), "out scene=a.xml", 2, "it must be a sampling integrator"),
    (xml("", SENSOR.format("<integer name='height' value='0'/>")), "out scene=a.xml", 1, "768x0: give it"),
    (xml(""), "out scene=a.xml fresnel=schlick", 2, "it is a parameter of mrt_bsdf"),
]

PLUGINS: list[Case] = [
    (ball("<float name='alpha' value='nan'/>"), "out scene=a.xml", 1, '"alpha" is nan, but must be a finite'),
    (ball("<string name='alpha' value='big'/>"), "out scene=a.xml", 1, "is 'big', but must be a number"),
    (ball("<float name='aplha' value='1'/>"), "out scene=a.xml", 1, '- float "aplha"'),
    (ball("<float name='int_ior' value='0'/>"), "out scene=a.xml", 1, '"int_ior" is 0.0, but must be'),
    (ball("<rgb name='specular_reflectance' value='nan'/>"), "out scene=a.xml", 1, 'tance" is [nan'),
    (shape("cone", ""), "out scene=a.xml", 1, '"mrt_cone": mrt_cone: "apex" is missing; give three numbers'),
    (shape("plane", "<vector name='normal' x='0' y='0' z='0'/>"), "out scene=a.xml", 1, "non-zero length"),
    (shape("cylinder", ENDS.format(1, 1)), "out scene=a.xml", 1, "but must be two points"),
    (shape("cylinder", ENDS.format(2, -1)), "out scene=a.xml", 1, '"radius" is -1.0, but must be a finite'),
    (xml(BRIGHT), "out scene=a.xml", 1, 'mrt_light: "intensity" is'),
    (xml(DEEP), "out scene=a.xml", 1, 'mrt_whitted: "max_depth" is 0, but must be an integer from 1 to'),
    (ball(PAPERED), "out scene=a.xml", 1, "no.png', which cannot be read"),
]

MODELS: list[Case] = [
    ({"a.obj": "v 0 0 0\nv 1 0\n"}, "out scene=a.obj", 1, "a.obj:2: v has 2 numbers, but must have 3"),
    ({"a.obj": "f 1 2 3\n"}, "out scene=a.obj", 1, "a.obj:1: f has the v index"),
    ({"a.obj": ""}, "out scene=a.obj", 1, "a.obj: has no faces; export the model with its geometry"),
    ({"a.obj": b"v\0"}, "out scene=a.obj", 1, "it holds a zero byte"),
    ({"a.obj": MODEL, "a.mtl": "newmtl m\nKd 1 x 3\n"}, "out scene=a.obj", 1, "a.mtl:2: Kd holds 'x'"),
    ({"a.obj": MODEL, "a.mtl": "Kd 1 1 1\n"}, "out scene=a.obj", 1, "write newmtl NAME before it"),
    (textured("no picture"), "out scene=a.obj", 1, "p.png', which cannot be read"),
    (textured(""), "out scene=a.obj", 1, "p.png', which cannot be read"),
    (textured(b"\x89PNG\r\n\x1a\n\0\0"), "out scene=a.obj", 1, "p.png', which cannot be read"),
    ({"a.obj": TRIANGLE}, "out scene=a.obj camera=0,9,0 target=0,0,0", 2, "choose another up"),
]

CASES = OUTPUTS + SIZES + FILES + SCENES + PLUGINS + MODELS


def put(path: Path, content: Content) -> None:
    if content is None:
        path.mkdir()
    elif content is PIPE:
        os.mkfifo(path)
    elif isinstance(content, Path):
        path.symlink_to(content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


def refusal(capture: pytest.CaptureFixture[str], arguments: list[str]) -> tuple[int, str]:
    """Exit code and the one line of a run that must fail."""
    quiet = [] if arguments[0] in ("export", "help") else ["quiet=1"]
    code = cli.main([*arguments, *quiet])
    text, errors = capture.readouterr()
    assert text == "" and errors.startswith("mrt: ") and errors.count("\n") == 1, errors
    assert "Traceback" not in errors and "MRT_TRACEBACK" not in errors, errors
    return code, errors


@pytest.mark.parametrize(("files", "arguments", "code", "text"), CASES, ids=range(len(CASES)))
def test_refused_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    files: dict[str, Content],
    arguments: str,
    code: int,
    text: str,
) -> None:
    for name, content in files.items():
        put(tmp_path / name, content)
    monkeypatch.chdir(tmp_path)
    found, message = refusal(capfd, arguments.split())
    assert text in message
    assert found == code
    assert {path.name for path in tmp_path.iterdir()} == files.keys(), "files were left behind"


@pytest.mark.parametrize(
    ("name", "code", "text"),
    [
        ("scalar_rbg", 2, "Did you mean scalar_rgb?"),
        ("cuda_ad_rgb", 1, "Use llvm_ad_rgb or scalar_rgb"),
        ("fast", 2, "This Mitsuba has scalar_rgb"),
    ],
)
def test_variant_that_cannot_be_had(tmp_path, monkeypatch, capfd, name: str, code: int, text: str) -> None:
    """Names that this Mitsuba does not have, and one that this machine cannot run."""
    from mrt_mitsuba import runtime

    if name == "cuda_ad_rgb" and runtime.obstacle(name) is None:
        pytest.skip("there is a GPU here")
    monkeypatch.chdir(tmp_path)
    found, message = refusal(capfd, ["out", f"variant={name}"])
    assert found == code and text in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read anything")
@pytest.mark.parametrize("name", ["a.obj", "a.xml"])
def test_file_that_may_not_be_read(tmp_path: Path, monkeypatch, capfd, name: str) -> None:
    (tmp_path / name).touch(mode=0o200)
    monkeypatch.chdir(tmp_path)
    code, message = refusal(capfd, ["out", f"scene={name}"])
    assert code == 1 and f"try chmod +r {name}" in message


@pytest.mark.parametrize(
    "arguments",
    [
        "out 0 format=png width=64 height=48 aa=1",
        " ".join(["out", "0", "format=exr", *SIZE]),
        "export 0 --xml out.xml",
    ],
)
def test_disk_that_is_full(tmp_path: Path, monkeypatch, capsys, arguments: str) -> None:
    """A limit on the size of files is to a program what a full disk is: the old file stays, nothing else."""
    old = [tmp_path / f"out.{ending}" for ending in ("png", "exr", "xml")]
    for path in old:
        path.write_text("old")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "before").mkdir()
    cli.main(["before/" + arguments.split()[0], "0", "quiet=1", *SIZE])  # now the kernels are in the cache
    shutil.rmtree("before")
    capsys.readouterr()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))  # bytes; any picture has more
    try:
        code, message = refusal(capsys, arguments.split())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 1 and "cannot write out." in message and "File too large" in message
    assert sorted(tmp_path.iterdir()) == sorted(old)
    assert [path.read_text() for path in old] == ["old"] * 3


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA", "I;16"])
def test_pictures_of_every_kind_are_read(tmp_path: Path, monkeypatch, capfd, mode: str) -> None:
    """Black and white, grey, palette, alpha, 16 bits."""
    levels = np.arange(12).reshape(3, 4) * 20
    image = Image.fromarray(levels.astype(np.uint16 if mode == "I;16" else np.uint8))
    image = image if mode == "I;16" else image.convert(mode)
    for name, content in textured("").items():
        put(tmp_path / name, content)
    image.save(tmp_path / "p.png")
    monkeypatch.chdir(tmp_path)
    arguments = ["out", "scene=a.obj", "width=8", "height=6", "aa=1", "format=png", "quiet=1"]
    assert (cli.main(arguments), *capfd.readouterr()) == (0, "", "")
    assert (tmp_path / "out.png").exists()
