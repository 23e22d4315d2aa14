"""A Whitted-style ray tracer with a Beckmann material, built from Mitsuba 3 plugins in Dr.Jit.

Importing the package sets the LLVM library for Dr.Jit (see ``mrt_mitsuba.llvm``) and nothing else: Mitsuba is
imported with the first name that needs it. Import it before ``mitsuba`` and ``drjit``.
"""

from __future__ import annotations

import os as _os
from typing import TYPE_CHECKING

import mrt_mitsuba.errors as _errors
from mrt_mitsuba.errors import MrtError, MrtWarning, OutputError, SceneError, UsageError, VariantError

__version__ = "0.1.0"

if TYPE_CHECKING:
    from mrt_mitsuba import filters as filters
    from mrt_mitsuba.rendering.api import Result as Result
    from mrt_mitsuba.rendering.api import render as render
    from mrt_mitsuba.rendering.prepare import prepare as prepare
    from mrt_mitsuba.runtime import register as register
    from mrt_mitsuba.scene.report import scene_dict as scene_dict
    from mrt_mitsuba.sweeps import sweep as sweep
    from mrt_mitsuba.validation.check import check_bsdf as check_bsdf
    from mrt_mitsuba.validation.check import check_emitter as check_emitter
    from mrt_mitsuba.validation.check import check_scene as check_scene
    from mrt_mitsuba.validation.check import check_shape as check_shape
    from mrt_mitsuba.validation.compare import compare as compare
    from mrt_mitsuba.validation.studies.roughconductor import compare_roughconductor as compare_roughconductor
    from mrt_mitsuba.validation.work_precision import error_vs_time as error_vs_time

# Where each public name lives; the module is imported when the name is first used.
_HOME = {
    "Result": "mrt_mitsuba.rendering.api",
    "check_bsdf": "mrt_mitsuba.validation.check",
    "check_emitter": "mrt_mitsuba.validation.check",
    "check_scene": "mrt_mitsuba.validation.check",
    "check_shape": "mrt_mitsuba.validation.check",
    "compare": "mrt_mitsuba.validation.compare",
    "compare_roughconductor": "mrt_mitsuba.validation.studies.roughconductor",
    "error_vs_time": "mrt_mitsuba.validation.work_precision",
    "filters": "mrt_mitsuba.filters",
    "prepare": "mrt_mitsuba.rendering.prepare",
    "register": "mrt_mitsuba.runtime",
    "render": "mrt_mitsuba.rendering.api",
    "scene_dict": "mrt_mitsuba.scene.report",
    "sweep": "mrt_mitsuba.sweeps.run",
}
__all__ = ["MrtError", "MrtWarning", "OutputError", "SceneError", "UsageError", "VariantError"]
__all__ += ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    from importlib import import_module

    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mrt_mitsuba.interrupts import defer_signals

    with _errors.needs_extra(), defer_signals():
        module = import_module(_HOME[name])
    globals()[name] = value = getattr(module, name, module)  # ``filters`` is a module
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if not _os.path.isdir(_os.path.join(_os.path.dirname(__file__), "plugins")):
    # A source checkout: the sub-packages ``plugins``, ``validation`` and ``scenes_xml`` lie next to this one
    __path__.append(_os.path.dirname(_os.path.dirname(_os.path.abspath(__file__))))

from mrt_mitsuba import llvm as _llvm  # noqa: E402 - the last thing: it may warn

_llvm.prepare()
