"""The plugin ``matte``; ``register()`` makes it known to Mitsuba."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

_known: set[str] = set()
_watching = False


def register() -> None:
    """Register in the current variant, and in every one switched to later. Idempotent."""
    global _watching
    import mitsuba as mi

    _load(mi.variant())
    if not _watching:
        mi.detail.add_variant_callback(lambda old, new: _load(new))
        _watching = True


def _load(variant: str) -> None:
    """Run the plugin's module anew, by a name of its own: its base class is the variant's."""
    if variant in _known:
        return
    _known.add(variant)
    name = f"{__name__}.bsdf_{variant}"
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name("bsdf.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
