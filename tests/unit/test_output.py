"""PNG and EXR: values, layers, header, and what happens when they cannot be written."""

from __future__ import annotations

import errno
import io
import os
import pickle
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import Cases
from nodes import TRIANGLE
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import mrt_mitsuba as mrt
from mrt_mitsuba import interrupts
from mrt_mitsuba.errors import MrtWarning, OutputError, UsageError
from mrt_mitsuba.files import images as output
from mrt_mitsuba.files import replacing
from mrt_mitsuba.files.replacing import check_target
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.scene.report import report_scene


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(1).normal(0.5, 1, (7, 5, 3)).astype(np.float32)


LEVEL = np.arange(256) / 255


def grey(*values: float) -> np.ndarray:
    """A picture one pixel high with these grey values."""
    return np.repeat(np.array(values, np.float32)[None, :, None], 3, axis=2)


levels = Cases()
levels(
    "report",
    [-np.inf, -1, 0, 0.999 / 255, 1.001 / 255, 0.5, 254.9 / 255, 1, 7, np.inf],
    [0, 0, 0, 0, 1, 127, 254, 255, 255, 255],
)
# 0.0031308: where the two pieces of the curve meet; 0.2140: the linear value of 127.49 / 255
levels("srgb", [-1, 0, 0.0031308, 0.18, 0.2140, 0.5, 1, 3], [0, 0, 10, 118, 127, 188, 255, 255])
levels("srgb", np.where(LEVEL <= 0.04045, LEVEL / 12.92, ((LEVEL + 0.055) / 1.055) ** 2.4), range(256))


@pytest.mark.parametrize(("tonemap", "values", "expected"), levels)
def test_levels(tonemap, values, expected):
    assert_array_equal(output.to_8bit(grey(*values), tonemap)[0, :, 0], expected)


def test_nan_is_black_with_a_warning():
    with pytest.warns(MrtWarning, match="1 pixels are NaN"):
        assert_array_equal(output.to_8bit(grey(0.5, np.nan), "report")[0, :, 0], [127, 0])


def test_rows_beyond_the_first_block(tmp_path):
    ramp = np.linspace(0, 1, 600, dtype=np.float32)[:, None, None].repeat(3, axis=2)
    output.save(tmp_path / "a.png", ramp)
    with Image.open(tmp_path / "a.png") as png:
        assert png.mode == "RGB"
        assert png.size == (1, 600)
        assert_array_equal(np.asarray(png)[:, 0, 0], np.trunc(255 * ramp[:, 0, 0]))


def test_exr_holds_every_bit(tmp_path, image):
    image[0, 0] = np.nan, np.inf, -np.inf
    layers = {"depth.Z": image[:, :, 0], "samples.Y": image[:, :, 1]}
    header = {"mrt:alpha": 1.5, "mrt:options": {"aa": 4, "layers": ["depth"]}}
    output.save(tmp_path / "a.exr", image, layers=layers, header=header)
    before = os.listdir("/proc/self/fd")
    back = output.read_exr(tmp_path / "a.exr")
    assert len(os.listdir("/proc/self/fd")) == len(before)  # no file stays open
    assert_array_equal(back.image, image)
    assert back.image.dtype == np.float32
    assert back.layers.keys() == layers.keys()
    for name, values in layers.items():
        assert_array_equal(back.layers[name], values, err_msg=name)
    assert back.header["mrt:options"] == '{"aa": 4, "layers": ["depth"]}'
    assert back.header["mrt:alpha"] == 1.5


@pytest.mark.parametrize(
    "layer",
    [("depth.Z", (7, 6)), ("normal.X", (7, 5, 2)), ("x", (7,)), ("x" * 256, (7, 5))],
    ids=lambda layer: f"{layer!r:.20}",
)
def test_layer_of_another_shape(tmp_path, image, layer):
    name, shape = layer
    with pytest.raises(OutputError, match=f"{name:.50}"):
        output.save(tmp_path / "a.exr", image, layers={name: np.zeros(shape, np.float32)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"not an EXR", b"\x76\x2f\x31\x01" + bytes(50)])
