"""Plugins of the user's own, by path or by name, in every variant."""

from __future__ import annotations

import sys
from pathlib import Path

import mitsuba as mi
import pytest

from mrt_mitsuba import user_plugins
from mrt_mitsuba.errors import MrtError, UsageError

COUNT = "with open('log', 'a') as log:\n    print(__file__, file=log)\n"
SHINY = """
import mitsuba as mi
class Shiny(mi.BSDF):
    def __init__(self, props):
        mi.BSDF.__init__(self, props)
    def to_string(self):
        return "Shiny[{}]"
mi.register_bsdf("{}", Shiny)
"""


@pytest.fixture(autouse=True)
def apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(user_plugins, "_named", [])
    monkeypatch.chdir(tmp_path)


def made(kind: str) -> str:
    return str(mi.load_dict({"type": kind}))


def test_a_file_is_registered_in_each_variant_and_once_in_each(variant, tmp_path):
    (tmp_path / "numpy.py").write_text(SHINY.format(1, "shiny_file") + COUNT)
    numpy = sys.modules["numpy"]
    for _ in range(2):
        user_plugins.load("numpy.py")
    before = mi.variant()
    try:
        for other in ("scalar_rgb", "llvm_ad_mono", before):
            mi.set_variant(other)
            assert made("shiny_file") == "Shiny[1]"
    finally:
        mi.set_variant(before)
    assert len((tmp_path / "log").read_text().splitlines()) == len({"scalar_rgb", "llvm_ad_mono", before})
    assert sys.modules["numpy"] is numpy


def test_modules_by_name(variant, tmp_path, monkeypatch):
    """With relative imports, and with a function ``register`` of their own."""
    (tmp_path / "installed" / "pack").mkdir(parents=True)
    (tmp_path / "installed" / "pack" / "inner.py").write_text(SHINY.format(3, "shiny_installed"))
    (tmp_path / "installed" / "pack" / "__init__.py").write_text("def register():\n    from . import inner\n")
    monkeypatch.syspath_prepend(str(tmp_path / "installed"))
    user_plugins.load("pack")
    before = mi.variant()
    try:
        for other in ("llvm_ad_mono", before):
            mi.set_variant(other)
            assert made("shiny_installed") == "Shiny[3]"
    finally:
        mi.set_variant(before)


@pytest.mark.parametrize(
    ("given", "kind", "says"),
    [
        ("none.py", UsageError, "plugins=none.py: no such Python file"),
        ("folder/", UsageError, "plugins=folder/: no such Python file"),
        (3, UsageError, "plugins=3: give a file"),
        ("here", UsageError, "no module of this name is installed; give a path, such as ./here.py"),
        ("./raises.py", MrtError, r"raises.py, line 2: ValueError: bad news$"),
        ("./leaves.py", MrtError, "leaves.py, line 1: SystemExit"),
        ("./syntax.py", MrtError, "syntax.py, line 2: SyntaxError"),
        ("./imports.py", MrtError, "imports.py, line 1: ModuleNotFoundError: No module named 'here'"),
    ],
)
def test_what_cannot_be_imported_is_refused_in_one_line(variant, tmp_path, given, kind, says):
    files = {"here": "", "raises": "\nraise ValueError('bad\\nnews')", "leaves": "raise SystemExit(3)"}
    for name, text in {**files, "syntax": "\n)", "imports": "import here"}.items():
        (tmp_path / f"{name}.py").write_text(text)
    with pytest.raises(kind, match=says) as caught:
        user_plugins.load(given)
    assert "\n" not in str(caught.value)
    mi.set_variant("llvm_ad_mono")  # a plugin that failed does not fail again
    mi.set_variant(variant)
