"""The jobs of a sweep: each combination of a grid's values, checked; and scenes on their way to workers."""

from __future__ import annotations

import hashlib
import io
import itertools
import operator
import os
import pickle
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex

import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.machine import Budget
from mrt_mitsuba.options import Values
from mrt_mitsuba.rendering.api import open_with
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.runtime import use, versions
from mrt_mitsuba.scene.files import require_file
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene

MOST_JOBS = 100_000  # all are held in memory
SENT = ".scene"  # ending of a scene that is written next to the pictures, for the workers to read


class Job(NamedTuple):
    """One picture, or a tile of one."""

    name: str  #: of its file, without ending
    scene: Any
    arguments: Values  #: of ``render``, without the scene
    identity: str = ""  #: fingerprint of the scene

    @property
    def file(self) -> str:
        """The name of its picture in the folder."""
        return f"{self.name}.exr"

    def files(self, png: bool) -> list[str]:
        """The names of all that it leaves in the folder."""
        return [self.file, *([f"{self.name}.png"] if png else [])]

    @property
    def is_tile(self) -> bool:
        """Whether it is a part of a picture, in a folder of its own."""
        return os.sep in self.name

    @property
    def note(self) -> str:
        """The name of a tile's note in the folder."""
        return f"{self.name}.json"

    @property
    def made_with(self) -> str:
        """Fingerprint of all that decides about its pixels: scene, settings and versions."""
        pixels = sorted((key, value) for key, value in self.arguments.items() if key != "memory")
        return fingerprint(self.identity, pixels, versions())


def points(grid: object, zipped: bool) -> dict[str, Values]:
    """The values of each job by their axes, by the name of its file; the last axis varies fastest.

    ``zipped``: the axes are columns of one list, whose rows are the jobs, and files are numbered.

    Raises ``UsageError`` for an axis that is empty or no list, columns of different lengths, too many jobs,
    and jobs whose files would have the same name.
    """
    if not isinstance(grid, Mapping):
        raise UsageError(f'grid={grid!r}: give a dict of lists, such as {{"aa": [1, 2]}}')
    axes = {str(key): _axis(key, values) for key, values in grid.items()}
    lengths = list(map(len, axes.values()))
    if zipped and len(set(lengths)) > 1:
        raise UsageError(f"zipped axes must be of one length, and those of {', '.join(axes)} are {lengths}")
    rows = zip(*axes.values(), strict=True) if zipped else itertools.product(*axes.values())
    combinations = [dict(zip(axes, row, strict=True)) for row in itertools.islice(rows, MOST_JOBS + 1)]
    if len(combinations) > MOST_JOBS:
        raise UsageError(f"the grid has more than {MOST_JOBS} jobs: make several sweeps of it")
    if zipped:  # as programs for films expect them
        return {f"frame_{number:04}": point for number, point in enumerate(combinations)}
    names = [_name(point) for point in combinations]
    ((name, count),) = Counter(map(str.casefold, names)).most_common(1)  # some file systems ignore case
    if count > 1:
        raise UsageError(
            f"{count} jobs would write the same file {name}: take values out, or use zipped=True, which "
            "numbers the files"
        )
    return dict(zip(names, combinations, strict=True))


def _name(point: Values) -> str:
    return ",".join(f"{word(key)}={word(value)}" for key, value in point.items()) or "picture"


def _axis(key: object, values: Any) -> list[Any]:
    values = values.tolist() if hasattr(values, "tolist") else values  # NumPy's
    if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
        raise UsageError(f"grid: {key} is {values!r}; give a list of values, such as [{values!r}]")
    first = list(itertools.islice(values, MOST_JOBS + 1))  # some never end
    if not first:
        raise UsageError(f"grid: {key} is an empty list; give it values, or leave it out")
    return [value.tolist() if hasattr(value, "tolist") else value for value in first]


def word(value: object) -> str:
    """A value in letters that file names may have."""
    if isinstance(value, list | tuple):
        return "x".join(map(word, value)) or "none"
    if isinstance(value, Mapping):
        return word(value.get("type") or [f"{key}-{word(own)}" for key, own in value.items()])
    if isinstance(value, str | os.PathLike):
        value = Path(value).stem if os.sep in os.fspath(value) else value
    elif isinstance(value, Scene):
        value = value.title or "scene"
    return re.sub(r"[^\w.+-]+", "-", str(value).replace("%", "pct"))


