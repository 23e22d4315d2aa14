"""The jobs of a sweep: every combination of a grid's values, checked, each with the name of its file."""

from __future__ import annotations

import difflib
import inspect
import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.model import Scene

LONGEST_NAME = 200  # characters of a file's name without its ending; file systems take 255 bytes
# Arguments of ``render`` that stay in this process, or that are given otherwise
NOT_SWEPT = frozenset({"scene", "progress", "on_round", "region", "params"})


@dataclass(frozen=True)
class Job:
    """One picture."""

    name: str  #: of its file, without ending
    scene: Any
    arguments: Mapping[str, Any]  #: of ``render``, without the scene
    parameters: Mapping[str, Any]  #: its values of the grid, by key
    identity: str = ""  #: fingerprint of the scene
    made_with: str = ""  #: fingerprint of scene, settings and versions

    @property
    def file(self) -> str:
        """The name of its picture in the folder."""
        return f"{self.name}.exr"


def jobs(scene: Any, grid: Any, zipped: bool, fixed: Mapping[str, Any]) -> list[Job]:
    """Return the jobs of a grid, in the order of its axes, the last of which varies fastest.

    ``zipped``: the axes are columns of one list, whose rows are the jobs; ``fixed``: arguments of ``render``
    that all jobs share.

    Raises ``UsageError`` for an axis that is empty or no list, an unknown key, a value out of range, columns
    of different lengths, and jobs whose files would have the same name.
    """
    axes = _axes(grid, fixed)
    if "scene" in axes and scene is not None:
        raise UsageError("the scene is given twice: as an axis of the grid and by itself; write None for one")
    shared = {key: _check(key, value) for key, value in fixed.items() if value is not None}
    lengths = {key: len(values) for key, values in axes.items()}
    if zipped and len(set(lengths.values())) > 1:
        raise UsageError(f"zipped axes must be of one length, and are {lengths}")
    rows = list(zip(*axes.values(), strict=True) if zipped else itertools.product(*axes.values()))
    points = [dict(zip(axes, row, strict=True)) for row in rows]
    found = []
    for name, point in zip(_names(points, zipped), points, strict=True):
        dotted = {key: value for key, value in point.items() if "." in key}
        arguments = shared | {key: value for key, value in point.items() if key not in dotted}
        params = {**shared.get("params", {}), **point.get("params", {}), **dotted}
        if params:
            arguments["params"] = params
        found.append(Job(name, arguments.pop("scene", scene), arguments, point))
    return found


def _axes(grid: Any, fixed: Mapping[str, Any]) -> dict[str, list[Any]]:
    if not isinstance(grid, Mapping):
        raise UsageError(f'grid={grid!r}: give a dict of lists, such as {{"aa": [1, 2]}}')
    axes = {}
    for key, values in grid.items():
        if not (isinstance(key, str) and key.isprintable()):
            raise UsageError(f"grid: the key {key!r} is no name of an option or a parameter")
        if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
            raise UsageError(f"grid: {key} is {values!r}; give a list of values, such as [{values!r}]")
        axes[key] = [_check(key, plain(value)) for value in values]
        if not axes[key]:
            raise UsageError(f"grid: {key} is an empty list; give it values, or leave it out")
        if key in fixed:
            raise UsageError(f"{key} is given twice: as an axis of the grid and for all jobs; drop one")
    return axes


def _check(key: str, value: Any) -> Any:
    """Return a value as ``render`` takes it; raise ``UsageError`` where it cannot."""
    from mrt_mitsuba import render
    from mrt_mitsuba.rendering import settings

    if not _finite(value):
        raise UsageError(f"{key}={value!r}: give finite numbers")
    if key == "scene" or key == "params" or "." in key:
        return value
    known = inspect.signature(render).parameters.keys() - NOT_SWEPT
    if key not in known:
        close = difflib.get_close_matches(key, known, n=1)
        hint = f"did you mean {close[0]}?" if close else "a parameter of the scene has a dot in its key"
        raise UsageError(f"{key} is not an option of render: {hint}")
    if not isinstance(value, str | bytes | bool | int | float | Mapping | Sequence | None):
        raise UsageError(f"{key}={value!r} cannot be sent elsewhere; give a name, a number or a dict")
    return settings.check(key, value) if key in settings.TABLE else value


def plain(value: Any) -> Any:
    """Return NumPy's numbers and arrays as Python's."""
    return value.tolist() if hasattr(value, "tolist") else value


def _finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, list | tuple) or all(map(_finite, value))


def _names(points: Sequence[Mapping[str, Any]], zipped: bool) -> list[str]:
    if zipped:
        digits = max(4, len(str(len(points) - 1)))  # as programs that make films expect them
        return [f"frame_{number:0{digits}}" for number in range(len(points))]
    names = [
        ",".join(f"{word(key)}={word(value)}" for key, value in point.items()) or "picture"
        for point in points
    ]
    counts = Counter(name.casefold() for name in names)  # some file systems ignore case
    for name in names:
        if counts[name.casefold()] > 1:
            raise UsageError(
                f"{counts[name.casefold()]} jobs would write the same file {name}: take out values given "
                "twice, or use zipped=True, which numbers the files"
            )
        if len(name.encode()) > LONGEST_NAME:
            raise UsageError(
                f"the file {name[:60]}... would have a name of {len(name)} characters: use zipped=True, "
                "which numbers the files"
            )
    return names


def word(value: Any) -> str:
    """Return a value in letters that file names may have."""
    if isinstance(value, list | tuple):
        return "x".join(map(word, value)) or "none"
    if isinstance(value, Mapping):
        return word(value.get("type") or [f"{key}-{word(own)}" for key, own in value.items()])
    if isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        value = os.path.splitext(os.path.basename(text))[0] if os.sep in text else text
    elif isinstance(value, Scene):
        value = value.title or "scene"
    return re.sub(r"[^\w.+-]+", "-", str(value))
