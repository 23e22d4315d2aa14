"""The documentation's code runs: notebooks, the tutorial, and the commands of the gallery."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


def cells(path: Path, language: str) -> str:
    """All code of a page, in order."""
    return "\n".join(re.findall(rf"```{re.escape(language)}\n(.*?)```", path.read_text(), flags=re.DOTALL))


@pytest.mark.parametrize("path", sorted((DOCS / "notebooks").glob("*.md")), ids=lambda path: path.stem)
def test_notebooks_run(path, run_python):
    done = run_python(cells(path, "{code-cell}"))
    assert done.returncode == 0, done.stderr


def test_the_scene_of_the_tutorial_renders(run_python, tmp_path):
    done = run_python(cells(DOCS / "tutorial.md", "python"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "mine.png").stat().st_size > 10_000


def test_commands_of_the_gallery_are_understood(monkeypatch):
    from mrt_mitsuba import options

    monkeypatch.syspath_prepend(str(DOCS))
    entries = importlib.import_module("gallery").entries()
    assert len({entry.name for entry in entries}) == len(entries) > 12
    for entry in entries:
        command, *arguments = shlex.split(entry.command)
        assert command == "mrt" and options.parse(arguments).filename == entry.name
