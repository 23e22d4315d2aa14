"""PNG and EXR: values, layers, header, and what happens when they cannot be written."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mrt_mitsuba.errors import MrtWarning, OutputError
from mrt_mitsuba.output import files as output


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(1).normal(0.5, 1, (7, 5, 3)).astype(np.float32)


def grey(*values: float) -> np.ndarray:
    """A picture one pixel high with these grey values."""
    return np.repeat(np.array(values, np.float32)[None, :, None], 3, axis=2)


def levels(values: np.ndarray, tonemap: str) -> list[int]:
    return output.to_8bit(values, tonemap)[0, :, 0].tolist()


def test_report_levels_are_truncated_without_gamma() -> None:
    values = grey(-np.inf, -1, 0, 0.999 / 255, 1.001 / 255, 0.5, 254.9 / 255, 1, 7, np.inf)
    assert levels(values, "report") == [0, 0, 0, 0, 1, 127, 254, 255, 255, 255]


def test_srgb_levels() -> None:
    # 0.0031308: where the two pieces of the curve meet; 0.2140: the linear value of 127.49 / 255
    values = grey(-1, 0, 0.0031308, 0.18, 0.2140, 0.5, 1, 3)
    assert levels(values, "srgb") == [0, 0, 10, 118, 127, 188, 255, 255]


@given(st.integers(0, 255))
def test_srgb_inverts_the_decoding_of_every_level(level: int) -> None:
    encoded = level / 255
    linear = encoded / 12.92 if encoded <= 0.04045 else ((encoded + 0.055) / 1.055) ** 2.4
    assert levels(grey(linear), "srgb") == [level]


def test_nan_is_black_and_told() -> None:
    with pytest.warns(MrtWarning, match="1 pixels are NaN"):
        assert levels(grey(0.5, np.nan), "report") == [127, 0]


def test_rows_beyond_the_first_block(tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 600, dtype=np.float32)[:, None, None].repeat(3, axis=2)
    output.write_png(tmp_path / "a.png", ramp)
    with Image.open(tmp_path / "a.png") as png:
        assert png.mode == "RGB" and png.size == (1, 600)
        np.testing.assert_array_equal(np.asarray(png)[:, 0, 0], np.trunc(255 * ramp[:, 0, 0]))


def test_exr_holds_every_bit(tmp_path: Path, image: np.ndarray) -> None:
    image[0, 0] = np.nan, np.inf, -np.inf
    layers = {"depth.Z": image[:, :, 0], "normal": image, "albedo": image * 2, "samples": image[:, :, 1]}
    header = {
        "mrt:version": "1",
        "mrt:seconds": 1.5,
        "mrt:scene": "4",
        "mrt:options": {"aa": 4, "layers": ["depth"]},
    }
    output.write_exr(tmp_path / "a.exr", image, layers, header)
    back = output.read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(back.image, image)
    assert back.image.dtype == np.float32
    expected = {"depth.Z": image[:, :, 0], "samples.Y": image[:, :, 1]}
    expected |= {f"normal.{name}": image[:, :, i] for i, name in enumerate("XYZ")}
    expected |= {f"albedo.{name}": 2 * image[:, :, i] for i, name in enumerate("RGB")}
    assert back.layers.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(back.layers[name], values, err_msg=name)
    assert back.header["mrt:options"] == '{"aa": 4, "layers": ["depth"]}'
    assert back.header["mrt:seconds"] == 1.5


def test_exr_is_the_same_file_twice(tmp_path: Path, image: np.ndarray) -> None:
    for name in ("a.exr", "b.exr"):
        output.save(tmp_path / name, image, layers={"depth": image[:, :, 0]}, header={"mrt:scene": "1"})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


@pytest.mark.parametrize(
    "layer", [{"depth": (7, 6)}, {"normal": (7, 5, 2)}, {"depth": (7, 5, 3)}, {"x": (7,)}]
)
def test_layer_of_another_shape(tmp_path: Path, image: np.ndarray, layer: dict) -> None:
    layers = {name: np.zeros(shape, np.float32) for name, shape in layer.items()}
    with pytest.raises(OutputError, match=f"layer {next(iter(layer))}"):
        output.write_exr(tmp_path / "a.exr", image, layers)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [None, b"", b"not an EXR", b"\x76\x2f\x31\x01" + bytes(50)])
def test_reading_what_is_no_exr(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.exr"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(OutputError, match=r"cannot read .*a\.exr"):
        output.read_exr(path)


def test_reading_half_an_exr(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    output.write_exr(path, np.random.default_rng(0).random((64, 64, 3), np.float32))
    path.write_bytes(path.read_bytes()[:10000])
    with pytest.raises(OutputError, match="not a whole EXR"):
        output.read_exr(path)


def make_bad_target(kind: str, folder: Path) -> Path:
    path = folder / "a.png"
    if kind == "missing folder":
        path = folder / "none" / "a.png"
    elif kind == "file as folder":
        (folder / "none").touch()
        path = folder / "none" / "a.png"
    elif kind == "folder":
        path.mkdir()
    elif kind == "link loop":
        path.symlink_to(path)
    elif kind == "read-only":
        path.write_bytes(b"precious")
        path.chmod(0o444)
    elif kind == "device":
        path = Path("/dev/full")
    elif kind == "long name":
        path = folder / ("a" * 300 + ".png")
    return path


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("missing folder", "does not exist; create it first"),
        ("file as folder", "is a file, not a folder"),
        ("folder", "is a folder"),
        ("link loop", "in a circle"),
        ("read-only", "is read-only"),
        ("device", "not a regular file"),
        ("long name", "name too long"),
    ],
)
def test_target_that_cannot_be_written(tmp_path: Path, image: np.ndarray, kind: str, reason: str) -> None:
    path = make_bad_target(kind, tmp_path)
    before = sorted(tmp_path.rglob("*"))
    for attempt in (
        output.check_target,
        lambda p: output.write_png(p, image),
        lambda p: output.write_exr(p, image),
    ):
        with pytest.raises(OutputError, match=f"(?i)cannot write .*{reason}"):
            attempt(path)
    assert sorted(tmp_path.rglob("*")) == before
    if kind == "read-only":
        assert path.read_bytes() == b"precious"


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write anywhere"
)
def test_folder_without_write_permission(tmp_path: Path, image: np.ndarray) -> None:
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(OutputError, match="Permission denied"):
            output.write_png(tmp_path / "a.png", image)
    finally:
        tmp_path.chmod(0o755)


@pytest.mark.parametrize("name", ["a", "a.jpg", "a.b/c"])
def test_extension_says_the_format(tmp_path: Path, image: np.ndarray, name: str) -> None:
    with pytest.raises(OutputError, match=r"must end in \.png or \.exr"):
        output.save(tmp_path / name, image)


class FullDisk:
    """A file on a disk that has room for some bytes only."""

    def __init__(self, file: object, room: int, error: BaseException) -> None:
        self._file, self._room, self._error = file, room, error

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)

    def __enter__(self) -> FullDisk:
        return self

    def __exit__(self, *details: object) -> None:
        self._file.close()

    def write(self, data: bytes) -> int:
        self._room -= len(data)
        if self._room < 0:
            raise self._error
        return self._file.write(data)


@pytest.mark.parametrize("ending", ["png", "exr"])
@pytest.mark.parametrize("room", [0, 100, 2000])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyboardInterrupt()])
def test_failure_half_way_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, room: int, error: BaseException
) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"old")
    real = output._open_beside

    def open_beside(target: str) -> tuple[str, FullDisk]:
        temporary, file = real(target)
        return temporary, FullDisk(file, room, error)

    monkeypatch.setattr(output, "_open_beside", open_beside)
    noise = np.random.default_rng(0).random((40, 40, 3), np.float32)  # does not compress: over 4000 bytes
    expected, text = (
        (OutputError, "No space left") if isinstance(error, OSError) else (KeyboardInterrupt, None)
    )
    with pytest.raises(expected, match=text):
        output.save(path, noise)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("ending", ["png", "exr"])
def test_disk_full_as_the_kernel_reports_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, image: np.ndarray, ending: str
) -> None:
    """A small picture fits into Python's buffer: the error only comes with the flush."""
    beside = tmp_path / ".beside"
    beside.symlink_to("/dev/full")
    monkeypatch.setattr(output, "_open_beside", lambda target: (str(beside), beside.open("wb")))
    with pytest.raises(OutputError, match="No space left on device"):
        output.save(tmp_path / f"a.{ending}", image)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ["png", "exr"])
