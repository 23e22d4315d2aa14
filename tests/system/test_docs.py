"""The documentation's code runs: pages, commands and the worked example."""

from __future__ import annotations

import pkgutil
import re
import shlex
import shutil
import sys
from pathlib import Path

import forked
import pytest
from cases import but_slow

from mrt_mitsuba import plugins, render
from mrt_mitsuba.command import main, options, registry
from mrt_mitsuba.files.images import read_exr
from mrt_mitsuba.validation import cli

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("notebooks/*.md")])


def blocks(path: Path, language: str) -> list[str]:
    """The code blocks of a page in a language, in order."""
    return re.findall(rf"```{re.escape(language)}\n(.*?)```", path.read_text(), flags=re.DOTALL)


# Before the code of a page: its pictures at a smaller size, its plots of few renders
PREPARED = f"""
import pages
pages.ORIGINALS = {str(DOCS.parent / "tests" / "regression" / "data")!r}
pages.SIZE.update(width=80, height=60)
pages.QUICK = True
"""


# What building the site takes in full, and its test with a twentieth of the rays, fewer repeats or pixels
QUICKER = {
    "target=0.01)": "target=0.05)",
    "repeats=5,": "repeats=2,",
    '"spp": 1024': '"spp": 256',
    "mi.cornell_box()": "smaller(mi.cornell_box())",
    "(256, 256, 5)": "(64, 64, 5)",
    '"resx": 320, "resy": 180': '"resx": 80, "resy": 45',
    '"sample_visible": False})': '"sample_visible": False}, quick=True)',
    "height=48)": "height=48, workers=1)",
    "height=120)": "height=120, workers=1)",
}
SMALLER = """
def smaller(box):
    box["sensor"]["film"] |= {"width": 64, "height": 64}
    return box
"""


def quick(text: str) -> str:
    """Code of a page made quick."""
    for amount, fewer in QUICKER.items():
        text = text.replace(amount, fewer)
    prepared = PREPARED if re.search("from pages import|import answers", text) else ""
    return SMALLER + prepared + text


def code(path: Path) -> str:
    """All Python of a page, cells that are run and what is only shown, made quick."""
    text = "\n".join(blocks(path, "{code-cell}") + blocks(path, "python"))
    text = re.sub(r"^:tags:.*$", "", text, flags=re.MULTILINE)
    return quick(text) if text else ""


@pytest.fixture
def examples(tmp_path: Path) -> Path:
    """The folder of examples, as pages find it: next to them."""
    return Path(shutil.copytree(DOCS / "examples", tmp_path / "examples"))


README = DOCS.parent / "README.md"
README_COMMANDS = re.findall(r"^mrt ([^#\n]*)", "".join(blocks(README, "sh")), flags=re.MULTILINE)


@pytest.mark.parametrize("words", README_COMMANDS)
def test_commands_of_the_readme_run(words, mrt_command):
    mrt_command(*shlex.split(words))


EXAMPLES = [(example.splitlines()[0], quick(example)) for example in blocks(README, "python")]


@pytest.mark.parametrize("text", [text for _, text in EXAMPLES], ids=[name for name, _ in EXAMPLES])
def test_examples_of_the_readme_run(text, run_python):
    run_python(text)


CODES = {path.stem: code(path) for path in PAGES if code(path)}


# Studies and others whose parts have tests of their own
SLOW = {
    "error_against_time",
    "extreme_cases",
    "left_out",
    "sweeps",
    "ledger",
    "gallery",
    "filters",
    "blender",
}


@pytest.mark.parametrize("name", but_slow(CODES, SLOW))
def test_pages_run(name, examples):
    forked.run(CODES[name], examples)
    if name == "tutorial":  # whose scene is the file's, but for the rounding of its camera's matrix
        written = read_exr(examples.parent / "mine.exr").image
        same = render(examples / "mine.xml", aa=3, aamode="sobel", focaldist=4.5, focalrange=0.5).image
        assert written.shape == (300, 400, 3)
        assert abs(written - same).mean() < 1e-6


@pytest.mark.slow
def test_the_worked_example_passes_its_tests(run_command, examples):
    words = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", examples)
    done = run_command(sys.executable, *words, examples / "test_matte.py", PYTEST_ADDOPTS=None)
    assert " passed" in done.stdout
    assert "skipped" not in done.stdout


COMMANDS = [
    (path, line.split(" #")[0].strip())
    for path in PAGES
    for block in blocks(path, "sh")
    for line in block.splitlines()
    if line.startswith("mrt")
]


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=lambda value: getattr(value, "stem", value))
def test_commands_of_the_pages_are_understood(path, command):
    name, *arguments = shlex.split(command)
    if name == "mrt-validate":
        assert set(arguments) <= {*cli.STUDIES, "all", "--quick", "--list"}
        return
    if arguments[0] in registry.COMMANDS:
        return  # tried by tests of its own
    parsed = options.parse(arguments)
    assert name == "mrt"
    assert all((DOCS / path).is_file() for path in parsed.inputs())


def test_the_memory_that_a_picture_would_need_is_as_shown(capsys):
    page = (DOCS / "performance.md").read_text()
    command = next(block for block in blocks(DOCS / "performance.md", "sh") if "memory=" in block)
    assert main.main([*shlex.split(command)[1:], "quiet=1"]) == 2

    def without_figures(text: str) -> str:  # which change with what a render keeps
        return re.sub(r"\d+\.\d", "N", " ".join(text.split()))

    assert without_figures(capsys.readouterr().err) in without_figures(page)


def test_every_study_and_every_plugin_is_explained():
    explained = re.findall(r"^\| `([\w-]+)` \|", (DOCS / "validation.md").read_text(), flags=re.MULTILINE)
    assert sorted(explained) == sorted(cli.STUDIES)
    named = re.findall(r"mrt_mitsuba\.plugins\.([\w.]+)\.\w+", (DOCS / "plugins.rst").read_text())
    assert set(named) == {row.module for row in plugins.PLUGINS}


TEXTS = [*PAGES, *sorted(DOCS.glob("*.rst")), README, README.with_name("CONTRIBUTING.md")]


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_what_a_page_names_is_there(page, variant):
    text = page.read_text()
    root = README.parent
    for name in re.findall(r"mrt_mitsuba(?:\.\w+)+", text):
        assert pkgutil.resolve_name(name)
    for path in re.findall(r"`((?:\w+/)+\w+\.py)`", text):
        folders = (root / folder for folder in ("", "docs", "mrt_mitsuba", "validation"))
        assert "NAME" in path or any((folder / path).is_file() for folder in folders), path
