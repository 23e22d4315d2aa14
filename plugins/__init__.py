"""Mitsuba plugins in Dr.Jit, and the maths they share.

``register()`` makes ``mrt_bsdf``, ``mrt_cone``, ``mrt_cylinder``, ``mrt_group``, ``mrt_light``, ``mrt_mesh``,
``mrt_plane``, ``mrt_texture`` and ``mrt_whitted`` known to Mitsuba.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

MODULES = ("bsdf", "cone", "cylinder", "group", "light", "mesh", "plane", "texture", "whitted")

_loaded: dict[tuple[str, str], ModuleType] = {}
_watching = False


def register() -> None:
    """Register the plugins in the current Mitsuba variant and in every one that is switched to later.

    Idempotent. Raises ``RuntimeError`` where no variant is set.
    """
    global _watching
    import mitsuba as mi

    if mi.variant() is None:
        raise RuntimeError("no Mitsuba variant is set: call mitsuba.set_variant(...) before register()")
    _load_all(mi.variant())
    if not _watching:
        mi.detail.add_variant_callback(lambda old, new: _load_all(new))
        _watching = True


def plugin(name: str) -> ModuleType:
    """The plugin module ``name`` (e.g. "whitted") as loaded for the current variant."""
    import mitsuba as mi

    return _loaded[mi.variant(), name]


def _load_all(variant: str) -> None:
    for name in MODULES:
        if (variant, name) not in _loaded:
            _loaded[variant, name] = _load(variant, name)


def _load(variant: str, name: str) -> ModuleType:
    """Execute a plugin module anew: its class derives from a Mitsuba class, and each variant has its own.

    Mitsuba keeps registrations by variant, so once per variant is enough. Each copy gets a module name of its
    own; relative imports still resolve, because the package is the same.
    """
    found = importlib.util.find_spec(f"{__name__}.{name}")
    source = found.origin if found else None
    spec = importlib.util.spec_from_file_location(f"{__name__}.{name}_{variant}", source)
    if spec is None or spec.loader is None:
        raise ImportError(f"the plugin module {name} is missing in {__name__}: install the package anew")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
