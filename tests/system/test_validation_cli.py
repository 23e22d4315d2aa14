"""``mrt-validate``: exit codes, files and the page, with studies made for these tests."""

from __future__ import annotations

import csv
import html.parser
import json
import sys
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.validation import cli
from mrt_mitsuba.validation.tools.report import LONG_LIST, cell
from mrt_mitsuba.validation.tools.study import Study

for needed in cli.EXTRAS:
    pytest.importorskip(needed)

Run = Callable[..., None]
TITLE = "Cones & <spheres>"


@pytest.fixture
def studies(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make the command's studies those given, as functions by name."""

    def install(**runs: Run) -> None:
        for name, run in runs.items():
            module = types.ModuleType(f"mrt_mitsuba.validation.studies.{name}")
            module.TITLE, module.run = TITLE, run  # type: ignore[attr-defined]
            monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(cli, "STUDIES", {name: cli.Entry(name, "") for name in runs})

    return install


def good(study: Study, *, quick: bool) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot([1, 2])
    study.text("What it does, in a <b>sentence</b>.")
    study.at_most("largest error", 1e-6, 1e-5, "a reason")
    study.at_least("power", 0.9, 0.5)
    study.goal("ratio of seconds", 1.4, 1.3, "taken in turn", interval=(1.35, 1.5))
    study.record("quick", quick)
    study.table("errors", "Errors", ["metal", "error"], [["Ag", 0.123456789], ["Au", np.float32(0.5)]])
    study.plot("curve", "A curve", figure, "rises")
    study.picture("ball", "A ball", np.full((4, 5, 3), 0.25), exr=True)
    with study.stage("work", 2) as advance:
        advance(2)


def missed(study: Study, *, quick: bool) -> None:
    study.at_most("largest error", 2e-5, 1e-5)


def broken(study: Study, *, quick: bool) -> None:
    study.at_most("found before", 0, 1)
    raise ZeroDivisionError("a light without <area>")


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


def test_everything_a_study_finds_is_written(studies, tmp_path: Path, capsys) -> None:
    studies(good=good)
    folder = tmp_path / "new" / "report"
    assert cli.main(["all", "--quick", "--out", str(folder)]) == 0
    names = [
        "good-ball.exr",
        "good-ball.png",
        "good-curve.png",
        "good-errors.csv",
        "index.html",
        "summary.json",
    ]
    assert sorted(path.name for path in folder.iterdir()) == names
    summary = json.loads((folder / "summary.json").read_text())
    assert {"version", "mitsuba", "drjit", "python", "date"} <= summary.keys()
    assert (summary["quick"], summary["passed"]) == (True, True)
    found = summary["studies"]["good"]
    assert (found["title"], found["verdict"], found["figures"]) == (TITLE, "passed", {"quick": 1.0})
    bound = {"name": "largest error", "measured": 1e-6, "limit": 1e-5, "sense": "<=", "holds": True}
    assert found["bounds"][0] == {**bound, "note": "a reason"}
    with open(folder / "good-errors.csv", newline="") as file:
        assert list(csv.reader(file)) == [["metal", "error"], ["Ag", "0.123456789"], ["Au", "0.5"]]
    np.testing.assert_array_equal(read_exr(folder / "good-ball.exr").image, np.float32(0.25))
    table = found["tables"]["errors"]
    assert (table["columns"], table["rows"]) == (["metal", "error"], [["Ag", 0.123456789], ["Au", 0.5]])
    (goal,) = found["goals"]  # missed, and yet the study has passed
    assert (goal["name"], goal["measured"], goal["holds"]) == ("ratio of seconds", 1.4, False)
    shown = capsys.readouterr().out
    assert "ok     largest error" in shown and "slower ratio of seconds" in shown


def test_page_is_self_contained_with_pictures_before_tables(studies, tmp_path: Path) -> None:
    studies(good=good)
    cli.main(["good", "--out", str(tmp_path)])
    text = (tmp_path / "index.html").read_text("utf-8")
    page = Page(text)
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.loaded)
    assert page.tags.count("img") == 2
    assert max(i for i, tag in enumerate(page.tags) if tag == "img") < page.tags.index("table")
    assert "script" not in page.tags and "b" not in page.tags  # texts are texts
    assert '<meta name="viewport" content="width=device-width' in text
    for shown in (
        TITLE,
        "What it does, in a <b>sentence</b>.",
        "0.1235",
        "1e-06",
        "a reason",
        "✓ holds",
        "slower",
        "cores",
    ):
        assert shown in page.text, shown


def test_a_table_that_answers_comes_before_the_pictures(studies, tmp_path: Path) -> None:
    def answer(study: Study, *, quick: bool) -> None:
        good(study, quick=quick)
        study.table("answer", "What to do", ["setting"], [["aa=2"]], first=True)

    studies(answer=answer)
    cli.main(["answer", "--out", str(tmp_path)])
    text = Page((tmp_path / "index.html").read_text("utf-8")).text
    assert text.index("What to do") < text.index("A curve") < text.index("Errors")


