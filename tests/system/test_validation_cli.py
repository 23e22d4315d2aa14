"""``mrt-validate``: exit codes, files and the page, with studies made for these tests."""

from __future__ import annotations

import csv
import html.parser
import json
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.validation import cli
from mrt_mitsuba.validation.tools.report import LONG_LIST, cell
from mrt_mitsuba.validation.tools.study import Study

for needed in cli.EXTRAS:
    pytest.importorskip(needed)

TITLE = "Cones & <spheres>"


class Page(html.parser.HTMLParser):
    """Tags in order, text, and what a page would load from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loaded: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loaded += [value or "" for name, value in attributes if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture
def validate(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., tuple[int, dict[str, Any], Page]]:
    """Run the command over studies that are functions, by name; return code, summary and page."""

    def run(*options: str, **studies: Callable[..., None]) -> tuple[int, dict[str, Any], Page]:
        for name, function in studies.items():
            module = types.ModuleType(f"mrt_mitsuba.validation.studies.{name}")
            module.TITLE, module.run = TITLE, function  # type: ignore[attr-defined]
            monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(cli, "STUDIES", {name: (name, "", 1, 2) for name in studies})
        code = cli.main(["all", "--out", str(tmp_path), *options])
        if code == cli.INTERRUPTED:
            return code, {}, Page("")
        summary = json.loads((tmp_path / "summary.json").read_text())
        return code, summary, Page((tmp_path / "index.html").read_text("utf-8"))

    return run


def good(study: Study, *, quick: bool) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot([1, 2])
    study.text("What it does, in a <b>sentence</b>.")
    study.at_most("largest error", 1e-6, 1e-5, "a reason")
    study.at_least("power", 0.9, 0.5, "a reason")
    study.goal("ratio of seconds", 1.4, 1.3, "taken in turn", interval=(1.35, 1.5))
    study.goal("another ratio", 1.2, 1.3, "taken in turn", interval=(1.1, 1.5))
    study.record("quick", quick)
    study.table("errors", "Errors", ["metal", "error"], [["Ag", 0.123456789], ["Au", np.float32(0.5)]])
    study.table("answer", "What to do", ["setting"], [["aa=2"]], first=True)
    study.plot("curve", "A curve", figure, "rises")
    study.picture("ball", "A ball", np.full((4, 5, 3), 0.25), exr=True)
    assert list(study.each("work", [1, 2])) == [1, 2]


def missed(study: Study, *, quick: bool) -> None:
    study.at_most("largest error", 2e-5, 1e-5, "a reason")


def broken(study: Study, *, quick: bool) -> None:
    study.at_most("found before", 0, 1, "a reason")
    raise ZeroDivisionError("a light without <area>")


def empty(study: Study, *, quick: bool) -> None:
    pass


def test_everything_a_study_finds_is_written(validate, tmp_path: Path, capsys) -> None:
    code, summary, _ = validate("--quick", good=good)
    assert code == 0
    parts = ["answer.csv", "ball.exr", "ball.png", "curve.png", "errors.csv"]
    names = [*(f"good-{part}" for part in parts), "index.html", "summary.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert {"version", "mitsuba", "drjit", "python", "date"} <= summary.keys()
    assert (summary["quick"], summary["passed"]) == (True, True)
    found = summary["studies"]["good"]
    assert (found["title"], found["verdict"], found["figures"]) == (TITLE, "passed", {"quick": 1.0})
    bound = {"name": "largest error", "measured": 1e-6, "limit": 1e-5, "sense": "<=", "holds": True}
    assert found["bounds"][0] == {**bound, "note": "a reason"}
    with open(tmp_path / "good-errors.csv", newline="") as file:
        assert list(csv.reader(file)) == [["metal", "error"], ["Ag", "0.123456789"], ["Au", "0.5"]]
    np.testing.assert_array_equal(read_exr(tmp_path / "good-ball.exr").image, np.float32(0.25))
    table = found["tables"]["errors"]
    assert (table["columns"], table["rows"]) == (["metal", "error"], [["Ag", 0.123456789], ["Au", 0.5]])
    # goals are not reached, and yet the study has passed; one is within the interval
    assert [goal["verdict"] for goal in found["goals"]] == ["slower", "open"]
    shown = capsys.readouterr().out
    assert "ok     largest error" in shown and "slower ratio of seconds" in shown


def test_page_is_self_contained_with_answers_first_and_tables_last(validate, tmp_path: Path) -> None:
    _, _, page = validate(good=good)
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.loaded)
    assert page.tags.count("img") == 2
    assert page.text.index("What to do") < page.text.index("A curve") < page.text.index("Errors")
    assert "script" not in page.tags and "b" not in page.tags  # texts are texts
    shown = [TITLE, "in a <b>sentence</b>.", "0.1235", "1e-06", "a reason", "✓ holds", "slower"]
    shown += ["not decided", "cores", "The original is mrt"]
    assert [text for text in shown if text not in page.text] == []


def test_list_has_a_line_on_each_study(capsys) -> None:
    from importlib import import_module

    for option in ("--list", "--help"):
        with pytest.raises(SystemExit) as ended:
            cli.main([option])
        text = capsys.readouterr().out
        assert ended.value.code == 0 and all(about and about in text for _, about, *_ in cli.STUDIES.values())
    for name, _, quick, full in cli.STUDIES.values():
        module = import_module(f"mrt_mitsuba.validation.studies.{name}")
        assert module.TITLE and callable(module.run) and 0 < quick < full


@pytest.mark.parametrize(("bad", "verdict"), [(missed, "missed"), (broken, "failed"), (empty, "empty")])
def test_what_does_not_pass_is_shown_and_the_others_go_on(validate, capsys, bad, verdict) -> None:
    code, summary, page = validate(bad=bad, good=good)
    assert code == 1 and summary["passed"] is False
    assert [study["verdict"] for study in summary["studies"].values()] == [verdict, "passed"]
    assert f"✗ {verdict}" in page.text
    if bad is broken:
        assert "ZeroDivisionError: a light without <area>" in page.text and "found before" in page.text
        assert "FAILED ZeroDivisionError: a light without <area>" in capsys.readouterr().out


def test_a_study_that_cannot_be_imported_is_a_failure(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cli, "STUDIES", {"gone": ("no_such_module", "", 1, 2)})
    assert cli.main(["gone", "--out", str(tmp_path / "new")]) == 1
    assert "ModuleNotFoundError" in (tmp_path / "new" / "summary.json").read_text()


def test_infinite_and_undefined_figures_stay_readable(validate) -> None:
    def odd(study: Study, *, quick: bool) -> None:
        study.at_most("undefined", float("nan"), 1, "a reason")
        study.record("infinite", float("inf"))

    code, summary, _ = validate(odd=odd)
    found = summary["studies"]["odd"]
    assert code == 1 and found["bounds"][0]["measured"] == "nan" and found["figures"] == {"infinite": "inf"}


@pytest.mark.parametrize("arguments", [[], ["cones"], ["all", "--quik"], ["all", "--out"]])
def test_wrong_usage(arguments: list[str], capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == UsageError.exit_code == 2
    assert "usage: mrt-validate" in capsys.readouterr().err


def test_missing_extras_are_named_with_the_command_that_brings_them(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(cli, "EXTRAS", (*cli.EXTRAS, "no_such_library"))
    assert cli.main(["laws", "--out", str(tmp_path / "report")]) == 1
    message = capsys.readouterr().err
    assert message.startswith("mrt-validate: no-such-library missing: ")
    assert message.endswith(" -m pip install no-such-library\n") and not (tmp_path / "report").exists()


def test_folder_is_checked_before_the_work(tmp_path: Path, capsys) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "index.html").mkdir()
    for folder in (tmp_path / "file", tmp_path):
        assert cli.main(["laws", "--out", str(folder)]) == 1
        assert str(folder) in (errors := capsys.readouterr().err) and "laws:" not in errors


def test_interrupt_leaves_the_report_as_it_was(validate, tmp_path: Path) -> None:
    def interrupted(study: Study, *, quick: bool) -> None:
        raise KeyboardInterrupt

    (tmp_path / "summary.json").write_text("before")
    assert validate(good=good, slow=interrupted)[0] == cli.INTERRUPTED
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    assert (tmp_path / "summary.json").read_text() == "before"


@pytest.mark.parametrize("wrong", [False, True])
def test_many_bounds_are_folded_unless_one_is_missed(validate, wrong: bool) -> None:
    def many(study: Study, *, quick: bool) -> None:
        for i in range(LONG_LIST):
            study.at_most(f"bound {i}", float(wrong and i == 3), 0, "a reason")

    page = validate(many=many)[2]
    assert page.tags.count("details") == (0 if wrong else 1)
    assert page.text.count("✗ missed") == (3 if wrong else 0)  # in the list, the title and the row


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.123456, "0.1235"), (np.float32(2e-5), "2e-05"), (12345678, "12345678"), ("Ag", "Ag"), (True, "yes")],
)
def test_numbers_in_tables(value: object, shown: str) -> None:
    assert cell(value) == shown