def test_reading_what_is_no_exr(tmp_path, content):
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(OutputError, match=r"cannot read .*a\.exr"):
        output.read_exr(tmp_path / "a.exr")


def test_channels_of_different_sizes_are_refused(tmp_path):
    import OpenEXR

    header = OpenEXR.Header(4, 2)
    kind = header["channels"]["R"]
    header["channels"] = {"R": kind, "G": type(kind)(kind.type, 2, 2), "B": kind}
    picture = OpenEXR.OutputFile(str(tmp_path / "a.exr"), header)
    picture.writePixels({"R": bytes(32), "G": bytes(8), "B": bytes(32)})
    picture.close()
    with pytest.raises(OutputError, match="its channels differ in size; write them all"):
        output.read_exr(tmp_path / "a.exr")


targets = Cases()
targets("a.png", "is read-only")
targets("a" * 300 + ".png", "name too long")
targets("a\0.png", "names no file")
targets("\ud800.png", "surrogates not allowed")


@pytest.mark.parametrize(("name", "reason"), targets)
def test_target_that_cannot_be_written(tmp_path, image, name, reason):
    """What else is refused: ``tests/system/test_refusals.py``."""
    (tmp_path / "a.png").touch(0o444)
    before = sorted(tmp_path.rglob("*"))
    path = tmp_path / name
    for attempt in (check_target, lambda p: output.save(p, image)):
        with pytest.raises(OutputError, match=f"(?i)cannot write .*{reason}"):
            attempt(path)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["a", "a.jpg", "a.b/c"])
def test_extension_says_the_format(tmp_path, image, name):
    with pytest.raises(OutputError, match=r"must end in \.png or \.exr"):
        output.save(tmp_path / name, image)


def old(folder: Path, endings: list[str]) -> list[Path]:
    paths = [folder / f"a.{ending}" for ending in endings]
    for path in paths:
        path.write_bytes(b"old")
    return paths


