"""The benchmark: both sides measure the same cases in turns, by public names."""

from __future__ import annotations

import json
import sys

import pytest

from mrt_mitsuba.validation import bench
from mrt_mitsuba.validation.timing import ratio_of, timed_in_turns


@pytest.mark.parametrize("name", ["200 lights", "small, prepared"])
def test_renders_are_those_of_their_names(name, variant):
    assert bench.seconds(bench.CASES[name]) > 0


def test_both_sides_take_turns(tmp_path, capsys, monkeypatch):
    """The other Python measures the same cases."""
    script = tmp_path / "bench.py"
    script.write_text('import sys; print(\'{"small, loaded": 2, "%s": 1}\' % sys.argv[-1])')
    monkeypatch.setattr(bench, "__file__", str(script))
    out = tmp_path / "new" / "bench.json"
    assert bench.main(["scene 0", "--turns", "2", "--before", sys.executable, "--out", str(out)]) == 0
    rows = json.loads(out.read_text())
    assert rows == {"scene 0": {"seconds": 1, "other seconds": 1, "ratio": 1, "low": 1, "high": 1}}
    assert "ratio 1" in capsys.readouterr().out


def test_an_unknown_case_is_refused(capsys):
    with pytest.raises(SystemExit):
        bench.main(["scene 77"])
    assert "unknown case 'scene 77': choose from scene 0" in capsys.readouterr().err


def test_runs_are_timed_in_turns():
    order: list[tuple[str, int]] = []
    sides = [lambda turn, name=name: order.append((name, turn)) for name in "ab"]
    (results, seconds), _ = timed_in_turns(sides, 3)
    assert len(results) == len(seconds) == 3
    assert "".join(name for name, _ in order) == "ab" + "ab" + "ba" + "ab"
    ratio = ratio_of([1, 2, 3], [1, 1, 1])
    assert [ratio[name] for name in ("ratio", "low", "high")] == [2, 1.5, 2.5]
