"""Mitsuba plugins in Dr.Jit, and the maths they share.

``register()`` makes the plugins of ``table.PLUGINS``, or those of other packages, known to Mitsuba. Their
modules are imported when a scene first has one.
"""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .table import PLUGINS, Plugin

if TYPE_CHECKING:
    import mitsuba as mi

_known: dict[str, Plugin] = {}  # what is registered in each variant that is switched to
_registered: set[tuple[str, str]] = set()  # pairs of a variant and a plugin's name
_loaded: dict[tuple[str, str, str], ModuleType] = {}  # by variant, package and name
_loading = threading.RLock()  # Mitsuba's parallel loader constructs plugins in several threads


def register(plugins: Iterable[Plugin] = PLUGINS) -> None:
    """Register plugins in the current Mitsuba variant and in every one that is switched to later.

    Each module is imported when a scene first has its plugin, once for each variant; its class derives from
    one of Mitsuba's. Idempotent. Raises ``RuntimeError`` where no variant is set.
    """
    import mitsuba as mi

    if mi.variant() is None:
        raise RuntimeError(
            "no Mitsuba variant is set: call mitsuba.set_variant(...) before registering plugins"
        )
    watching = bool(_known)
    _known.update((row.name, row) for row in plugins)
    _register_known()
    if not watching:
        mi.detail.add_variant_callback(lambda old, new: _register_known())


def plugin(name: str, package: str = __name__) -> ModuleType:
    """Return the module ``name`` (e.g. "light") for the current variant, to which its classes belong.

    It is executed once for each variant, as its classes derive from Mitsuba's, and each variant has its own.
    Each copy gets a module name of its own; relative imports still resolve, because the package is the
    same.
    """
    import mitsuba as mi

    key = mi.variant(), package, name
    with _loading:
        if key not in _loaded:
            source = importlib.util.find_spec(f"{package}.{name}")
            origin = source.origin if source else None
            spec = importlib.util.spec_from_file_location(f"{package}.{name}_{key[0]}", origin)
            assert spec and spec.loader, f"{package} has no module {name}"
            module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            _loaded[key] = module
        return _loaded[key]


def class_of(row: Plugin) -> type:
    """Return the class of a plugin for the current variant."""
    return getattr(plugin(row.module, row.package), row.class_name)


def classes_of(which: str) -> tuple[Any, ...]:
    """Return the classes of a plugin, or of those in a table of the kernels, for the current variant.

    Those whose modules no scene has needed yet are left out: nothing can be an object of theirs.
    """
    import mitsuba as mi

    rows = (row for row in PLUGINS if which in (row.name, row.table))
    return tuple(class_of(row) for row in rows if (mi.variant(), row.package, row.module) in _loaded)


def is_known(thing: object) -> bool:
    """True if Mitsuba or this folder has the class of an object, so that all its state is in sight.

    What somebody else wrote in Python may depend on anything, and is asked each time.
    """
    module = type(thing).__module__
    return module.split(".", 1)[0] == "mitsuba" or module.startswith(f"{__name__}.")


def any_loaded() -> bool:
    """True if this process has ever needed a module of a plugin: without one, there is none in any scene."""
    return bool(_loaded)


def _register_known() -> None:
    import mitsuba as mi

    for row in _known.values():
        if (mi.variant(), row.name) not in _registered:
            getattr(mi, f"register_{row.kind}")(row.name, _factory(row))
            _registered.add((mi.variant(), row.name))


def _factory(row: Plugin) -> Callable[[mi.Properties], Any]:
    return lambda props: class_of(row)(props)
