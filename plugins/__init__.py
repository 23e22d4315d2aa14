"""Mitsuba plugins in Dr.Jit, and the maths they share.

``register()`` makes the plugins of ``table.PLUGINS`` known to Mitsuba; ``register_modules()`` does the same
for plugins of other packages.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .table import PLUGINS, Plugin

if TYPE_CHECKING:
    import mitsuba as mi

_packages: dict[str, tuple[str, ...]] = {}  # the plugin modules of each package
_loaded: dict[tuple[str, str, str], ModuleType] = {}  # by variant, package and name
_registered: set[str] = set()  # the variants in which Mitsuba knows ``PLUGINS``
_constructed = False  # has this process ever made one of ``PLUGINS``


def register() -> None:
    """Register the plugins in the current Mitsuba variant and in every one that is switched to later.

    Idempotent. Raises ``RuntimeError`` where no variant is set.
    """
    register_modules(__name__, [])


def register_modules(package: str, names: Sequence[str]) -> None:
    """Register a package's plugins in the current Mitsuba variant and in every one that is switched to later.

    ``names``: the modules of ``package`` that hold the plugins, each of a class that derives from one of
    Mitsuba's and a call such as ``mi.register_bsdf``. They are executed once for each variant. Idempotent.
    Raises ``RuntimeError`` where no variant is set, ``ImportError`` for a module that is not there.
    """
    import mitsuba as mi

    if mi.variant() is None:
        raise RuntimeError(
            "no Mitsuba variant is set: call mitsuba.set_variant(...) before registering plugins"
        )
    watching = bool(_packages)
    _packages[package] = tuple(dict.fromkeys((*_packages.get(package, ()), *names)))
    _load_all()
    if not watching:
        mi.detail.add_variant_callback(lambda old, new: _load_all())


def plugin(name: str, package: str = __name__) -> ModuleType:
    """Return the module ``name`` (e.g. "whitted") for the current variant, to which its classes belong.

    It is executed once for each variant, as its classes derive from Mitsuba's, and each variant has its own.
    Each copy gets a module name of its own; relative imports still resolve, because the package is the
    same.
    """
    import mitsuba as mi

    key = mi.variant(), package, name
    if key not in _loaded:
        source = importlib.util.find_spec(f"{package}.{name}")
        origin = source.origin if source else None
        spec = importlib.util.spec_from_file_location(f"{package}.{name}_{key[0]}", origin)
        if spec is None or spec.loader is None:
            raise ImportError(f"the plugin module {name} is missing in {package}: install the package anew")
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        _loaded[key] = module
    return _loaded[key]


def class_of(row: Plugin) -> type:
    """Return the class of a plugin for the current variant."""
    return getattr(plugin(row.module), row.class_name)


def classes_of(table: str) -> tuple[Any, ...]:
    """Return the classes, for the current variant, of the plugins in a table of the kernels."""
    return tuple(class_of(row) for row in PLUGINS if row.table == table)


def is_known(thing: object) -> bool:
    """True if Mitsuba or this folder has the class of an object, so that all its state is in sight.

    What somebody else wrote in Python may depend on anything, and is asked each time.
    """
    module = type(thing).__module__
    return module.split(".", 1)[0] == "mitsuba" or module.startswith(f"{__name__}.")


def any_constructed() -> bool:
    """True if this process has ever made one of ``PLUGINS``."""
    return _constructed


def _constructor(cls: type) -> Callable[[mi.Properties], Any]:
    def construct(props: mi.Properties) -> Any:
        global _constructed
        _constructed = True
        return cls(props)

    return construct


def _load_all() -> None:
    import mitsuba as mi

    if mi.variant() not in _registered:
        for row in PLUGINS:
            getattr(mi, f"register_{row.kind}")(row.name, _constructor(class_of(row)))
        _registered.add(mi.variant())
    for package, names in _packages.items():
        for name in names:
            plugin(name, package)
