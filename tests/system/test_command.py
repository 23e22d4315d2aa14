"""The installed ``mrt`` command from end to end, in a process and a folder of its own."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrt_mitsuba.output.files import read_exr

MRT = Path(sys.executable).with_name("mrt")
SMALL = ("width=64", "height=48")


def test_picture_and_its_two_files(mrt_command, tmp_path: Path) -> None:
    done = mrt_command("out", "1", *SMALL, "aa=2", "layers=depth,normal")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert done.stdout.splitlines()[-1].startswith("Render time: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.exr", "out.png"]
    exr = read_exr(tmp_path / "out.exr")
    assert exr.image.shape == (48, 64, 3)
    assert {"depth.Z", "normal.X", "normal.Y", "normal.Z"} <= exr.layers.keys()
    given = json.loads(exr.header["mrt:options"])
    assert (exr.header["mrt:scene"], exr.header["mrt:variant"]) == ("1", "llvm_ad_rgb")
    assert (given["width"], given["aa"], given["fresnel"], given["seed"]) == (64, 2, "schlick", 0)
    assert (given["integrator"], given["focaldist"]) == ("mrt_whitted", 0)
    known = "mrt:mitsuba mrt:drjit mrt:llvm software mrt:worldToCamera mrt:worldToNDC"
    assert set(known.split()) <= exr.header.keys()
    with Image.open(tmp_path / "out.png") as png:
        np.testing.assert_array_equal(np.asarray(png), np.clip(np.trunc(exr.image * 255), 0, 255))


def test_same_command_twice_gives_the_same_bytes(mrt_command, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert mrt_command(name, "2", *SMALL, "aa=2").returncode == 0
    for ending in ("png", "exr"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def test_scene_file_keeps_its_size(mrt_command, tmp_path: Path) -> None:
    (tmp_path / "mine.xml").write_text(
        """<scene version="3.0.0">
        <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="20"/>
            <integer name="height" value="10"/><rfilter type="box"/></film></sensor>
        <emitter type="constant"><rgb name="radiance" value="0.25 0.5 0.75"/></emitter>
        <shape type="sphere"><point name="center" x="0" y="5" z="9"/></shape></scene>"""
    )
    done = mrt_command("out", "scene=mine.xml", "aa=1")
    assert done.returncode == 0, done.stderr
    picture = read_exr(tmp_path / "out.exr")
    assert picture.image.shape == (10, 20, 3)
    np.testing.assert_array_equal(picture.image[-1, 0], np.float32([0.25, 0.5, 0.75]))  # the sky, as given


def test_model_is_seen_from_where_the_camera_is_put(mrt_command, tmp_path: Path) -> None:
    """A triangle that covers the right half of the picture from in front, and lies behind from the back."""
    (tmp_path / "t.obj").write_text("v 0 -9 0\nv 9 -9 0\nv 9 9 0\nv 0 9 0\nf 1 2 3 4\n")
    common = (*SMALL, "scene=t.obj", "aa=1", "format=exr", "target=0,0,0", "light=0,0,3", "quiet=1")
    for name, z in (("front", 4), ("back", -4)):
        done = mrt_command(name, *common, f"camera=0,0,{z}", "fov=40")
        assert (done.returncode, done.stderr) == (0, "")
    front, back = (read_exr(tmp_path / f"{name}.exr").image for name in ("front", "back"))
    covered = np.abs(front - front[0, 0]).max(axis=2) > 0.02
    half = covered[:, :32].all(), covered[:, 33:].all()
    assert sorted(half) == [False, True] and not np.array_equal(front, back)
    done = mrt_command("along", *common, "camera=0,5,0")
    assert done.returncode == 2 and "looks along up" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["help"], ["out", "0", "width=8", "height=6"]])
def test_output_that_cannot_be_printed(run_command, tmp_path: Path, arguments: list[str]) -> None:
    done = run_command("sh", "-c", f"exec {MRT} {' '.join(arguments)} >/dev/full")
    assert done.returncode == 1
    assert done.stderr == "mrt: cannot print: No space left on device; send the output elsewhere\n"
    assert list(tmp_path.iterdir()) == []


def test_closed_streams_take_no_harm(run_command, tmp_path: Path) -> None:
    """Files opened later would get the numbers of output and error, and what is printed."""
    done = run_command("sh", "-c", f"exec {MRT} out 0 width=8 height=6 aa=1 format=exr >&- 2>&-")
    assert done.returncode == 0
    assert read_exr(tmp_path / "out.exr").image.shape == (6, 8, 3)


def corrupt(folder: Path) -> None:
    """Make every second kernel of the cache rubbish and cut the others short."""
    kernels = sorted(folder.iterdir())
    assert kernels
    for k, kernel in enumerate(kernels):
        kernel.write_bytes(b"rubbish" * 999 if k % 2 else kernel.read_bytes()[:10])


def test_corrupt_kernel_cache_is_made_anew(mrt_command, tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    arguments = ("0", "width=16", "height=12", "quiet=1", "format=exr")
    assert mrt_command("good", *arguments, HOME=str(home)).returncode == 0
    corrupt(home / ".drjit")
    done = mrt_command("after", *arguments, HOME=str(home))
    assert (done.returncode, done.stderr) == (0, "")
    np.testing.assert_array_equal(
        read_exr(tmp_path / "good.exr").image, read_exr(tmp_path / "after.exr").image
    )


def test_home_that_holds_no_kernel_cache(mrt_command, tmp_path: Path) -> None:
    """Dr.Jit says so in one line, and the picture is made."""
    (tmp_path / "home").write_text("a file")
    words = ("out", "0", "width=16", "height=12", "quiet=1", "format=exr")
    done = mrt_command(*words, HOME=str(tmp_path / "home"))
    assert done.returncode == 0 and done.stderr.count("\n") <= 1
    assert read_exr(tmp_path / "out.exr").image.shape == (12, 16, 3)


@pytest.mark.parametrize(("flavor", "plugin"), [((), "mrt_bsdf"), (("--stock",), "roughplastic")])
def test_exported_scene_renders(mrt_command, tmp_path: Path, flavor: tuple[str, ...], plugin: str) -> None:
    done = mrt_command("export", "0", "--xml", "zero.xml", *flavor)
    assert (done.returncode, done.stdout, done.stderr) == (0, "Wrote zero.xml\n", "")
    text = (tmp_path / "zero.xml").read_text()
    assert plugin in text and ("mrt_" in text) is not bool(flavor)
    done = mrt_command("out", "scene=zero.xml", "aa=1", "aamode=none", "format=exr")
    assert done.returncode == 0, done.stderr
    image = read_exr(tmp_path / "out.exr").image
    np.testing.assert_allclose(image[0, 0], (0.1, 0.3, 0.5), atol=1e-6)  # the sky of scene 0, in float32


def test_doctor(mrt_command) -> None:
    done = mrt_command("doctor")
    assert done.returncode == 0, done.stdout
    assert "self-test: scene 0 at 16x12 in llvm_ad_rgb: passed" in done.stdout
    assert "LLVM" in done.stdout and "variants: scalar_rgb" in done.stdout