@pytest.fixture
def heeded() -> Iterator[None]:
    """A shell ignores Ctrl-C for what it runs in the background, and so would the test."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("compression", ["zip", "none"])
@pytest.mark.parametrize("fault", ["full disk", "interrupt"])
def test_no_damaged_file_whichever_write_fails(tmp_path, monkeypatch, heeded, fault, compression):
    """Or seek; the last ones write the table of offsets in a destructor of the library."""
    calls = 0
    failing = 0

    def fail_or_not() -> None:
        nonlocal calls
        calls += 1
        if calls == failing and fault == "full disk":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if calls == failing:
            signal.raise_signal(signal.SIGINT)

    class File(io.FileIO):
        def write(self, data: Any) -> int:
            fail_or_not()
            return super().write(data)

        def seek(self, *words: int) -> int:  # writes what a buffer holds
            fail_or_not()
            return super().seek(*words)

    monkeypatch.setattr(replacing, "open", File, raising=False)
    picture = np.ones((40, 5, 3), np.float32)
    output.save(tmp_path / "a.exr", picture, compression=compression)
    good = (tmp_path / "a.exr").read_bytes()
    count = calls
    for call in {1, 2, count // 2, *range(max(count - 12, 1), count + 1)}:
        calls, failing = 0, call
        with pytest.raises(OutputError if fault == "full disk" else KeyboardInterrupt):
            output.save(tmp_path / "a.exr", 2 * picture, compression=compression)
        assert (tmp_path / "a.exr").read_bytes() == good
        assert list(tmp_path.iterdir()) == [tmp_path / "a.exr"]


PICTURES = [np.zeros((0, 3, 3)), [[1, 2], [3]], np.zeros((2, 2, 4)), np.zeros((2, 2, 3), complex)]


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: f"{picture!r:.20}")
@pytest.mark.parametrize("ending", ["png", "exr"])
def test_what_is_no_picture_is_refused(tmp_path, ending, picture):
    with pytest.raises(OutputError, match=r"the picture (has shape|is no array of numbers)"):
        output.save(tmp_path / f"a.{ending}", picture)
    assert list(tmp_path.iterdir()) == []


attributes = Cases()
attributes("k" * 255, "x", "x")
attributes("k", np.float32(0.5), 0.5)
attributes("k", 2**31, "2147483648")
attributes("k", {"a": np.arange(2), "b": np.float32(2)}, '{"a": [0, 1], "b": 2.0}')
attributes("k", "\ud800", "\\ud800")
attributes("k" * 256, "x", OutputError)
attributes("k\0", "x", OutputError)
attributes("\ud800", "x", OutputError)
attributes("k", b"x", OutputError)
attributes("k", [object()], OutputError)
attributes("k", {(1, 2): 3}, OutputError)


@pytest.mark.parametrize(("name", "value", "expected"), attributes)
def test_attributes_come_back_or_are_refused(tmp_path, image, name, value, expected):
    if expected is OutputError:
        with pytest.raises(OutputError):
            output.save(tmp_path / "a.exr", image, header={name: value})
        assert list(tmp_path.iterdir()) == []
    else:
        output.save(tmp_path / "a.exr", image, header={name: value})
        assert output.read_exr(tmp_path / "a.exr").header[name] == expected


@pytest.mark.parametrize("step", ["fsync", "chmod", "replace"])
def test_interrupt_leaves_all_files_old_or_makes_all_new(tmp_path, monkeypatch, heeded, image, step):
    paths = old(tmp_path, ["png", "exr"])
    before = getattr(os, step)

    def interrupted(*words: object) -> object:
        done = before(*words)
        signal.raise_signal(signal.SIGINT)
        return done

    monkeypatch.setattr(os, step, interrupted)
    with pytest.raises(KeyboardInterrupt):
        output.save(paths, image)
    with interrupts.defer_signals():  # nothing is left for what comes after, though there were two
        interrupts.deliver_pending()
    assert {path.read_bytes() == b"old" for path in paths} == {step != "replace"}
    assert sorted(tmp_path.iterdir()) == sorted(paths)


def test_an_interrupt_while_a_block_ends_leaves_nothing_behind(monkeypatch, heeded):
    """The handler is back, and what waited is not raised in a later block, as once in many runs."""
    set_handler = signal.signal

    def interrupted(number: int, handler: Any) -> Any:
        old = set_handler(number, handler)
        if handler is signal.default_int_handler:
            signal.raise_signal(signal.SIGINT)
        return old

    with pytest.raises(KeyboardInterrupt), interrupts.defer_signals():
        signal.raise_signal(signal.SIGINT)
        monkeypatch.setattr(signal, "signal", interrupted)
    monkeypatch.undo()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with interrupts.defer_signals():
        interrupts.deliver_pending()
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler


def test_link_stays_and_its_target_is_replaced(tmp_path, image):
    target = tmp_path / "b.png"
    (tmp_path / "a.png").symlink_to(target)
    output.save(tmp_path / "a.png", image)
    assert (tmp_path / "a.png").is_symlink()
    assert target.stat().st_size > 0


def test_permissions_follow_the_umask_and_the_old_file(tmp_path, image):
    path = tmp_path / "a.png"
    old = os.umask(0o027)
    try:
        output.save(path, image)
        assert path.stat().st_mode & 0o777 == 0o640
        path.chmod(0o604)
        output.save(path, image)
        assert path.stat().st_mode & 0o777 == 0o604
    finally:
        os.umask(old)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_forked_process_can_write_too(tmp_path, image):
    """The threads that compress are not there in the child: it must not wait for them."""
    output.save(tmp_path / "a.exr", image)
    child = os.fork()
    if child == 0:
        signal.alarm(100)  # end it, should it wait
        output.save(tmp_path / "b.exr", image)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_no_file_is_replaced_that_the_scene_was_read_from(tmp_path):
    """By its own name, one through another folder, or a hard link; through others: ``test_refusals.py``."""
    texture = tmp_path / "texture.png"
    model = tmp_path / "a.obj"
    output.save(texture, grey(0, 1))
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd texture.png\n")
    model.write_text("mtllib a.mtl\n" + TRIANGLE)
    result = mrt.render(model, width=4, height=3, aa=1)
    os.link(texture, tmp_path / "b.exr")
    os.link(model, tmp_path / "c.png")
    before = {path: path.read_bytes() for path in (texture, model)}
    for name in ("texture.png", f"../{tmp_path.name}/texture.png", "b.exr", "c.png"):
        with pytest.raises(OutputError, match="made from this file; choose another name"):
            result.save(tmp_path / "new.exr", tmp_path / name)
    assert {path: path.read_bytes() for path in before} == before
    assert not (tmp_path / "new.exr").exists()


SENSORS = {
    "plain": {"type": "perspective", "fov": 40},
    "lens": {"type": "thinlens", "fov": 50, "aperture_radius": 0.1},
    "shifted": {"type": "perspective", "principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1},
}


@pytest.mark.parametrize("name", SENSORS)
def test_matrices_of_the_header_lead_from_rays_to_the_picture(variant, name):
    """A point on the ray through a place of the picture comes back to this place, and the camera sees it."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().look_at([3, 2, 5], [0, 0.5, 0], [0.1, 1, 0])
    film = {"type": "hdrfilm", "width": 40, "height": 20, "crop_width": 10, "crop_offset_x": 3}
    scene = {"type": "scene", "sensor": {**SENSORS[name], "to_world": to_world, "film": film}}
    header = mrt.render(scene, integrator="direct", aa=1, aamode="none").header()
    sensor = mi.load_dict(scene).sensors()[0]
    for place in ((0.5, 0.5), (0.1, 0.9), (0.8, 0.3)):
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(place), mi.Point2f(0.5))
        point = np.append(np.array(ray(7.0)).ravel(), 1.0)
        x, y, _, w = point @ header["mrt:worldToNDC"]
        assert_allclose((x / w, y / w), place, atol=1e-5)  # float32
        assert (point @ header["mrt:worldToCamera"])[2] < 0


