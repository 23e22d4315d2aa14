"""The rule by which the LLVM library is chosen, on folders made for the purpose, and its effect on Dr.Jit."""

from __future__ import annotations

from pathlib import Path

import pytest
from cases import Cases

from mrt_mitsuba import llvm


def library(folder: Path, name: str) -> str:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).touch()
    return str(folder / name)


def wheel(prefix: Path, name: str = "libLLVM.so.23.1") -> tuple[str, str]:
    """Lay out an installed karellen-llvm-core; return its site-packages and its library."""
    path = library(prefix / "lib", name)
    info = prefix / "lib" / "python3" / "site-packages" / "karellen_llvm_core-23.1.4.dist-info"
    info.mkdir(parents=True)
    return str(info.parent), path


# What DRJIT_LIBLLVM_PATH names, the wheel's library, those of the system, the choice; names of files, "" for
# none
choices = Cases()
choices("libLLVM.so.18.1", "libLLVM.so.23.1", "libLLVM-99.so.1", "libLLVM.so.18.1")
choices("", "libLLVM.so.23.1", "libLLVM-99.so.1", "libLLVM.so.23.1")
choices("", "", "libLLVM-15.so.1 libLLVM-9.so.1 libLLVM.so.20.1 libLLVM.so.19.1", "libLLVM.so.20.1")
for v in (14, 15, 16):
    choices("libLLVM-16.so.1", "libLLVM.so.16.0", f"libLLVM-{v}.so.1", "")
choices("", "", "libLLVM-17.so.1", "libLLVM-17.so.1")
choices("", "libLLVM.so.16.0", "libLLVM-17.so.1", "libLLVM-17.so.1")
choices("", "", "libLLVM-18.1.8.so.1 libLLVM-20git.so libclang-21.so", "libLLVM-18.1.8.so.1")


@pytest.mark.parametrize(("named", "packed", "system", "chosen"), choices)
def test_the_rule(tmp_path, named, packed, system, chosen):
    environ = {llvm.VARIABLE: library(tmp_path / "mine", named)} if named else {}
    site = [wheel(tmp_path / "venv", packed)[0]] if packed else []
    for name in system.split():
        library(tmp_path / "system", name)
    choice = llvm.choose(environ, site, [str(tmp_path / "system")])
    assert (Path(choice.path).name if choice.path else "") == chosen
    assert choice.version == (llvm.version_of(choice.path) if chosen else None)
    assert bool(choice.refused) is (bool(named) and named != chosen)
    assert ("pip install karellen-llvm-core" in choice.describe()) is not bool(chosen)


@pytest.mark.parametrize("named", ["/no/such/libLLVM.so.19.1", "/usr", "libLLVM-99-nowhere.so"])
def test_unusable_user_path_falls_through(tmp_path, named):
    site, path = wheel(tmp_path / "venv")
    choice = llvm.choose({llvm.VARIABLE: named}, [site], [])
    assert choice.path == path
    assert choice.refused.startswith(f"{named}, named by {llvm.VARIABLE}, is no file of LLVM 17 or newer")
    assert choice.describe().startswith("LLVM 23.1, from the package karellen-llvm-core")


def test_folders_without_a_library_are_passed_over(tmp_path):
    site, path = wheel(tmp_path / "venv")
    for name in "ab":
        (tmp_path / name / "karellen_llvm_core-1.dist-info").mkdir(parents=True)
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    places = [*(str(tmp_path / name) for name in ("a", "b", "none", "loop")), site]
    assert llvm.choose({llvm.VARIABLE: str(loop)}, places, []).path == path


def test_other_systems_are_left_to_drjit(monkeypatch):
    """Where Dr.Jit looks by itself, nothing is blocked: the variable stays as it was."""
    monkeypatch.setattr(llvm.sys, "platform", "darwin")
    monkeypatch.setattr(llvm.sys, "path", [])
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    choice = llvm.prepare.__wrapped__()
    assert choice.path is None
    assert llvm.VARIABLE not in llvm.os.environ
    assert llvm.problem(choice) is None  # of the LLVM that Dr.Jit has loaded


def test_inherited_choice_is_not_taken_for_the_users(tmp_path):
    site, path = wheel(tmp_path / "venv")
    assert llvm.choose({llvm.VARIABLE: path}, [site], []).source == f"from the package {llvm.WHEEL}"
    assert llvm.choose({llvm.VARIABLE: llvm.BLOCKED}, [], []).refused == ""


HIDE = """
import os
def without(names, listed=os.listdir):
    return lambda folder=".": [n for n in listed(folder) if not n.startswith(names)]
os.listdir = without(("karellen", "libLLVM"))
"""


def test_without_llvm_the_scalar_variant_with_one_warning(run_python):
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
    first, loaded, refused = run_python(HIDE + code).stdout.splitlines()
    assert first.startswith("scalar_rgb scalar_rgb 1 rendering in the slow variant scalar_rgb: ")
    assert "no usable LLVM 17" in first
    assert loaded == "False"
    assert all("pip install karellen-llvm-core" in text for text in (first, refused))


def test_old_library_named_by_the_user_is_refused_with_a_warning(run_python, tmp_path):
    old = library(tmp_path, "libLLVM-15.so.1")
    code = "import mrt_mitsuba, os; print(os.environ['DRJIT_LIBLLVM_PATH'])"
    done = run_python(code, DRJIT_LIBLLVM_PATH=old)
    assert old not in done.stdout
    assert f"{old}, named by {llvm.VARIABLE}, is no file of LLVM 17" in done.stderr


def test_importing_drjit_too_early_warns(run_python):
    code = """
import drjit, mrt_mitsuba
from mrt_mitsuba import runtime
try:
    runtime.use("llvm_ad_rgb")
except mrt_mitsuba.VariantError as error:
    print(error)
"""
    done = run_python(code, DRJIT_LIBLLVM_PATH=llvm.BLOCKED)
    for text in (done.stdout, done.stderr):
        assert "Import mrt_mitsuba before mitsuba and drjit" in text
