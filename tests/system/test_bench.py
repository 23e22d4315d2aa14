"""The benchmark: its file, its comparison, and the renders that it measures."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from mrt_mitsuba.validation import bench, renders
from mrt_mitsuba.validation.studies import speed


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A run of two renders in turns with this same version, and of the scene's pairs."""
    path = tmp_path_factory.mktemp("bench") / "new" / "bench.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "FULL", speed.Extent(40, 30, 1, (0,), 1, 4))
        patch.setattr(bench, "cases", lambda given: iter([("small, loaded", {"seconds": 0.5})]))
        assert bench.main(["--turns", "1", "--out", str(path)]) == 0
    return path


@pytest.mark.slow
def test_file_has_a_row_for_each_figure(found):
    run = json.loads(found.read_text())
    assert {"mitsuba", "llvm", "python", "cores"} <= run["machine"].keys()
    assert run["options"]["turns"] == 1
    assert len(run["rows"]) == 2 + 3
    start, *_ = run["rows"].values()
    assert start["goal"] == bench.START_GOAL
    assert start["low"] <= start["ratio"] <= start["high"]


@pytest.mark.parametrize("name", ["200 lights", "aamode=noise", "small, with an update"])
def test_renders_are_those_of_their_names(name, monkeypatch, variant):
    count, make = renders.CASES[name]
    monkeypatch.setitem(renders.CASES, name, (1, make))
    assert renders.seconds(name) > 0
    assert count >= 1


def test_both_sides_take_turns(monkeypatch, tmp_path):
    """The other Python measures the same cases."""
    monkeypatch.setattr(renders, "CASES", {"small": (1, lambda: None)})
    script = tmp_path / "renders.py"
    script.write_text("import sys; print('{\"%s\": %s}' % (sys.argv[1], sys.argv[0].count('/')))")
    monkeypatch.setattr(renders, "__file__", str(script))
    arguments = ["--small", "--turns", "2", "--before", sys.executable, "--out", str(tmp_path / "b.json")]
    monkeypatch.setattr(bench, "start", lambda turns: {"seconds": float(turns)})
    assert bench.main(arguments) == 0
    rows = json.loads((tmp_path / "b.json").read_text())["rows"]
    assert rows["small"]["ratio"] == 1
    assert rows["small"]["other_seconds"] == rows["small"]["seconds"] > 0


@pytest.mark.slow
def test_comparison_prints_ratios(found, tmp_path, monkeypatch, capsys):
    before = bench.read(found)
    twice = [
        (name, row | {k: 2 * row[k] for k in row if k in ("seconds", "ratio")})
        for name, row in before.items()
    ]
    monkeypatch.setattr(bench, "rows", lambda given: iter([*twice, ("new", {"seconds": 1.0})]))
    assert bench.main(["--compare", str(found), "--out", str(tmp_path / "b.json")]) == 0
    *_, columns, start, _, _, _, _, new = capsys.readouterr().out.splitlines()
    assert columns.endswith("to then")
    assert start.split()[-2:] == ["1.7", "2"]
    assert new.endswith(" 1")
    assert bench.read(tmp_path / "b.json")["small, loaded"] == {"seconds": 1.0, "to then": 2.0}


@pytest.mark.parametrize("text", ["{}", "[1]", "no json", '{"rows": 3}'])
def test_a_file_of_another_kind_is_refused(text, tmp_path, capsys):
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(SystemExit):
        bench.main(["--compare", str(tmp_path / "other.json"), "--out", str(tmp_path / "b.json")])
    assert "cannot compare" in capsys.readouterr().err
    assert not (tmp_path / "b.json").exists()


def test_a_place_that_cannot_be_written_is_found_before_measuring(tmp_path, capsys):
    (tmp_path / "file").touch()
    (tmp_path / "folder.json").mkdir()
    for out, reason in (("file/b.json", "cannot make the folder"), ("folder.json", "it is a folder")):
        assert bench.main(["--out", str(tmp_path / out)]) == 1
        text, errors = capsys.readouterr()
        assert text == ""
        assert errors.startswith("make bench: ")
        assert reason in errors


def test_renders_know_public_names_only():
    """So that an earlier version can be measured."""
    lines = Path(renders.__file__).read_text().splitlines()
    assert not [line for line in lines if "from mrt_mitsuba" in line or "import mrt_mitsuba." in line]
