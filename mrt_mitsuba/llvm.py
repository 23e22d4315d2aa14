"""Chooses the LLVM library that Dr.Jit compiles its kernels with.

The rule: the library that ``DRJIT_LIBLLVM_PATH`` names, else the one from the package karellen-llvm-core,
else the newest of the system, each only from LLVM 17 on: with an older one Dr.Jit aborts the whole process at
the first kernel with a minimum, maximum or clip in it. Without such a library, the variable is set to a path
that does not exist, so that Dr.Jit reports a missing library and never picks up an old one by itself.

Dr.Jit loads the library when it is first imported, so the choice is made by ``import mrt_mitsuba``. It takes
a few milliseconds and loads nothing: versions are read from file names. On other systems than Linux, Dr.Jit
looks for a library itself (on macOS where Homebrew installs it), unless the variable names one.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from mrt_mitsuba.errors import MrtWarning

VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST = 17
WHEEL = "karellen-llvm-core"
BLOCKED = "/LLVM-17-or-newer-is-needed/try-pip-install-karellen-llvm-core"
HELP = (
    f"Get one with 'pip install {WHEEL}' (Linux x86-64), with 'apt install libllvm19' or the like, "
    f"or set {VARIABLE} to a libLLVM of version {OLDEST} or newer."
)

Version = tuple[int, ...]


class Choice(NamedTuple):
    """The chosen library, and where it is from; ``refused``: why the user's own is not taken, "" if it is."""

    path: str | None
    version: Version | None
    source: str
    refused: str

    def describe(self) -> str:
        """Return the choice in one sentence."""
        if self.version is None:
            return f"no usable LLVM {OLDEST} or newer was found. {HELP}"
        return f"LLVM {'.'.join(map(str, self.version))}, {self.source}: {self.path}"


def choose(environ: Mapping[str, str], search_path: Iterable[str], system: Iterable[str]) -> Choice:
    """Return the library chosen by the rule above; changes nothing.

    ``search_path``: folders that may hold installed packages; ``system``: folders to search for a system
    library.
    """
    wheel = wheel_library(search_path)
    named = environ.get(VARIABLE, "")
    if named in (BLOCKED, wheel):
        named = ""  # not the user's choice
    newest = max(_matching(system, "libLLVM"), key=lambda path: version_of(path) or (), default="")
    places = (
        (named, f"named by {VARIABLE}"),
        (wheel, f"from the package {WHEEL}"),
        (newest, "of the system"),
    )
    refused = ""
    for path, source in places:
        version = version_of(path)
        if version and version[0] >= OLDEST:
            return Choice(path, version, source, refused)
        if named and path == named:
            refused = (
                f"{named}, named by {VARIABLE}, is no file of LLVM {OLDEST} or newer, such as libLLVM.so.19.1"
            )
    return Choice(None, None, "none", refused)


def wheel_library(search_path: Iterable[str]) -> str:
    """Return the library of the package karellen-llvm-core, or "".

    It lies two folders above the package's metadata, in the environment's ``lib``.
    """
    for info in _matching(search_path, WHEEL.replace("-", "_") + "-"):
        for path in _matching([os.path.normpath(f"{info}/../../..")], "libLLVM.so."):
            return path
    return ""


def system_folders(environ: Mapping[str, str]) -> list[str]:
    """Return the folders in which a Linux system keeps libLLVM; none on other systems."""
    if sys.platform != "linux":
        return []
    return [
        *filter(None, environ.get("LD_LIBRARY_PATH", "").split(":")),
        f"{sys.prefix}/lib",  # conda
        "/usr/local/lib",
        f"/usr/lib/{os.uname().machine}-linux-gnu",
        "/usr/lib64",
        "/usr/lib",
        *(f"{folder}/lib" for folder in _matching(["/usr/lib"], "llvm")),
    ]


def _matching(folders: Iterable[str], prefix: str) -> Iterator[str]:
    """Yield the paths in folders whose names begin with a prefix; folders that cannot be read have none."""
    for folder in folders:
        with contextlib.suppress(OSError):
            names = sorted(os.listdir(folder or "."))
            yield from (os.path.join(folder, name) for name in names if name.startswith(prefix))


def version_of(library: str) -> Version | None:
    """Return the version in the name of a library: (19, 1) of libLLVM.so.19.1, (17,) of libLLVM-17.so.1.

    Symbolic links are followed. None for a file that is not there, or whose name has no version.
    """
    path = os.path.realpath(library)
    name = re.fullmatch(r"libLLVM(?:-(\d+(?:\.\d+)*))?\.so(?:\.(\d+(?:\.\d+)*))?", os.path.basename(path))
    numbers = name and (name[1] or name[2])
    return tuple(map(int, numbers.split("."))) if numbers and os.path.isfile(path) else None


@functools.cache
def prepare() -> Choice:
    """Choose once per process and set Dr.Jit's environment variable; return the choice.

    Warns if the user's own setting is not followed, or if Dr.Jit was imported before the choice.
    """
    choice = choose(os.environ, sys.path, system_folders(os.environ))
    if choice.path or sys.platform == "linux":
        os.environ[VARIABLE] = choice.path or BLOCKED
    text = None
    if "drjit" in sys.modules and choice.path:
        text = problem(choice)
    elif choice.refused:
        text = f"{choice.refused}. Instead: {choice.describe()}"
    if text:
        warnings.warn(text, MrtWarning, stacklevel=2)
    return choice


def problem(choice: Choice) -> str | None:
    """Return what keeps Dr.Jit from using LLVM, with the fix, or None."""
    if choice.path is None and sys.platform == "linux":
        return choice.describe()
    import drjit as dr

    loaded = dr.detail.llvm_version()[0]
    if loaded >= OLDEST:
        return None
    library = f"LLVM {loaded}, with which it would abort," if loaded > 0 else "no LLVM"
    wanted = (
        f" in place of {choice.path}. Import mrt_mitsuba before mitsuba and drjit, or" if choice.path else ":"
    )
    return f"Dr.Jit loaded {library}{wanted} set {VARIABLE} to a libLLVM of version {OLDEST} or newer."
