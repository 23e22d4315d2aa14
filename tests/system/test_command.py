"""The installed ``mrt`` command from end to end, in a process and a folder of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from mrt_mitsuba.files.images import read_exr

MRT = Path(sys.executable).with_name("mrt")


def test_picture_and_its_two_files_of_the_same_bytes_each_time(mrt_command, tmp_path):
    for name in "ab":
        done = mrt_command(name, "1", "width=64", "height=48", "aa=2", "layers=depth,normal")
        assert not done.stderr
        assert done.stdout.splitlines()[-1].startswith("Render time: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png", "b.exr", "b.png"]
    for ending in ("png", "exr"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()
    exr = read_exr(tmp_path / "a.exr")
    assert exr.image.shape == (48, 64, 3)
    assert {"depth.Z", "normal.X", "normal.Y", "normal.Z"} <= exr.layers.keys()
    given = json.loads(exr.header["mrt:options"])
    assert (exr.header["mrt:scene"], exr.header["mrt:variant"]) == ("1", "llvm_ad_rgb")
    assert {"width": 64, "aa": 2, "fresnel": "schlick", "integrator": "mrt_whitted"}.items() <= given.items()
    known = "mrt:mitsuba mrt:drjit mrt:llvm software mrt:worldToCamera mrt:worldToNDC"
    assert set(known.split()) <= exr.header.keys()
    with Image.open(tmp_path / "a.png") as png:
        assert_array_equal(np.asarray(png), np.clip(np.trunc(exr.image * 255), 0, 255))


def test_a_reader_that_goes_away_is_no_error(run_command):
    assert not run_command("sh", "-c", f"{MRT} help | head -1").stderr


def test_doctor(mrt_command):
    said = mrt_command("doctor").stdout
    assert "self-test: scene 0 at 16x12 in llvm_ad_rgb: passed" in said
    assert "LLVM" in said
    assert "variants: scalar_rgb" in said
    assert "not installed" not in said


def test_info_and_plugins_of_a_file(mrt_command, run_command, tmp_path):
    """``python -m mrt_mitsuba`` is the command; names in files cannot control the terminal."""
    (tmp_path / "mine.py").write_text(
        "import mitsuba as mi\n"
        "class Mine(mi.Texture):\n"
        "    def eval(self, si, active=True): return mi.Color3f(0.25)\n"
        "    def to_string(self): return 'Mine'\n"
        "mi.register_texture('mine', lambda props: Mine(props))\n"
    )
    (tmp_path / "mitsuba.py").write_text("raise RuntimeError('of the working folder')\n")
    (tmp_path / "a.xml").write_text(
        "<scene version='3.0.0'><integrator type='aov'><string name='aovs' value='a\x9b31m:depth'/>"
        "<integrator type='direct'/></integrator><sensor type='perspective'/><emitter type='constant'/>"
        "<shape type='sphere'><transform name='to_world'><translate z='5'/></transform>"
        "<bsdf type='diffuse'><texture type='mine' name='reflectance'/></bsdf></shape></scene>"
    )
    mrt_command("out", "a.xml", "width=16", "height=16", "aa=1", "plugins=./mine.py", "format=exr")
    assert_allclose(read_exr(tmp_path / "out.exr").image[8, 8], 0.25, atol=0.1)
    (tmp_path / "mitsuba.py").unlink()
    done = run_command(sys.executable, "-m", "mrt_mitsuba", "info", "out.exr")
    assert done.stdout.startswith("out.exr: 16x16 pixels, ")
    assert "mrt:options" in done.stdout
    assert all(c.isprintable() or c == "\n" for c in done.stdout)
    assert "\\x9b31m" in done.stdout
    done = mrt_command("check", "a.xml", "plugins=./mine.py", "quick=1", code=None)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("mrt ex", ["export"]),
        ("mrt out aam", ["aamode="]),
        ("mrt out 3 aamode=s", ["aamode=sobel"]),
        ("mrt diff a b fl", ["flip="]),
        ("mrt sweep out wor", ["workers="]),
    ],
)
def test_tab_completes_words(mrt_command, tmp_path, line, words):
    variables = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1"}
    variables |= {
        "_ARGCOMPLETE_STDOUT_FILENAME": "found",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SHELL": "fish",
    }
    mrt_command(**variables)
    found = (tmp_path / "found").read_text().splitlines()
    assert [each.split("\t")[0].strip() for each in found] == words
