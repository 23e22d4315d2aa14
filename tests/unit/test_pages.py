"""The size of the documentation: words of each page, and columns of its code."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from mrt_mitsuba.plugins.table import PLUGINS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
COLUMNS = 78  # wider lines are cut off at the right in a browser
ALL = 16_428 + 8 * len(PLUGINS)  # words, code included; each plugin has a heading
MOST = {
    "README": 900,
    "api": 330,
    "architecture": 900,
    "blender": 300,
    "check_your_plugin": 1500,
    "command": 340,
    "error_against_time": 560,
    "extreme_cases": 280,
    "filters": 640,
    "gallery": 180,
    "habits": 800,
    "index": 420,
    "ledger": 640,
    "left_out": 300,
    "limits": 640,
    "maths": 4100,
    "models": 540,
    "analyse_exr": 250,
    "recover_alpha": 330,
    "original": 220,
    "own_plugin": 640,
    "own_scenes": 950,
    "performance": 400,
    "plugins": 210 + 30 * len(PLUGINS),
    "robustness": 490,
    "sweeps": 540,
    "tutorial": 600,
    "validation": 560,
}
PAGES = {path.stem: path for path in (ROOT / "README.md", *DOCS.glob("*.md"), *DOCS.glob("*.rst"))}
PAGES |= {path.stem: path for path in DOCS.glob("notebooks/*.md")}


def words(page: Path) -> int:
    """The words of a page, separated by blanks: text, tables, formulas and code."""
    return len(page.read_text().split())


def code_lines(text: str) -> list[str]:
    """The lines of a page's blocks of code."""
    blocks = re.findall(r"^```[^\n]*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(blocks).splitlines()


@pytest.mark.parametrize("name", sorted(PAGES))
def test_a_page_has_no_more_words_than_its_share(name) -> None:
    assert words(PAGES[name]) <= MOST[name]


def test_all_pages_together_can_be_read_in_an_hour() -> None:
    assert sum(map(words, PAGES.values())) <= ALL
    assert len(PAGES["README"].read_text().splitlines()) <= 120


@pytest.mark.parametrize("name", sorted(PAGES))
def test_code_on_pages_fits_into_a_browser(name) -> None:
    assert [line for line in code_lines(PAGES[name].read_text()) if len(line) > COLUMNS] == []


def test_code_that_pages_include_fits_too() -> None:
    included = [
        path for path in DOCS.rglob("examples/**/*") if path.suffix in (".py", ".xml", ".obj", ".mtl")
    ]
    assert included
    for path in included:
        assert [line for line in path.read_text().splitlines() if len(line) > COLUMNS] == [], path


def test_what_the_page_of_the_api_names_is_there() -> None:
    """A name that moved would only be noticed when the site is built."""
    names = re.findall(r"auto(?:class|function):: ([\w.]+)\.(\w+)", (DOCS / "api.rst").read_text())
    assert len(names) > 20
    for module, name in names:
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"