def jobs(scene: Any, named: Mapping[str, Values], fixed: Values, folder: str) -> list[Job]:
    """The job of each point, given what all share, with scenes as workers can open them: numbers and absolute
    paths. Any other scene is written into a folder.

    Raises ``UsageError`` for what ``render`` does not take, is given twice, or cannot be sent to another
    process, and ``SceneError`` for a file that cannot be read.
    """
    axes = {key for point in named.values() for key in point}
    twice = axes & {*fixed, "" if scene is None else "scene"}
    if twice:
        raise UsageError(f"{min(twice)} is given twice: as an axis of the grid and for all jobs; drop one")
    scenes: dict[int, tuple[Any, str]] = {}  # as sent, and its fingerprint
    every = []
    for name, point in named.items():
        dotted = {key: value for key, value in point.items() if "." in key}
        arguments = {**fixed, **{key: value for key, value in point.items() if "." not in key}}
        own = arguments.pop("scene", scene)
        try:
            RenderSettings.of(**arguments)
        except TypeError as error:
            raise UsageError(str(error)) from None
        params = {**(fixed.get("params") or {}), **(point.get("params") or {}), **dotted}
        if params:
            arguments["params"] = params
        if id(own) not in scenes:
            sent: Any = own
            if isinstance(own, str | os.PathLike):
                sent = os.path.abspath(own)
            elif isinstance(own, SupportsIndex):
                sent = operator.index(own)
                report_scene(sent)  # refuses a number without a scene
            else:
                sent = os.path.join(folder, f"{len(scenes)}{SENT}")
                Path(sent).write_bytes(_encode(own))
            scenes[id(own)] = sent, identify(sent)
        sent, identity = scenes[id(own)]
        every.append(Job(name, sent, arguments, identity))
    return every


def check_parameters(jobs: Sequence[Job]) -> None:
    """Raise ``UsageError`` if a job sets what its scene does not have; each scene is loaded once for values
    of the same types."""
    opened = set()
    for job in jobs:
        params = job.arguments.get("params") or {}
        names = {name: value if "." not in name else type(value).__name__ for name, value in params.items()}
        which = fingerprint(job.scene, names)
        if params and which not in opened:
            opened.add(which)
            open_with(receive(job.scene), RenderSettings.of(**job.arguments), Budget.of(None))


# ------------------------------------- Scenes on their way to workers ------------------------------------


def receive(scene: object) -> Any:
    """The scene that was sent."""
    use()  # it may hold Mitsuba's types
    if isinstance(scene, str) and scene.endswith(SENT):
        return pickle.loads(Path(scene).read_bytes())
    return scene


def identify(sent: object) -> str:
    """The fingerprint of a scene that was sent: of a file, that of its contents, not of the files that it
    names. Raises ``SceneError`` for a file that cannot be read."""
    if isinstance(sent, str):
        require_file(os.path.relpath(sent))
        return fingerprint(Path(sent).read_bytes())
    return fingerprint(sent)


def fingerprint(*values: object) -> str:
    """32 letters that differ where the values do."""
    return hashlib.sha256(_encode(values)).hexdigest()[:32]


def _encode(value: object) -> bytes:
    """A value of Python's and NumPy's types as bytes, the same for equal values.

    Raises ``UsageError`` for what lives in this process only, such as a loaded Mitsuba scene.
    """
    stream = io.BytesIO()
    pickler = _Pickler(stream, protocol=5)
    pickler.fast = True  # no references to what came before: they would distinguish equal from identical
    try:
        pickler.dump(value)
    except (TypeError, AttributeError, pickle.PicklingError, RecursionError) as error:
        raise UsageError(
            f"what lives in this process only cannot be sent to others ({error}): give the scene as a "
            "number, a dict or a path, and settings by their names"
        ) from error
    return stream.getvalue()


class _Pickler(pickle.Pickler):
    """Pickles Mitsuba's transforms and bitmaps by their numbers, too."""

    def reducer_override(self, value: Any) -> Any:
        if "Transform4" in type(value).__name__:
            return _transform, (np.array(value.matrix, np.float64).reshape(4, 4),)
        if isinstance(value, mi.Bitmap):
            return _bitmap, (np.array(value), value.srgb_gamma())
        return NotImplemented


# Its class has another name where a scalar variant was set first
def _transform(matrix: np.ndarray) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(matrix)


def _bitmap(pixels: np.ndarray, srgb: bool) -> mi.Bitmap:
    bitmap = mi.Bitmap(pixels)
    bitmap.set_srgb_gamma(srgb)
    return bitmap
