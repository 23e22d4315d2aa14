"""The sub-commands of ``mrt`` that compare and check: ``diff``, ``check`` and ``error-vs-time``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mrt_mitsuba.command.registry import AT_LEAST
from mrt_mitsuba.command.tools import read_toml
from mrt_mitsuba.errors import MrtError, SceneError, UsageError
from mrt_mitsuba.options import NUMBER, SWITCH
from mrt_mitsuba.options import check as checked
from mrt_mitsuba.rendering.progress import TerminalProgress
from mrt_mitsuba.validation.page import prepare_folder
from mrt_mitsuba.validation.study import Bound

KEYS = ("reference", "cases", "shared", "repeats")  # of a file of cases


def diff(a: str, b: str, *, layer: str = "", out: str | None = None, **limits: str) -> int:
    """Compare two EXR files; return 0, or 1 beyond a limit. Raises ``UsageError`` if they do not compare."""
    from mrt_mitsuba.validation.compare import CHEAP, MEASURES, UNDEFINED, compare

    wanted = {name: checked(name, NUMBER, text, text=True) for name, text in limits.items()}
    try:
        found = compare(a, b, layer=layer)
        if out is not None:
            found.save(out)
    except MrtError as error:
        raise UsageError(str(error)) from error
    # FLIP takes a minute for a megapixel
    print(found.text([name for name in MEASURES if not limits or name in CHEAP or name in limits]))
    bounds = []
    for name, limit in wanted.items():
        value = found.measures([name])[name]
        if value is None:
            raise UsageError(f"{name} is not defined for these pictures: {UNDEFINED[name]}")
        bounds.append(Bound(name, value, limit, name not in AT_LEAST))
        print(bounds[-1])
    return int(not all(bound.holds for bound in bounds))


def check(scene: int | str, *, out: str | None = None, quick: str = "0", **options: Any) -> int:
    """Check a scene; return 0 where every law holds, 1 where one does not."""
    from mrt_mitsuba.validation.check import check_scene

    settings = {
        **options,
        "quick": checked("quick", SWITCH, quick, text=True),
        "progress": TerminalProgress(unit="plugin"),
    }
    return int(not _found(check_scene, scene, settings, out, str(scene)).passed)


def error_vs_time(
    scene: int | str, *, cases: str, out: str = "error-vs-time", params: Mapping[str, str] | None = None
) -> int:
    """Measure the cases of a TOML file; return 0, or 1 where one of them failed."""
    from mrt_mitsuba.validation import work_precision

    settings = read_toml(cases)
    wrong = [f"an unknown entry {name!r}" for name in sorted(settings.keys() - set(KEYS))]
    if "cases" not in settings:
        wrong.append("no entry 'cases'")
    if wrong:
        raise UsageError(f"{cases} has {wrong[0]}: it holds {', '.join(KEYS)}")
    if params:
        shared = settings.setdefault("shared", {})
        shared["params"] = {**shared.get("params", {}), **params}
    settings["progress"] = TerminalProgress(unit="render")
    return int(bool(_found(work_precision.error_vs_time, scene, settings, out, str(scene), cases).failed))


def _found(
    look: Callable[..., Any], scene: int | str, settings: dict[str, Any], out: str | None, *inputs: str
) -> Any:
    """Examine a scene, print the findings, and write their page into ``out``."""
    if out is not None:
        prepare_folder(Path(out), inputs=inputs)
    try:
        found = look(scene, **settings)
    except SceneError as error:  # nothing was done
        raise UsageError(str(error)) from error
    print(found)
    if out is not None:
        found.save(out)
        print(f"Report: {Path(out) / 'index.html'}")
    return found
