"""The package as installed: its folders, its lazy names, what an import costs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import mrt_mitsuba
from mrt_mitsuba.command.tools import read_toml

ROOT = Path(__file__).parents[2]


def test_every_package_is_listed():
    """pyproject.toml lists them by hand; a folder that it lacks would be missing from the wheel."""
    settings = read_toml(ROOT / "pyproject.toml")["tool"]["setuptools"]
    places = settings["package-dir"]
    found = set()
    for package, folder in places.items():
        for init in (ROOT / folder).rglob("__init__.py"):
            found.add(".".join([package, *init.parent.relative_to(ROOT / folder).parts]))
    assert found == set(settings["packages"]), "packages of [tool.setuptools] in pyproject.toml"


def test_checkout_works_without_installation(run_python):
    """The installed package is a copy elsewhere, Python is started in the checkout, and no module is two."""
    code = """
import sys
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in getattr(finder, "__module__", "")]
sys.path.insert(0, sys.argv[1])
import importlib, mrt_mitsuba
for name in ("plugins", "validation", "scenes_xml"):
    print(importlib.import_module(f"mrt_mitsuba.{name}").__file__)
mrt_mitsuba.register()
import mrt_mitsuba.rendering.api, mrt_mitsuba.sweeps.run, mrt_mitsuba.validation.cli
assert not {"plugins", "validation", "scenes_xml", "filters"} & set(sys.modules)
"""
    files = [str(ROOT / name / "__init__.py") for name in ("plugins", "validation", "scenes_xml")]
    assert run_python(code, str(ROOT)).stdout.splitlines() == files


HEAVY = "drjit mitsuba numpy OpenEXR PIL tqdm matplotlib scipy"
WRONG = "from mrt_mitsuba.command import main as cli; assert cli.main(['out', 'width=0']) == 2"


@pytest.mark.parametrize(
    ("code", "more"), [("import mrt_mitsuba", " importlib.metadata dataclasses"), (WRONG, "")]
)
def test_import_and_wrong_usage_load_nothing_heavy(run_python, code, more):
    """They start neither Mitsuba nor anything that takes as long."""
    found = f"print([name for name in {(HEAVY + more).split()} if name in set(sys.modules) - before])"
    start = "import re, sys; before = set(sys.modules)"
    assert run_python("\n".join((start, code, found))).stdout == "[]\n"


def test_no_function_has_the_name_of_a_module():
    """Which would take its place when the module is imported."""
    modules = {path.stem for path in Path(mrt_mitsuba.__file__).parent.iterdir()}
    assert modules & set(mrt_mitsuba.__all__) == {"filters"}


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = mrt_mitsuba.no_such_name
    assert {"render", "scene_dict", "filters", "__version__"} <= set(dir(mrt_mitsuba))


@pytest.mark.parametrize(
    ("name", "pattern"), [("CITATION.cff", r"^version: (.+)$"), ("CHANGELOG.md", r"^## (\S+)")]
)
def test_version_is_told_everywhere(name, pattern):
    """The package holds the version; the citation repeats it, the changelog may be ahead of it."""
    dated = re.findall(pattern, (ROOT / name).read_text(), re.MULTILINE)
    assert dated[0] in (mrt_mitsuba.__version__, "Unreleased")
