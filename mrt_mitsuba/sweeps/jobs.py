"""The jobs of a sweep: each combination of a grid's values, checked, and as bytes for another process."""

from __future__ import annotations

import copyreg
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

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.options import Values
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.runtime import use, versions
from mrt_mitsuba.scene.files import require_file
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene

MAX_JOBS = 100_000  # all are held in memory

Facts = dict[str, Any]  # of a picture, for its row of the table


class Job(NamedTuple):
    """One picture."""

    name: str  #: of its file, without ending
    scene: Any  #: absolute, where it is a path
    arguments: Values  #: of ``render``, without the scene
    made_with: (
        str  #: fingerprint of everything that affects its pixels: scene, settings, plugins and versions
    )
    scene_digest: str  #: of the scene's file; "" where it is none

    @property
    def file(self) -> str:
        """The name of its picture in the folder."""
        return f"{self.name}.exr"


def points(grid: object, zipped: bool) -> dict[str, Values]:
    """Return the values of each job by their axes, by the name of its file; the last axis varies fastest.

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
    combinations = [dict(zip(axes, row, strict=True)) for row in itertools.islice(rows, MAX_JOBS + 1)]
    if len(combinations) > MAX_JOBS:
        raise UsageError(f"the grid has more than {MAX_JOBS} jobs: make several sweeps of it")
    if zipped:  # as video encoders expect them
        return {f"frame_{number:04}": point for number, point in enumerate(combinations)}
    words = (",".join(f"{word(key)}={word(value)}" for key, value in each.items()) for each in combinations)
    names = [text or "picture" for text in words]
    ((name, count),) = Counter(map(str.casefold, names)).most_common(1)  # some file systems ignore case
    if count > 1:
        raise UsageError(
            f"{count} jobs would write the same file {name}: take values out, or use zipped=True, which "
            "numbers the files"
        )
    return dict(zip(names, combinations, strict=True))


def _axis(key: object, values: Any) -> list[Any]:
    values = plain(values)
    if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
        raise UsageError(f"grid: {key} is {values!r}; give a list of values, such as [{values!r}]")
    first = list(itertools.islice(values, MAX_JOBS + 1))  # some never end
    if not first:
        raise UsageError(f"grid: {key} is an empty list; give it values, or leave it out")
    return [plain(value) for value in first]


def plain(value: Any) -> Any:
    """Return a value of Dr.Jit, Mitsuba or NumPy as numbers and lists, and any other as it is."""
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if "Transform" in type(value).__name__ and hasattr(value, "matrix"):
        value = value.matrix
    if dr.is_array_v(value):
        value = np.array(value)
        value = value[..., 0] if value.shape[-1:] == (1,) else value  # of one lane
    if not isinstance(value, np.ndarray | np.generic):
        return value
    if value.dtype.kind == "f" and value.dtype.itemsize < 8:
        value = value.astype(str).astype(float)  # 0.1, not 0.10000000149011612
    return value.tolist()


def word(value: object) -> str:
    """Return a value in letters that file names may have."""
    if isinstance(value, list | tuple):
        return "x".join(map(word, value)) or "none"
    if isinstance(value, Mapping):
        return word(value.get("type") or [f"{key}-{word(own)}" for key, own in value.items()])
    if isinstance(value, str | os.PathLike):
        value = Path(value).stem if os.sep in os.fspath(value) else value
    elif isinstance(value, Scene):
        value = value.title or "scene"
    return re.sub(r"[^\w.+-]+", "-", str(value).replace("%", "pct"))


def jobs(scene: Any, named: Mapping[str, Values], fixed: Values, plugins: Sequence[str] = ()) -> list[Job]:
    """Return the job of each point, given what all share; ``plugins``: digests of the user's plugins.

    Raises ``UsageError`` for what ``render`` does not take, is given twice, or cannot be sent to another
    process, and ``SceneError`` for a file that cannot be read.
    """
    axes = {key for point in named.values() for key in point}
    twice = axes & {*fixed, "" if scene is None else "scene"}
    if twice:
        raise UsageError(f"{min(twice)} is given twice: as an axis of the grid and for all jobs; drop one")
    scenes: dict[int, tuple[Any, str, str]] = {}  # as sent, digest of the file, fingerprint
    every = []
    for name, point in named.items():
        dotted = {key: value for key, value in point.items() if "." in key}
        arguments = {**fixed, **{key: value for key, value in point.items() if "." not in key}}
        own = arguments.pop("scene", scene)
        try:
            RenderSettings.of(**arguments)
        except TypeError as error:
            raise UsageError(str(error)) from None
        params = {**(arguments.get("params") or {}), **dotted}
        if params:
            arguments["params"] = {key: plain(value) for key, value in params.items()}
        if id(own) not in scenes:
            sent = _sendable(own)
            digest = scene_digest(sent)
            scenes[id(own)] = sent, digest, digest or fingerprint(sent)
        sent, digest, identity = scenes[id(own)]
        pixels = sorted((key, value) for key, value in arguments.items() if key != "memory")
        made_with = fingerprint(identity, pixels, plugins, versions())
        every.append(Job(name, sent, arguments, made_with, digest))
    return every


def _sendable(scene: Any) -> Any:
    """Return a scene as another process can open it: paths are absolute, numbers are those of a scene."""
    if isinstance(scene, str | os.PathLike):
        return os.path.abspath(scene)
    if isinstance(scene, SupportsIndex):
        report_scene(operator.index(scene))  # refuses a number without a scene
        return operator.index(scene)
    return scene


# ------------------------------------------- On the way to workers ---------------------------------------


def scene_digest(scene: object) -> str:
    """Return the digest of a scene's file, not of the files that it names; "" for any other scene.

    Raises ``SceneError`` for a file that cannot be read.
    """
    if not isinstance(scene, str):
        return ""
    require_file(os.path.relpath(scene))
    return hashlib.sha256(Path(scene).read_bytes()).hexdigest()


def fingerprint(*values: object) -> str:
    """Return 32 letters that differ where the values do."""
    return hashlib.sha256(encode(values)).hexdigest()[:32]


def encode(value: object) -> bytes:
    """Return a value as bytes, the same for equal values.

    Raises ``UsageError`` for what lives in this process only, such as a loaded Mitsuba scene.
    """
    import cloudpickle

    for name in dir(mi):
        if name.endswith("Transform4f"):
            copyreg.pickle(getattr(mi, name), _transform_parts)
    copyreg.pickle(mi.Bitmap, _bitmap_parts)
    stream = io.BytesIO()
    pickler = cloudpickle.Pickler(stream, protocol=5)
    pickler.fast = True  # no references to what came before: they would distinguish equal from identical
    try:
        pickler.dump(value)
    except (TypeError, AttributeError, pickle.PicklingError, RecursionError) as error:
        raise UsageError(
            f"what lives in this process only cannot be sent to others ({error}): give the scene as a "
            "number, a dict or a path, and settings by their names"
        ) from error
    return stream.getvalue()


def decode(data: bytes) -> Any:
    """Return a value from the bytes that ``encode`` made in the process that submitted the job."""
    use()  # it may hold Mitsuba's types
    return pickle.loads(data)


def _transform_parts(value: Any) -> tuple[Any, ...]:
    return _transform, (np.array(value.matrix, np.float64).reshape(4, 4),)


# Its class has another name where a scalar variant was set first
def _transform(matrix: np.ndarray) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(matrix)


def _bitmap_parts(value: mi.Bitmap) -> tuple[Any, ...]:
    return _bitmap, (np.array(value), value.srgb_gamma())


def _bitmap(pixels: np.ndarray, srgb: bool) -> mi.Bitmap:
    bitmap = mi.Bitmap(pixels)
    bitmap.set_srgb_gamma(srgb)
    return bitmap
