"""The rule by which the LLVM library is chosen, on folders made for the purpose, and its effect on Dr.Jit."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mrt_mitsuba import llvm

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the search is for Linux only")


def library(folder: Path, name: str) -> str:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).touch()
    return str(folder / name)


def wheel(prefix: Path, name: str = "libLLVM.so.23.1") -> tuple[str, str]:
    """Lay out an installed karellen-llvm-core; return its site-packages and its library."""
    path = library(prefix / "lib", name)
    info = prefix / "lib" / "python3" / "site-packages" / "karellen_llvm_core-23.1.4.dist-info"
    info.mkdir(parents=True)
    lines = ["../../libLLVM.so,,", "../../libLTO.so.23.1,sha256=x,6", f"../../{name},sha256=y,8"]
    (info / "RECORD").write_text("\n".join(lines) + "\n")
    return str(info.parent), path


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so", (15,)),
        ("libLLVM-15.so.1", (15,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM.so.19.1", (19, 1)),
        ("/some/where/libLLVM.so.23.1", (23, 1)),
        ("libLLVM.so", None),
        ("libLLVM-17git.so", None),
        ("libclang-19.so", None),
    ],
)
def test_version_in_name(name: str, version: tuple[int, ...] | None) -> None:
    assert llvm.version_in_name(name) == version


@linux
def test_user_path_wins(tmp_path: Path) -> None:
    site, _ = wheel(tmp_path / "venv")
    mine = library(tmp_path / "mine", "libLLVM.so.18.1")
    choice = llvm.choose({llvm.VARIABLE: mine}, [site], [])
    assert (choice.path, choice.version, choice.source, choice.rejected) == (mine, (18, 1), "user", ())


@linux
def test_wheel_before_newer_system_library(tmp_path: Path) -> None:
    site, path = wheel(tmp_path / "venv")
    library(tmp_path / "system", "libLLVM-99.so.1")
    choice = llvm.choose({}, [site], [str(tmp_path / "system")])
    assert (choice.path, choice.source) == (path, "wheel")
    assert choice.describe().startswith("LLVM 23.1, from the package karellen-llvm-core")


@linux
def test_newest_system_library(tmp_path: Path) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM-9.so.1", "libLLVM.so.20.1", "libLLVM.so.19.1"):
        library(tmp_path, name)
    choice = llvm.choose({}, [], [str(tmp_path)])
    assert choice.path == str(tmp_path / "libLLVM.so.20.1")  # as numbers: 9 is not newer than 20
    assert choice.source == "system" and len(choice.rejected) == 2


@linux
@pytest.mark.parametrize("name", ["libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1"])
def test_older_than_17_is_never_chosen(tmp_path: Path, name: str) -> None:
    old = library(tmp_path / "system", name)
    site, _ = wheel(tmp_path / "venv", name="libLLVM.so.16.0")
    choice = llvm.choose({llvm.VARIABLE: old}, [site], [str(tmp_path / "system")])
    assert (choice.path, choice.source, choice.usable) == (None, "none", False)
    assert "pip install karellen-llvm-core" in choice.describe()
    assert len(choice.rejected) == 3


@linux
@pytest.mark.parametrize("named", ["/no/such/libLLVM.so.19.1", "/usr", "libLLVM-99-nowhere.so"])
def test_unusable_user_path_falls_through(tmp_path: Path, named: str) -> None:
    site, path = wheel(tmp_path / "venv")
    choice = llvm.choose({llvm.VARIABLE: named}, [site], [])
    assert (choice.path, choice.source) == (path, "wheel")
    assert choice.rejected == (f"{llvm.VARIABLE}={named} cannot be loaded",)


@linux
def test_broken_metadata_and_folders_are_passed_over(tmp_path: Path) -> None:
    site, path = wheel(tmp_path / "venv")
    (tmp_path / "a" / "karellen_llvm_core-1.dist-info").mkdir(parents=True)
    (tmp_path / "b" / "karellen_llvm_core-1.dist-info").mkdir(parents=True)
    (tmp_path / "b" / "karellen_llvm_core-1.dist-info" / "RECORD").write_bytes(b"\xff\xfe/libLLVM.so.1")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert llvm.wheel_library([str(tmp_path / n) for n in ("a", "b", "none", "loop")] + [site]) == (
        path,
        None,
    )
    assert llvm.choose({llvm.VARIABLE: str(loop)}, [site], []).path == path


@linux
def test_unfinished_installation_is_not_used(tmp_path: Path) -> None:
    """So it is after the superuser installed, until Python first starts with the right to write there."""
    site, path = wheel(tmp_path / "venv")
    info = next(Path(site).iterdir())
    (info / "symlinks.txt").touch()
    for environ in ({}, {llvm.VARIABLE: path}):
        choice = llvm.choose(environ, [site], [str(Path(path).parent)])
        assert choice.source == "none" and "is unfinished: whoever may write" in choice.describe()
    (info / "axle.done").touch()
    assert llvm.choose({}, [site], []).path == path


@linux
def test_inherited_choice_is_not_taken_for_the_users(tmp_path: Path) -> None:
    site, path = wheel(tmp_path / "venv")
    assert llvm.choose({llvm.VARIABLE: path}, [site], []).source == "wheel"
    assert llvm.choose({llvm.VARIABLE: llvm.BLOCKED}, [], []).rejected == ()


@linux
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize(("version", "chosen"), [((18, 1, 8), True), ((16, 0, 6), False), (None, False)])
def test_library_without_version_in_its_name_is_asked(
    tmp_path: Path, version: tuple[int, ...] | None, chosen: bool
) -> None:
    source = "void LLVMContextCreate(void) {}\n"
    if version:  # LLVMGetVersion came with LLVM 16
        assignments = "".join(f"*{name} = {number};" for name, number in zip("abc", version, strict=True))
        source += f"void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c) {{ {assignments} }}\n"
    (tmp_path / "llvm.c").write_text(source)
    mine = tmp_path / "libLLVM.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", mine, tmp_path / "llvm.c"], check=True, timeout=60)
    choice = llvm.choose({llvm.VARIABLE: str(mine)}, [], [])
    assert (choice.path == str(mine)) is chosen
    if chosen:
        assert choice.version == version
    else:
        assert "is LLVM 16.0.6" in choice.rejected[0] or "is LLVM older than 16" in choice.rejected[0]


HIDE = """
import os
def without(names, listed=os.listdir):
    return lambda folder=".": [n for n in listed(folder) if not n.startswith(names)]
