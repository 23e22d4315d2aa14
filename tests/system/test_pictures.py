"""The committed pictures are those that ``make pictures`` makes: the same names, sizes and drawing."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PIL import Image

pytest.importorskip("matplotlib")
FOLDER = Path(__file__).parents[2] / "docs" / "pictures"
MOST = 1_000_000  # bytes of all pictures, which every clone loads
NAMES = (
    "scene3.png",
    pytest.param("equal_time.png", marks=pytest.mark.slow),
    pytest.param("error_against_time.png", marks=pytest.mark.slow),
    pytest.param("check.png", marks=pytest.mark.browser),
)


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_can_be_made_anew(name, run_command, tmp_path):
    made = tmp_path / name
    run_command(sys.executable, FOLDER / "make.py", "--quick", "--out", tmp_path, made.stem)
    with Image.open(made) as new, Image.open(FOLDER / name) as committed:
        assert new.size == committed.size


def test_the_drawing_is_as_written(run_command, tmp_path):
    run_command(sys.executable, FOLDER / "make.py", "--out", tmp_path, "rooms")
    assert (tmp_path / "rooms.svg").read_text() == (FOLDER / "rooms.svg").read_text()


def test_pictures_are_those_and_small():
    committed = {path.name for path in FOLDER.iterdir() if path.suffix in (".png", ".svg")}
    assert committed == {"scene3.png", "equal_time.png", "error_against_time.png", "check.png", "rooms.svg"}
    assert sum((FOLDER / name).stat().st_size for name in committed) <= MOST
