"""What files, signals, threads and small machines may try: nothing breaks, hangs, or runs code of theirs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import SceneError

pytestmark = pytest.mark.attack

SENSOR = """<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>
    <integer name="height" value="3"/></film></sensor>"""


def scene_xml(inside: str) -> str:
    return f"<scene version='3.0.0'>{SENSOR}{inside}</scene>"


def cones(count: int) -> str:
    cone = "<shape type='mrt_cone'><integer name='segments' value='3'/><float name='radius' value='1'/>"
    ends = "<point name='apex' value='{0} 1 0'/><point name='base_center' value='{0} 0 0'/></shape>"
    return "".join(cone + ends.format(i) for i in range(count))


# ------------------------------------------- 1: native code --------------------------------------------

TRAP = """
#include <stdlib.h>
#include <fcntl.h>
__attribute__((constructor)) static void run(void) { open(getenv("MRT_TRAP"), O_CREAT | O_WRONLY, 0600); }
"""
RENDER_FILES = """
import sys, mrt_mitsuba as mrt
for path in sys.argv[1:]:
    try:
        mrt.render(path, aa=1, integrator="path")
        print(path, "rendered")
    except mrt.SceneError as error:
        print(path, error)
try:
    mrt.render({"type": "scene", "sensor": {"type": "perspective"}, "shape": {"type": "wicked"}}, aa=1)
except mrt.SceneError as error:
    print("dict", error)
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_no_native_code_from_the_folders_of_process_and_scene(run_python, tmp_path: Path) -> None:
    trap, sign = tmp_path / "trap.so", tmp_path / "it ran"
    (tmp_path / "trap.c").write_text(TRAP)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", trap, tmp_path / "trap.c"], check=True, timeout=60)
    for folder in (tmp_path, tmp_path / "scene", tmp_path / "more"):
        (folder / "plugins").mkdir(parents=True)
        for name in ("sphere", "diffuse", "hdrfilm", "path", "scene", "constant", "wicked"):
            shutil.copy(trap, folder / "plugins" / f"{name}.so")
    files = {
        "known": "<shape type='sphere'><bsdf type='diffuse'/></shape>",
        "unknown": "<shape type='wicked'/>",
        "by_path": "<path value='more'/><shape type='sphere'><bsdf type='diffuse'/></shape>",
        "by_parameter": "<default name='kind' value='wicked'/><shape type='$kind'/>",
        "by_place": "<shape type='../../scene/plugins/wicked'/>",
    }
    for name, text in files.items():
        (tmp_path / "scene" / f"{name}.xml").write_text(scene_xml(text))
    done = run_python(RENDER_FILES, *(f"scene/{name}.xml" for name in files), MRT_TRAP=str(sign))
    assert done.returncode == 0, done.stderr
    lines = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    assert not sign.exists(), lines
    assert lines["scene/known.xml"] == lines["scene/by_path.xml"] == "rendered"
    for name in ("scene/unknown.xml", "scene/by_parameter.xml", "dict"):
        assert "native code that is not Mitsuba's" in lines[name]
    command = [Path(sys.executable).with_name("mrt"), "out", "3", "width=8", "height=6", "quiet=1"]
    environ = os.environ | {"MRT_TRAP": str(sign)}
    subprocess.run(command, cwd=tmp_path, env=environ, check=True, timeout=120)
    (tmp_path / "plugins" / "wicked.so").rename(
        tmp_path / "plugins" / "mrt_bsdf.so"
    )  # looked for there first
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "native code that is not Mitsuba's" in done.stderr
    assert not sign.exists()


# ------------------------------------------- 2: many shapes --------------------------------------------


def test_hundreds_of_python_shapes_load(variant: str, tmp_path: Path) -> None:
    """Loaded in parallel, 300 of them overflowed the stack each time."""
    (tmp_path / "cones.xml").write_text(scene_xml(cones(1200)))
    assert mrt.render(str(tmp_path / "cones.xml"), aa=1).image.shape == (3, 4, 3)
    lines = ["mtllib m.mtl", "v 0 0 0", "v 1 0 0", "v 0 1 0"]
    names = [f"m{i}" for i in range(1200)]
    (tmp_path / "m.mtl").write_text("".join(f"newmtl {n}\nKd 0.5 0.5 0.{n[1:]}\n" for n in names))
    (tmp_path / "m.obj").write_text("\n".join(lines + [f"usemtl {n}\nf 1 2 3" for n in names]) + "\n")
    assert mrt.render(str(tmp_path / "m.obj"), width=4, height=3, aa=1).image.shape == (3, 4, 3)


# ------------------------------------------- 6: XML and pipes ------------------------------------------


@pytest.mark.parametrize("depth", [1000, 100_000])
def test_deep_nesting_is_refused(variant: str, tmp_path: Path, depth: int) -> None:
    nested = "<shape type='instance'>" * depth + "</shape>" * depth
    (tmp_path / "deep.xml").write_text(scene_xml(nested))
    (tmp_path / "outer.xml").write_text(scene_xml("<include filename='deep.xml'/>"))
    scene: dict[str, Any] = {}
    for _ in range(depth):
        scene = {"type": "scene", "inner": scene}
    for what in (str(tmp_path / "deep.xml"), str(tmp_path / "outer.xml"), scene):
        with pytest.raises(SceneError, match="nested more than 256 levels"):
            mrt.render(what, aa=1)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize(
    "inside",
    [
        "<include filename='pipe'/>",
        "<default name='p' value='pipe'/><include filename='$p'/>",
        "<include filename='p&#105;pe'/>",
        "<emitter type='envmap'><string name='filename' value='pipe'/></emitter>",
        "<shape type='ply'><string name='filename' value='pipe'/></shape>",
        "<bsdf type='diffuse'><spectrum name='reflectance' filename='pipe'/></bsdf>",
        "<bsdf type='diffuse'><texture name='reflectance' type='bitmap'>"
        "<string name='filename' value='pipe'/></texture></bsdf>",
        "<bsdf type='diffuse'><texture name='reflectance' type='mrt_texture'>"
        "<string name='filename' value='pipe'/></texture></bsdf>",
    ],
    ids=range(8),
)
def test_pipes_are_refused(variant: str, tmp_path: Path, inside: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a.xml").write_text(scene_xml(inside))
    with pytest.raises(SceneError, match="pipe: it is not a regular file"):
        mrt.render(str(tmp_path / "a.xml"), aa=1)