def test_names_stand_for_studies() -> None:
    speed = list(cli.SPEED)
    assert cli._named(["error-vs-time"]) == speed and cli._named(["growth"]) == ["growth"]
    assert cli._named(["error-vs-time", "laws", "growth"]) == ["laws", *speed]
    assert cli._named(["laws", "all"]) == list(cli.STUDIES)


@pytest.mark.parametrize(
    ("name", "verdict"), [("missed", "missed"), ("broken", "failed"), ("empty", "empty")]
)
def test_what_does_not_pass_is_shown_and_the_others_go_on(studies, tmp_path, capsys, name, verdict) -> None:
    bad = {"missed": missed, "broken": broken, "empty": lambda study, *, quick: None}[name]
    studies(bad=bad, good=good)
    assert cli.main(["all", "--out", str(tmp_path)]) == 1
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["passed"] is False
    assert [study["verdict"] for study in summary["studies"].values()] == [verdict, "passed"]
    page = Page((tmp_path / "index.html").read_text("utf-8"))
    assert f"✗ {verdict}" in page.text
    if name == "broken":
        assert "ZeroDivisionError: a light without <area>" in page.text
        assert "FAILED ZeroDivisionError: a light without <area>" in capsys.readouterr().out
        assert "found before" in page.text


def test_a_study_that_cannot_be_imported_is_a_failure(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cli, "STUDIES", {"gone": cli.Entry("no_such_module", "")})
    assert cli.main(["gone", "--out", str(tmp_path)]) == 1
    assert (
        "ModuleNotFoundError"
        in json.loads((tmp_path / "summary.json").read_text())["studies"]["gone"]["failure"]
    )


def test_infinite_and_undefined_figures_stay_readable(studies, tmp_path: Path) -> None:
    def odd(study: Study, *, quick: bool) -> None:
        study.at_most("undefined", float("nan"), 1)
        study.record("infinite", float("inf"))

    studies(odd=odd)
    assert cli.main(["odd", "--out", str(tmp_path)]) == 1
    found = json.loads((tmp_path / "summary.json").read_text())["studies"]["odd"]
    assert found["bounds"][0]["measured"] == "nan" and found["figures"] == {"infinite": "inf"}


@pytest.mark.parametrize("arguments", [[], ["cones"], ["all", "--quik"], ["all", "--out"]])
def test_wrong_usage(arguments: list[str], capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == UsageError.exit_code == 2
    assert "usage: mrt-validate" in capsys.readouterr().err


def test_missing_extras_are_named_with_the_command_that_brings_them(
    studies, monkeypatch, tmp_path, capsys
) -> None:
    studies(good=good)
    monkeypatch.setattr(cli, "EXTRAS", (*cli.EXTRAS, "no_such_library"))
    assert cli.main(["good", "--out", str(tmp_path / "report")]) == 1
    message = capsys.readouterr().err
    assert message.startswith("mrt-validate: no-such-library missing: ")
    assert message.endswith(" -m pip install no-such-library\n")
    assert not (tmp_path / "report").exists()


def test_folder_is_checked_before_the_work(studies, tmp_path: Path, capsys) -> None:
    ran = []
    studies(good=lambda study, *, quick: ran.append(1))
    (tmp_path / "file").write_text("")
    (tmp_path / "index.html").mkdir()
    for folder in (tmp_path / "file", tmp_path):
        assert cli.main(["good", "--out", str(folder)]) == 1
        assert str(folder) in capsys.readouterr().err
    assert not ran


def test_interrupt_leaves_the_report_as_it_was(studies, tmp_path: Path, capsys) -> None:
    def interrupted(study: Study, *, quick: bool) -> None:
        raise KeyboardInterrupt

    (tmp_path / "summary.json").write_text("before")
    studies(good=good, slow=interrupted)
    assert cli.main(["all", "--out", str(tmp_path)]) == cli.INTERRUPTED
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    assert (tmp_path / "summary.json").read_text() == "before"


def test_every_study_has_a_module_with_a_title() -> None:
    from importlib import import_module

    for entry in cli.STUDIES.values():
        module = import_module(f"mrt_mitsuba.validation.studies.{entry.module}")
        assert module.TITLE and callable(module.run)


@pytest.mark.parametrize("missed", [False, True])
def test_many_bounds_are_folded_unless_one_is_missed(studies, tmp_path: Path, missed: bool) -> None:
    def many(study: Study, *, quick: bool) -> None:
        for i in range(LONG_LIST):
            study.at_most(f"bound {i}", float(missed and i == 3), 0)

    studies(many=many)
    cli.main(["many", "--out", str(tmp_path)])
    page = Page((tmp_path / "index.html").read_text("utf-8"))
    assert page.tags.count("details") == (0 if missed else 1)
    assert page.text.count("✗ missed") == (3 if missed else 0)  # in the list, the title and the row


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.123456, "0.1235"), (np.float32(2e-5), "2e-05"), (12345678, "12345678"), ("Ag", "Ag"), (True, "yes")],
)
def test_numbers_in_tables(value: object, shown: str) -> None:
    assert cell(value) == shown
