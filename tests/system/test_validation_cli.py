"""``mrt-validate``: exit codes, files and the page, with studies made for these tests."""

from __future__ import annotations

import json
import re
import sys
import types
from collections.abc import Callable
from html import unescape
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrt_mitsuba.validation import cli
from mrt_mitsuba.validation.study import Study

for needed in cli.EXTRAS:
    pytest.importorskip(needed)

TITLE = "Cones & <spheres>"
INFINITE = float("inf")


@pytest.fixture
def validate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., tuple[int, Any, str]]:
    """Run the command over studies that are functions, by name; return code, summary and page."""

    def run(*options: str, **studies: Callable[..., None]) -> tuple[int, Any, str]:
        for name, function in studies.items():
            module = types.ModuleType(f"mrt_mitsuba.validation.studies.{name}")
            module.TITLE = TITLE
            module.run = function  # type: ignore[attr-defined]
            monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(cli, "STUDIES", {name: ("", "1 s", "2 s") for name in studies})
        code = cli.main(["all", "--out", str(tmp_path), *options])
        if code == cli.INTERRUPTED:
            return code, {}, ""
        summary = json.loads((tmp_path / "summary.json").read_text())
        return code, summary, (tmp_path / "index.html").read_text("utf-8")

    return run


def good(study: Study, *, quick: bool) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot([1, 2])
    study.texts.append("What it does, in a <b>sentence</b>.")
    study.at_most("largest error", 1e-6, 1e-5, "a reason")
    study.at_least("power", 0.9, 0.5, "a reason")
    rows = [{"metal": "Ag", "error": 0.123456789, "n": 2}]
    rows += [{"metal": "Cu", "error": np.float32("inf"), "n": 12345678}]
    study.records("errors", "Errors", rows)
    study.records("answer", "What to do", [{"setting": "aa=2"}], first=True)
    study.picture("curve", "A curve", figure, "rises")
    study.picture("ball", "A ball", np.full((4, 5, 3), 0.25))
    assert list(study.each("work", [1, 2])) == [1, 2]


def broken(study: Study, *, quick: bool) -> None:
    study.at_most("found before", 0, 1, "a reason")
    raise ZeroDivisionError("a light without <area>")


def test_everything_a_study_finds_is_written(validate, tmp_path, capsys):
    code, summary, page = validate("--quick", good=good)
    assert code == 0
    parts = ["answer.csv", "ball.png", "curve.png", "errors.csv"]
    names = [*(f"good-{part}" for part in parts), "index.html", "summary.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert {"version", "mitsuba", "drjit", "python", "date"} <= summary.keys()
    assert (summary["quick"], summary["passed"]) == (True, True)
    found = summary["studies"]["good"]
    assert (found["title"], found["verdict"]) == (TITLE, "passed")
    bound = {"name": "largest error", "measured": 1e-6, "limit": 1e-5, "sense": "<=", "holds": True}
    assert found["bounds"][0] == {**bound, "note": "a reason"}
    rows = [
        {"metal": "Ag", "error": 0.123456789, "n": 2},
        {"metal": "Cu", "error": "Infinity", "n": 12345678},
    ]
    assert found["tables"]["errors"]["rows"] == rows
    assert (tmp_path / "good-errors.csv").read_text().startswith("metal,error,n\nAg,0.123456789,2\n")
    assert "ok     largest error: 1e-06 <= 1e-05" in capsys.readouterr().out
    # The page holds all of it and loads nothing; answers come first, tables last, and texts are texts
    links = re.findall(r'(?:src|href)="(.*?)"', page)
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
    assert len(re.findall("<img", page)) == 2
    assert not re.search("<script|<b>", page)
    assert page.index("What to do") < page.index("A curve") < page.index("Errors")
    texts = [TITLE, "in a <b>sentence</b>.", "0.1235", "inf", "1e-06", "a reason", "holds"]
    assert [text for text in texts if text not in unescape(page)] == []


@pytest.mark.parametrize(
    ("bad", "verdict"),
    [
        (lambda study, **_: study.at_most("largest error", 2e-5, 1e-5, "a reason"), "missed"),
        (lambda study, **_: study.at_least("largest error", float("nan"), 1e-5, "a reason"), "missed"),
        (broken, "failed"),
        (lambda study, **_: None, "empty"),
    ],
    ids=["missed", "unknown", "broken", "empty"],
)
def test_what_does_not_pass_is_shown_and_the_others_go_on(validate, capsys, bad, verdict):
    code, summary, page = validate(bad=bad, good=good)
    assert code == 1
    assert summary["passed"] is False
    assert [study["verdict"] for study in summary["studies"].values()] == [verdict, "passed"]
    assert f"✗ {verdict}" in page
    if bad is broken:
        assert "ZeroDivisionError: a light without <area>" in unescape(page)
        assert "found before" in page
        assert "FAILED ZeroDivisionError: a light without <area>" in capsys.readouterr().out


def test_list_has_a_line_on_each_study_and_each_can_be_run(capsys, monkeypatch, tmp_path):
    with pytest.raises(SystemExit):
        cli.main(["--list"])
    text = capsys.readouterr().out
    assert all(about and about in text for about, *_ in cli.STUDIES.values())
    for name in cli.STUDIES:
        module = import_module(f"mrt_mitsuba.validation.studies.{name.replace('-', '_')}")
        assert module.TITLE
        assert callable(module.run)
    monkeypatch.setattr(cli, "STUDIES", {"gone": ("", "1 s", "2 s")})
    assert cli.main(["gone", "--out", str(tmp_path / "new")]) == 1
    assert "ModuleNotFoundError" in (tmp_path / "new" / "summary.json").read_text()


@pytest.mark.parametrize("arguments", [[], ["cones"], ["all", "--quik"], ["all", "--out"]])
def test_wrong_usage(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 2
    assert "usage: mrt-validate" in capsys.readouterr().err


def test_what_is_missing_is_found_before_the_work(monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    (tmp_path / "index.html").mkdir()
    for folder in (tmp_path / "file", tmp_path):
        assert cli.main(["needs", "--out", str(folder)]) == 1
        assert str(folder) in (errors := capsys.readouterr().err)
        assert "needs:" not in errors
    monkeypatch.setattr(cli, "EXTRAS", (*cli.EXTRAS, "no_such_library"))
    assert cli.main(["needs", "--out", str(tmp_path / "report")]) == 1
    assert (
        "no_such_library is not installed: pip install 'mrt-mitsuba[validation]'" in capsys.readouterr().err
    )
    assert not (tmp_path / "report").exists()


def test_interrupt_leaves_the_report_as_it_was(validate, tmp_path):
    def interrupted(study: Study, *, quick: bool) -> None:
        raise KeyboardInterrupt

    (tmp_path / "summary.json").write_text("before")
    assert validate(good=good, slow=interrupted)[0] == cli.INTERRUPTED
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    assert (tmp_path / "summary.json").read_text() == "before"
