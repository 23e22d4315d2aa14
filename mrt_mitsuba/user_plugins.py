"""Imports the user's own Mitsuba plugins: ``plugins=FILE.py`` or the name of an installed module.

A plugin's class derives from a class of the current Mitsuba variant, so each module is executed once for
each variant in which it is used, and its function ``register()``, if it has one, is called each time. A file
that changes is executed again in a new process only. The working folder is not searched: only what is named
is imported from it.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from mrt_mitsuba.errors import MrtError, UsageError, one_line

_named: list[str] = []  # modules to load in every variant, by name or absolute path
_executed: set[tuple[str, str]] = set()  # variant and name of what has been executed


def plugin_names(plugins: Any) -> list[str]:
    """Return names of modules, and absolute paths of files, given one or several.

    Raises ``UsageError`` for a file that is not there or anything that is neither.
    """
    one = isinstance(plugins, str | bytes | os.PathLike) or not isinstance(plugins, Iterable)
    names = []
    for each in [plugins] if one else plugins:
        if not isinstance(each, str | os.PathLike):
            raise UsageError(f"plugins={each!r}: give a file such as ./mine.py, or the name of a module")
        text = os.fspath(each)
        if not (os.sep in text or text.endswith(".py") or isinstance(each, os.PathLike)):
            names.append(text)
        elif not (text.endswith(".py") and os.path.isfile(text)):
            raise UsageError(f"plugins={text}: no such Python file")
        else:
            names.append(os.path.abspath(text))
    return list(dict.fromkeys(names))


def load(plugins: Any) -> None:
    """Import plugins for the current variant, if one is set, and for every variant switched to later.

    ``plugins``: a path or the name of a module, or several. Raises ``UsageError`` where there is no such file
    or module, and ``MrtError`` for one that fails.
    """
    watching = bool(_named or _executed)
    _named.extend(name for name in plugin_names(plugins) if name not in _named)
    import mitsuba as mi

    if not watching:
        mi.detail.add_variant_callback(lambda old, new: _load_all(new))
    if mi.variant():
        _load_all(mi.variant())


def digest(name: str) -> str:
    """Return a digest of a plugin's file; "" for the name of a module."""
    return hashlib.sha256(Path(name).read_bytes()).hexdigest() if os.sep in name else ""


def _load_all(variant: str) -> None:
    for name in _named:
        if (variant, name) in _executed:
            continue
        try:
            with _without_working_folder():
                module = _execute(name)
                if callable(register := getattr(module, "register", None)):
                    register()
        except (Exception, SystemExit) as error:
            _named.remove(name)
            raise _explained(name, error) from error
        _executed.add((variant, name))


def _execute(name: str) -> ModuleType:
    """Execute a module, anew if it has been executed before."""
    if os.sep not in name:
        if any(name == known for _, known in _executed):
            _forget(name)
        return importlib.import_module(name)
    alias = f"mrt_user_plugin_{Path(name).stem}_{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    _forget(alias)
    spec: Any = importlib.util.spec_from_file_location(alias, name)
    module = sys.modules[alias] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _forget(name: str) -> None:
    """Remove a module and its submodules from ``sys.modules``, so that they are executed again."""
    for each in [known for known in sys.modules if f"{known}.".startswith(f"{name}.")]:
        del sys.modules[each]


@contextlib.contextmanager
def _without_working_folder() -> Iterator[None]:
    before = sys.path[:]
    here = os.getcwd()
    sys.path[:] = [folder for folder in before if folder and os.path.abspath(folder) != here]
    try:
        yield
    finally:
        sys.path[:] = before


def _explained(name: str, error: BaseException) -> MrtError:
    """Return an error of one line: what the plugin raised, and in which line of its file."""
    if isinstance(error, ModuleNotFoundError) and error.name == name:
        return UsageError(
            f"plugins={name}: no module of this name is installed; give a path, such as ./{name}.py, for one "
            "in the working folder"
        )
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == name]
    line = getattr(error, "lineno", None) or (lines[-1] if lines else None)
    place = f"{name}, line {line}" if line else name
    return MrtError(f"plugins: {place}: {one_line(f'{type(error).__name__}: {error}')}")
