"""The folder of a sweep: one sweep at a time, no trace of a killed one, and no damaged picture is kept."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from typing import Any

import pytest
from clusters import PATIENCE, Cluster

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.progress import Progress

pytest.importorskip("distributed")
pytestmark = pytest.mark.attack

SMALL = {"width": 64, "height": 48, "aa": 1}
COMMAND = [sys.executable, "-m", "mrt_mitsuba.command.main"]
SWEEP = "scene = 3\nwidth = 64\nheight = 48\naa = 1\n[grid]\nseed = [{}]\n"

# What each worker runs first: seeds above 1 wait for a file
WAITING = """
import pathlib, time
from mrt_mitsuba.rendering import api
def render(*scene, seed=0, alone=api.render, **options):
    while seed > 1 and not pathlib.Path("go").exists():
        time.sleep(0.05)
    return alone(*scene, seed=seed, **options)
api.render = render
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of a cluster with one worker, for tests that leave it whole."""
    cluster = Cluster(tmp_path_factory.mktemp("cluster"), count=1)
    yield cluster.address
    cluster.stop()


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".exr", ".png")}


def hidden(folder):
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def test_a_second_sweep_in_the_folder_is_refused(address, tmp_path):
    """In another process, by another path; the first one is not disturbed."""
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "link").symlink_to(out)
    (tmp_path / "sweep.toml").write_text(SWEEP.format("7, 8"))

    class Meanwhile(Progress):
        def stage(self, title: str, total: int, message: str = "") -> Any:
            words = [*COMMAND, "sweep", "link", "sweep.toml"]
            self.done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
            return super().stage(title, total, message)

    meanwhile = Meanwhile()
    table = mrt.sweep(3, out, grid={"seed": [1]}, cluster=address, progress=meanwhile, **SMALL)
    assert not table.failed
    assert meanwhile.done.returncode == 1
    assert "another sweep works there" in meanwhile.done.stderr
    assert sorted(path.name for path in out.iterdir()) == ["seed=1.exr", "table.csv"]


def test_a_killed_sweep_frees_the_folder_and_its_pictures_are_kept(tmp_path, monkeypatch, start):
    (tmp_path / "waiting.py").write_text(WAITING)
    monkeypatch.setenv("DASK_DISTRIBUTED__WORKER__PRELOAD", repr([str(tmp_path / "waiting.py")]))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep.toml").write_text(SWEEP.format("0, 1, 2"))
    out = tmp_path / "out"
    with start(*COMMAND, "sweep", "out", "sweep.toml", "workers=1") as process:
        deadline = time.monotonic() + PATIENCE
        while len(list(out.glob("*.exr"))) != 2:  # the third picture has been begun
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
    assert hidden(out)
    (out / "table.csv").unlink(missing_ok=True)  # its last rows may not have been written
    first = {path.name: path.stat().st_mtime_ns for path in out.glob("*.exr")}
    (tmp_path / "go").touch()
    table = mrt.sweep(3, out, grid={"seed": [0, 1, 2]}, workers=1, **SMALL)
    assert [row["error"] for row in table.rows] == [""] * 3
    assert hidden(out) == []
    assert first.items() <= {path.name: path.stat().st_mtime_ns for path in out.glob("*.exr")}.items()


def test_a_folder_of_the_users_does_not_matter(tmp_path):
    (tmp_path / ".mrt-sweep-of-the-user").mkdir()
    assert not mrt.sweep(3, tmp_path, grid={"seed": [1]}, workers=1, **SMALL).failed
    assert hidden(tmp_path) == [".mrt-sweep-of-the-user"]


def flip(data, place):
    data[place] ^= 4


def blank(data, place):
    data[place : place + 64] = bytes(64)


def cut(data, place):
    del data[place:]


def drop(data, place):
    data.clear()


@pytest.mark.parametrize("damage", [flip, blank, cut, drop])
def test_damaged_pictures_are_made_again(address, tmp_path, damage, capfd):
    """Anywhere in the file: the header, the mark of the sweep in it, the table of rows, pixels, the end."""
    options = {"grid": {"seed": range(5)}, "cluster": address, **SMALL}
    mrt.sweep(3, tmp_path, **options)
    whole = contents(tmp_path)
    names = sorted(whole)
    for number, name in enumerate(names):
        data = whole[name]
        mark = data.index(b"mrt:sweep")
        places = [0, 40, mark + 30, len(data) // 2, len(data) // 3, len(data) - 66]
        damaged = bytearray(data)
        damage(damaged, places[number % len(places)])
        (tmp_path / name).write_bytes(damaged)
        assert damaged != data
    table = mrt.sweep(3, tmp_path, **options)
    assert not table.failed
    assert contents(tmp_path) == whole
    assert capfd.readouterr() == ("", "")  # nothing of what libraries print about broken files
