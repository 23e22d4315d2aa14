"""Mitsuba plugins in Dr.Jit, and the maths they share.

``register()`` makes ``mrt_bsdf``, ``mrt_cone``, ``mrt_cylinder``, ``mrt_group``, ``mrt_light``,
``mrt_mesh``, ``mrt_plane``, ``mrt_texture`` and ``mrt_whitted`` known to Mitsuba;
``register_modules()`` does the same for plugins of other packages.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from types import ModuleType

MODULES = ("axial", "bsdf", "group", "light", "mesh", "plane", "texture", "whitted")

_packages: dict[str, tuple[str, ...]] = {}  # the plugin modules of each package
_loaded: dict[tuple[str, str, str], ModuleType] = {}  # by variant, package and name


def register() -> None:
    """Register the plugins in the current Mitsuba variant and in every one that is switched to later.

    Idempotent. Raises ``RuntimeError`` where no variant is set.
    """
    register_modules(__name__, MODULES)


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
        found = importlib.util.find_spec(f"{package}.{name}")
        source = found.origin if found else None
        spec = importlib.util.spec_from_file_location(f"{package}.{name}_{key[0]}", source)
        if spec is None or spec.loader is None:
            raise ImportError(f"the plugin module {name} is missing in {package}: install the package anew")
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        _loaded[key] = module
    return _loaded[key]


def _load_all() -> None:
    for package, names in _packages.items():
        for name in names:
            plugin(name, package)