def test_what_a_user_keeps_can_be_pickled():
    """Results, with plan and error, settings, scenes, comparisons, and errors."""
    result = mrt.render(3, width=16, height=12, integrator="path", spp=16, aamode="noise", layers=["depth"])
    for each in (result.plan, RenderSettings(aa=2), report_scene(3), mrt.UsageError("a\nb")):
        again = pickle.loads(pickle.dumps(each))
        assert str(again) == str(each) or again == each
    again = pickle.loads(pickle.dumps(result))
    assert again.image.tobytes() == result.image.tobytes()
    assert again.header() == result.header()
    shown = Image.open(io.BytesIO(again._repr_png_()))  # in a notebook
    assert_array_equal(shown, output.to_8bit(result.image, "srgb"))


@pytest.mark.parametrize(("compression", "least", "most"), [("zip", 0, 0.5), ("none", 1, 1.1)])
def test_compression(tmp_path, compression, least, most):
    image = np.random.default_rng(0).random((60, 80, 3), np.float32).round(1)
    output.save(tmp_path / "a.exr", image, compression=compression)
    assert_array_equal(output.read_exr(tmp_path / "a.exr").image, image)
    assert least < (tmp_path / "a.exr").stat().st_size / image.nbytes < most


@pytest.mark.parametrize("names", [(), (None,), (3,), (b"a.exr",), (["a.exr"],)])
def test_saving_without_a_name_says_so(tmp_path, monkeypatch, names):
    monkeypatch.chdir(tmp_path)
    result = mrt.render(0, width=4, height=3, aa=1, aamode="none")
    with pytest.raises(UsageError, match="name of a file"):
        result.save(*names)
    assert list(tmp_path.iterdir()) == []
