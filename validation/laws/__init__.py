"""Laws of BSDFs, shapes and emitters: checks of anyone's plugins by what must hold, without a reference.

Needs Mitsuba, Dr.Jit, NumPy, SciPy and Jinja; matplotlib for plots. A module is imported with the first of
its names that is used, so that ``probe`` alone needs no SciPy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .bsdf import check_bsdf as check_bsdf
    from .emitter import check_emitter as check_emitter
    from .law import LoadError as LoadError
    from .law import UsageError as UsageError
    from .page import Check as Check
    from .page import Findings as Findings
    from .scene import SceneCheck as SceneCheck
    from .scene import check_scene as check_scene
    from .shape import check_shape as check_shape

HOMES = {
    "check_bsdf": "bsdf",
    "check_emitter": "emitter",
    "LoadError": "law",
    "UsageError": "law",
    "Check": "page",
    "Findings": "page",
    "SceneCheck": "scene",
    "check_scene": "scene",
    "check_shape": "shape",
}


def __getattr__(name: str) -> object:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{HOMES[name]}", __name__), name)
