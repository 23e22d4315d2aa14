"""Wheel and sdist as ``make package`` builds and tries them: what they hold, and a clean install."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("build", reason="make package installs it")
pytestmark = pytest.mark.package

ROOT = Path(__file__).parents[2]
# Folders of the checkout, and where their content lies in a wheel
FOLDERS = {
    "mrt_mitsuba": "mrt_mitsuba",
    "plugins": "mrt_mitsuba/plugins",
    "scenes_xml": "mrt_mitsuba/scenes_xml",
    "validation": "mrt_mitsuba/validation",
}
NOT_SOURCE = shutil.ignore_patterns(
    ".git", ".venv", "build", "dist", "out", "*.egg-info", "__pycache__", ".*_cache", "_build"
)


def run(*command: str | Path, cwd: Path) -> str:
    """Output of a command that must succeed, without the LLVM of the tests, make, git or a compiler."""
    environ = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
    environ["PATH"] = str(Path(sys.executable).parent)
    done = subprocess.run(
        command, cwd=cwd, env=environ, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean copy of the checkout: what an earlier build left behind would get into the next."""
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("source") / "copy", ignore=NOT_SOURCE)


@pytest.fixture(scope="module")
def dist(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An sdist, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, source, cwd=folder)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    """The files in the wheel of a folder."""
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_wheel_holds_every_file_of_the_packages(dist, source):
    names = set(content(dist))
    wanted = set()
    for folder, place in FOLDERS.items():
        files = [path for path in (source / folder).rglob("*") if path.is_file()]
        wanted |= {f"{place}/{path.relative_to(source / folder).as_posix()}" for path in files}
    assert wanted <= names
    assert {"mrt_mitsuba/py.typed", "mrt_mitsuba/scenes_xml/scene3.xml"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert all(name in wanted or ".dist-info/" in name for name in names), "nothing else"


def test_sdist_brings_what_the_tests_need(dist):
    (path,) = dist.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile", "pyproject.toml", ".ci/run"}
    assert wanted <= names
    tests = {path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("*.py")}
    assert tests <= names
    assert "docs/index.md" in names
    assert not any(name.startswith("docs/_build") for name in names)


@pytest.fixture(scope="module")
def installed(dist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a clean environment with the wheel and what it asks for, and nothing else."""
    environment = tmp_path_factory.mktemp("clean") / "venv"
    run(sys.executable, "-m", "venv", environment, cwd=dist)
    programs = environment / "bin"
    run(programs / "python", "-m", "pip", "install", "--quiet", *dist.glob("*.whl"), cwd=dist)
    return programs


def test_installed_command_renders(installed, tmp_path):
    run(installed / "mrt", "out", "3", "width=64", "height=48", cwd=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"out.png", "out.exr"}
    assert "passed" in run(installed / "mrt", "doctor", cwd=tmp_path)
    # textures from the assets, scenes from XML
    run(installed / "mrt", "demo", "7", "width=32", "height=24", "aa=1", cwd=tmp_path)
    run(installed / "mrt", "export", "0", "--xml", "a.xml", cwd=tmp_path)
    run(installed / "mrt", "mine", "scene=a.xml", "aa=1", cwd=tmp_path)


def test_installed_package_compares_with_roughconductor(installed, tmp_path):
    """What the package is used for first needs no extra; its p-value alone does."""
    code = "import mrt_mitsuba as mrt; found = mrt.compare_roughconductor(size=32, renders=4); print(found)"
    assert run(installed / "python", "-c", code, cwd=tmp_path)
