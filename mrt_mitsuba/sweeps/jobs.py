"""The jobs of a sweep: every combination of a grid's values, checked, with the name of its file; the scenes
on their way to the workers; and the fingerprint of all that decides about a picture."""

from __future__ import annotations

import difflib
import hashlib
import inspect
import io
import itertools
import math
import operator
import os
import pickle
import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, SupportsIndex

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.runtime import use, versions
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.open import open_scene, set_parameters
from mrt_mitsuba.scene.report import report_scene

MOST_JOBS = 100_000  # all are held in memory
LONGEST_NAME = 200  # bytes of a file's name without its ending; file systems take 255
# Arguments of ``render`` that stay in this process, or that are given otherwise
NOT_SWEPT = frozenset({"scene", "progress", "on_round", "region", "params"})
SENT = ".scene"  # ending of a scene that is written next to the pictures, for the workers to read


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
    if not isinstance(grid, Mapping):
        raise UsageError(f'grid={grid!r}: give a dict of lists, such as {{"aa": [1, 2]}}')
    axes = {key: _axis(key, values) for key, values in grid.items()}
    twice = axes.keys() & {*fixed, "" if scene is None else "scene"}
    if twice:
        raise UsageError(f"{min(twice)} is given twice: as an axis of the grid and for all jobs; drop one")
    shared = {key: _checked(key, [value])[0] for key, value in fixed.items() if value is not None}
    points = _points(axes, zipped)
    found = []
    for name, point in zip(_names(points, zipped), points, strict=True):
        dotted = {key: value for key, value in point.items() if "." in key}
        arguments = shared | {key: value for key, value in point.items() if key not in dotted}
        params = {**shared.get("params", {}), **point.get("params", {}), **dotted}
        if params:
            arguments["params"] = params
        found.append(Job(name, arguments.pop("scene", scene), arguments, point))
    return found


def _points(axes: Mapping[str, Sequence[Any]], zipped: bool) -> list[dict[str, Any]]:
    """Return the values of each job by their axes."""
    lengths = list(map(len, axes.values()))
    if zipped and len(set(lengths)) > 1:
        raise UsageError(f"zipped axes must be of one length, and those of {', '.join(axes)} are {lengths}")
    if not zipped and math.prod(lengths) > MOST_JOBS:
        raise UsageError(f"the grid has more than {MOST_JOBS} jobs: make several sweeps of it")
    rows = zip(*axes.values(), strict=True) if zipped else itertools.product(*axes.values())
    return [dict(zip(axes, row, strict=True)) for row in rows]


def _names(points: Sequence[Mapping[str, Any]], zipped: bool) -> list[str]:
    """Return the name of each job's file; raise ``UsageError`` where two are the same or one is too long."""
    if zipped:
        return [f"frame_{number:04}" for number in range(len(points))]  # as programs for films expect them
    names = [",".join(f"{word(k)}={word(v)}" for k, v in point.items()) or "picture" for point in points]
    counts = Counter(name.casefold() for name in names)  # some file systems ignore case
    for name in names:
        problem, count = "", counts[name.casefold()]
        if len(name.encode()) > LONGEST_NAME:
            problem = f"the file {name[:60]}... would have a name of {len(name)} characters"
        elif count > 1:
            problem = f"{count} jobs would write the same file {name}"
        if problem:
            raise UsageError(f"{problem}: take values out, or use zipped=True, which numbers the files")
    return names


def _axis(key: Any, values: Any) -> list[Any]:
    if not (isinstance(key, str) and key.isprintable()):
        raise UsageError(f"grid: the key {key!r} is no name of an option or a parameter")
    values = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
        raise UsageError(f"grid: {key} is {values!r}; give a list of values, such as [{values!r}]")
    values = list(itertools.islice(values, MOST_JOBS + 1))  # some never end
    if not 0 < len(values) <= MOST_JOBS:
        problem = f"has more than {MOST_JOBS} values" if values else "is an empty list"
        raise UsageError(f"grid: {key} {problem}; give it values, or leave it out")
    return _checked(key, values)


def _checked(key: str, values: Sequence[Any]) -> list[Any]:
    """Return values as ``render`` takes them; raise ``UsageError`` where it cannot."""
    from mrt_mitsuba import render
    from mrt_mitsuba.rendering import settings

    known = inspect.signature(render).parameters.keys() - NOT_SWEPT
    if key not in {*known, "scene", "params"} and "." not in key:
        close = difflib.get_close_matches(key, known, n=1)
        hint = f"did you mean {close[0]}?" if close else "a parameter of the scene has a dot in its key"
        raise UsageError(f"{key} is not an option of render: {hint}")
    found = [value.tolist() if hasattr(value, "tolist") else value for value in values]  # NumPy's
    for value in found:
        numbers = value if isinstance(value, list | tuple) else [value]
        if not all(math.isfinite(number) for number in numbers if isinstance(number, float)):
            raise UsageError(f"{key}={value!r}: give finite numbers")
        if key == "params" and not isinstance(value, Mapping):
            raise UsageError(f"params={value!r}: give a dict of values by name")
    return (
        [settings.check(key, value) for value in found] if key in settings.TABLE and key in known else found
    )


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


