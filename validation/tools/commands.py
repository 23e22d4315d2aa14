"""The sub-commands of ``mrt`` that compare pictures and settings: ``mrt diff`` and ``mrt error-vs-time``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mrt_mitsuba.command.words import read_toml, words
from mrt_mitsuba.errors import MrtError, SceneError, UsageError
from mrt_mitsuba.validation.tools.study import Bound

MISSED = 1  # the exit code where a limit is missed, or a case failed
AT_LEAST = ("psnr", "p_value")  # the limits of other measures are at most


DIFF = "mrt diff A.exr B.exr [layer=NAME] [mae|rmse|rel_mse|psnr|largest|flip|p_value=LIMIT] [out=PATH]"


def diff(arguments: Sequence[str]) -> int:
    """Compare two EXR files; return 0, or 1 beyond a limit. Raises ``UsageError`` if they do not compare."""
    from mrt_mitsuba.validation.tools.compare import MEASURES, UNDEFINED, compare

    files, given = words(arguments, ("layer", "out", *MEASURES), DIFF)
    if len(files) != 2:
        raise UsageError(f"give two EXR files. Usage: {DIFF}")
    limits = {name: _number(name, value) for name, value in given.items() if name in MEASURES}
    try:
        found = compare(files[0], files[1], layer=given.get("layer", ""))
        if "out" in given:
            found.save(given["out"])
    except MrtError as error:
        raise UsageError(str(error)) from error
    measures = found.measures()
    print(found)
    code = 0
    for name, limit in limits.items():
        value = measures[name]
        if value is None:
            raise UsageError(f"{name} cannot be had of these pictures: {UNDEFINED[name]}")
        bound = Bound(name, value, limit, name not in AT_LEAST)
        print(bound)
        if not bound.holds:
            code = MISSED
    return code


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not value >= 0:
        raise UsageError(f"{name}={text}: must be a number from 0 on")
    return value


ERROR_VS_TIME = "mrt error-vs-time SCENE|scene=PATH cases=FILE.toml [out=DIR]"


def error_vs_time(arguments: Sequence[str]) -> int:
    """Measure the cases of a TOML file; return 0, or 1 where one of them failed."""
    from mrt_mitsuba.validation.tools.kernels import own_cache

    scenes, given = words(arguments, ("scene", "cases", "out"), ERROR_VS_TIME)
    scenes += [given["scene"]] if "scene" in given else []
    if len(scenes) != 1 or "cases" not in given:
        raise UsageError(f"give one scene and a file of cases. Usage: {ERROR_VS_TIME}")
    scene: Any = int(scenes[0]) if scenes[0].isdigit() else scenes[0]
    settings = read_cases(Path(given["cases"]))
    folder = Path(given.get("out", "error-vs-time"))
    with own_cache():  # cold times are then those of the compiler; before Dr.Jit starts
        from mrt_mitsuba.rendering.progress import TerminalProgress
        from mrt_mitsuba.validation.tools import report, work_precision

        report.prepare(folder, "summary.json", "index.html")
        try:
            found = work_precision.error_vs_time(scene, progress=TerminalProgress(unit="render"), **settings)
        except SceneError as error:  # of the scene or its reference: nothing was measured
            raise UsageError(str(error)) from error
    print(found)
    found.save(folder)
    print(f"Report: {folder / 'index.html'}")
    return MISSED if found.failed else 0


KEYS = ("reference", "cases", "shared", "repeats", "errors")


def read_cases(path: Path) -> dict[str, Any]:
    """Read the arguments of ``error_vs_time`` from a TOML file. Raises ``UsageError``."""
    found = read_toml(path)
    unknown = sorted(found.keys() - set(KEYS))
    missing = [name for name in KEYS[:2] if name not in found]
    if unknown or missing:
        wrong = f"an unknown entry {unknown[0]!r}" if unknown else f"no entry {missing[0]!r}"
        raise UsageError(f"{path} has {wrong}: it holds {', '.join(KEYS)}")
    return found