def test_file_is_on_the_disk_before_it_takes_the_place_of_the_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, image: np.ndarray, ending: str
) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"old")
    synced: list[int] = []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (fsync(fd), synced.append(os.fstat(fd).st_size)))
    with path.open("rb") as reader:  # of the old file, which is replaced and not written over
        output.save(path, image)
        assert reader.read() == b"old"
    assert synced == [path.stat().st_size]
    assert list(tmp_path.iterdir()) == [path]


def test_link_stays_and_its_target_is_replaced(tmp_path: Path, image: np.ndarray) -> None:
    (tmp_path / "real").mkdir()
    target = tmp_path / "real" / "b.png"
    (tmp_path / "a.png").symlink_to(target)
    output.write_png(tmp_path / "a.png", image)
    assert (tmp_path / "a.png").is_symlink() and target.stat().st_size > 0


def test_permissions_follow_the_umask_and_the_old_file(tmp_path: Path, image: np.ndarray) -> None:
    path = tmp_path / "a.png"
    old = os.umask(0o027)
    try:
        output.write_png(path, image)
        assert path.stat().st_mode & 0o777 == 0o640
        path.chmod(0o604)
        output.write_png(path, image)
        assert path.stat().st_mode & 0o777 == 0o604
    finally:
        os.umask(old)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_forked_process_can_write_too(tmp_path: Path, image: np.ndarray) -> None:
    """The threads that compress are not there in the child: it must not wait for them."""
    output.write_exr(tmp_path / "a.exr", image)
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # end it, should it wait
        output.write_exr(tmp_path / "b.exr", image)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