def check_parameters(jobs: Sequence[Job]) -> None:
    """Raise ``UsageError`` if a job sets what its scene does not have; each scene is loaded once."""
    loaded: dict[tuple[int, str], Any] = {}
    for job in jobs:
        params = job.arguments.get("params", {})
        declared = {name: value for name, value in params.items() if "." not in name}
        which = id(job.scene), repr(declared)
        if params and which not in loaded:
            use()
            loaded[which] = open_scene(job.scene, params=declared).scene
        if params.keys() > declared.keys():
            set_parameters(loaded[which], {key: params[key] for key in params.keys() - declared.keys()})


# ------------------------------------- Scenes on their way to workers ------------------------------------


def sent(jobs: Sequence[Job], folder: str) -> list[Job]:
    """Return jobs as workers take them, with their fingerprints; they need no values of the grid.

    Scenes that are numbers and paths stay, anything else goes into a file in ``folder``. Raises
    ``UsageError`` for a number without a scene and for what cannot leave this process.
    """
    scenes: dict[int, tuple[Any, str]] = {}
    found = []
    for job in jobs:
        if id(job.scene) not in scenes:
            scene = job.scene
            if isinstance(scene, str | os.PathLike):
                scene = os.path.abspath(scene)
            elif isinstance(scene, SupportsIndex):
                scene = operator.index(scene)
                report_scene(scene)
            else:
                scene = os.path.join(folder, f"{fingerprint(scene)}{SENT}")
                with open(scene, "wb") as file:
                    file.write(_encode(job.scene))
            scenes[id(job.scene)] = scene, identify(scene)
        scene, identity = scenes[id(job.scene)]
        pixels = sorted((key, value) for key, value in job.arguments.items() if key != "memory")
        made = fingerprint(identity, pixels, versions())
        found.append(replace(job, scene=scene, parameters={}, identity=identity, made_with=made))
    return found


def receive(scene: Any) -> Any:
    """Return the scene that was sent; needs a variant, as it may hold Mitsuba's types."""
    if isinstance(scene, str) and scene.endswith(SENT):
        with open(scene, "rb") as file:
            return pickle.load(file)
    return scene


def identify(sent: Any) -> str:
    """Return the fingerprint of a scene that was sent; of a file by its contents, not by those of the files
    that it names. Raises ``SceneError`` for a file that cannot be read.
    """
    if not isinstance(sent, str):
        return fingerprint(sent)
    try:
        with open(sent, "rb") as file:
            return fingerprint(file.read())
    except OSError as error:
        raise SceneError(f"cannot read {os.path.relpath(sent)}: {error.strerror}") from error


def fingerprint(*values: Any) -> str:
    """Return 32 letters that differ where the values do."""
    return hashlib.sha256(_encode(values)).hexdigest()[:32]


def _encode(value: Any) -> bytes:
    """Return what is made of Python's and NumPy's types as bytes, the same for equal values.

    Raises ``UsageError`` for what lives in this process only, such as a loaded Mitsuba scene.
    """
    stream = io.BytesIO()
    try:
        _Pickler(stream).dump(value)
    except (TypeError, AttributeError, pickle.PicklingError, RecursionError) as error:
        raise UsageError(
            f"what lives in this process only cannot be sent to others ({error}): give the scene as a "
            "number, a dict or a path, and settings by their names"
        ) from error
    return stream.getvalue()


class _Pickler(pickle.Pickler):
    """Pickles Mitsuba's transforms and bitmaps by their numbers, and equal things to equal bytes."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        self.fast = True  # no references to what came before: they would distinguish equal from identical

    def reducer_override(self, value: Any) -> Any:
        import numpy as np

        mi = sys.modules.get("mitsuba")
        if mi is not None and "Transform4" in type(value).__name__:
            return rebuilt, (np.array(value.matrix, np.float64).reshape(4, 4), None)
        if mi is not None and isinstance(value, mi.Bitmap):
            return rebuilt, (np.array(value), value.srgb_gamma())
        return NotImplemented


def rebuilt(numbers: Any, srgb: bool | None) -> Any:
    """Return Mitsuba's bitmap of pixels [H, W, C] (``srgb``: are they encoded so), or else the transform
    with a matrix [4, 4]."""
    import mitsuba as mi

    if srgb is None:
        return mi.ScalarTransform4f(numbers)
    found = mi.Bitmap(numbers)
    found.set_srgb_gamma(srgb)
    return found
