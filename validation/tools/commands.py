"""The sub-commands of ``mrt`` that compare and check: ``diff``, ``check`` and ``error-vs-time``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mrt_mitsuba.command.tools import read_toml
from mrt_mitsuba.errors import MrtError, SceneError, UsageError
from mrt_mitsuba.validation.tools.study import Bound

MISSED = 1  # the exit code where a limit is missed, a law does not hold, or a case failed
AT_LEAST = ("psnr", "p_value")  # the limits of other measures are at most
KEYS = ("reference", "cases", "shared", "repeats", "errors")  # of a file of cases


def diff(a: str, b: str, *, layer: str = "", out: str | None = None, **limits: str) -> int:
    """Compare two EXR files; return 0, or 1 beyond a limit. Raises ``UsageError`` if they do not compare."""
    from mrt_mitsuba.validation.tools.compare import UNDEFINED, compare

    bounds = {name: _number(name, text) for name, text in limits.items()}
    try:
        found = compare(a, b, layer=layer)
        if out is not None:
            found.save(out)
    except MrtError as error:
        raise UsageError(str(error)) from error
    measures = found.measures()
    print(found)
    code = 0
    for name, limit in bounds.items():
        value = measures[name]
        if value is None:
            raise UsageError(f"{name} cannot be had of these pictures: {UNDEFINED[name]}")
        bound = Bound(name, value, limit, name not in AT_LEAST)
        print(bound)
        if not bound.holds:
            code = MISSED
    return code


def check(scene: str, *, out: str | None = None, quick: str = "0") -> int:
    """Check a scene; return 0 where every law holds, 1 where one does not."""
    if quick not in ("0", "1"):
        raise UsageError(f"quick={quick}: must be 0 or 1")
    from mrt_mitsuba.rendering.progress import TerminalProgress
    from mrt_mitsuba.validation.checks.scene import check_scene
    from mrt_mitsuba.validation.tools import report

    if out is not None:
        report.prepare(Path(out), inputs=[scene])
    try:
        found = check_scene(_scene(scene), quick=quick == "1", progress=TerminalProgress(unit="plugin"))
    except SceneError as error:  # nothing was checked
        raise UsageError(str(error)) from error
    print(found)
    if out is not None:
        found.save(out)
        print(f"Report: {Path(out) / 'index.html'}")
    return 0 if found.passed else MISSED


def error_vs_time(scene: str, *, cases: str, out: str = "error-vs-time") -> int:
    """Measure the cases of a TOML file; return 0, or 1 where one of them failed."""
    from mrt_mitsuba.validation.tools.timing import own_cache

    settings = read_cases(cases)
    with own_cache():  # cold times are then those of the compiler; before Dr.Jit starts
        from mrt_mitsuba.rendering.progress import TerminalProgress
        from mrt_mitsuba.validation.tools import report, work_precision

        report.prepare(Path(out), inputs=[scene, cases])
        progress = TerminalProgress(unit="render")
        try:
            found = work_precision.error_vs_time(_scene(scene), progress=progress, **settings)
        except SceneError as error:  # of the scene or its reference: nothing was measured
            raise UsageError(str(error)) from error
        print(found)
        found.save(out)
    print(f"Report: {Path(out) / 'index.html'}")
    return MISSED if found.failed else 0


def read_cases(path: str) -> dict[str, Any]:
    """Read the arguments of ``error_vs_time`` from a TOML file. Raises ``UsageError``."""
    found = read_toml(path)
    unknown = sorted(found.keys() - set(KEYS))
    missing = [name for name in KEYS[:2] if name not in found]
    if unknown or missing:
        wrong = f"an unknown entry {unknown[0]!r}" if unknown else f"no entry {missing[0]!r}"
        raise UsageError(f"{path} has {wrong}: it holds {', '.join(KEYS)}")
    return found


def _scene(text: str) -> Any:
    return int(text) if text.isdecimal() else text


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not value >= 0:
        raise UsageError(f"{name}={text}: must be a number from 0 on")
    return value