os.listdir = without(("karellen", "libLLVM"))
"""


@linux
def test_without_llvm_the_scalar_variant_with_one_warning(run_python) -> None:
    code = """
import warnings, mrt_mitsuba.plugins
from mrt_mitsuba import llvm, runtime
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    print(runtime.use(), runtime.use(), len(caught), caught[0].message)
print("libLLVM" in open("/proc/self/maps").read())
try:
    runtime.use("llvm_ad_rgb")
except mrt_mitsuba.VariantError as error:
    print(error)
"""
    done = run_python(HIDE + code)
    assert done.returncode == 0, done.stderr
    first, loaded, refused = done.stdout.splitlines()
    assert first.startswith(
        "scalar_rgb scalar_rgb 1 rendering in the slow variant scalar_rgb: no usable LLVM 17"
    )
    assert "pip install karellen-llvm-core" in first and "pip install karellen-llvm-core" in refused
    assert loaded == "False"


@linux
def test_old_library_named_by_the_user_is_refused_with_a_warning(run_python, tmp_path: Path) -> None:
    old = library(tmp_path, "libLLVM-15.so.1")
    done = run_python(
        "import mrt_mitsuba, os; print(os.environ['DRJIT_LIBLLVM_PATH'])", DRJIT_LIBLLVM_PATH=old
    )
    assert done.returncode == 0 and old not in done.stdout
    assert f"{llvm.VARIABLE}={old} is LLVM 15" in done.stderr


def test_importing_drjit_too_early_warns(run_python) -> None:
    code = """
import drjit, mrt_mitsuba
from mrt_mitsuba import runtime
try:
    runtime.use("llvm_ad_rgb")
except mrt_mitsuba.VariantError as error:
    print(error)
"""
    done = run_python(code, DRJIT_LIBLLVM_PATH=llvm.BLOCKED)
    assert done.returncode == 0, done.stderr
    assert "Import mrt_mitsuba before mitsuba and drjit" in done.stdout
    assert "Import mrt_mitsuba before mitsuba and drjit" in done.stderr
