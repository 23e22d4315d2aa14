"""Scenes on their way to other processes, and their fingerprints."""

from __future__ import annotations

import functools
import hashlib
import io
import operator
import os
import pickle
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, SupportsIndex, cast

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.sweeps.grid import Job


@dataclass(frozen=True)
class SceneFile:
    """A scene in a file next to the pictures, from which each worker reads it once."""

    path: str

    def load(self) -> Any:
        """Return the scene; needs a variant, as the scene may hold Mitsuba's types."""
        return _load(self.path)


@functools.lru_cache(maxsize=4)
def _load(path: str) -> Any:
    with open(path, "rb") as file:
        return pickle.load(file)


def send(scene: Any, folder: str) -> tuple[Any, str]:
    """Return what a worker is given in place of a scene, and a fingerprint of the scene.

    Numbers and paths go as they are, anything else through a file in ``folder``. The fingerprint
    of a file covers its contents, not those of the files that it names.

    Raises ``UsageError`` for a number without a scene and for what cannot leave this process, and
    ``SceneError`` for a file that cannot be read.
    """
    if isinstance(scene, str | os.PathLike):
        path = os.path.abspath(scene)
        try:
            with open(path, "rb") as file:
                return path, fingerprint(file.read())
        except OSError as error:
            raise SceneError(f"cannot read {os.fspath(scene)}: {error.strerror}") from error
    if isinstance(scene, SupportsIndex):
        from mrt_mitsuba.scene.report import report_scene

        number = operator.index(scene)
        report_scene(number)
        return number, fingerprint(number)
    payload = encode(scene, "the scene")
    name = os.path.join(folder, hashlib.sha256(payload).hexdigest()[:32])
    with open(name, "wb") as file:
        file.write(payload)
    return SceneFile(name), fingerprint(payload)


def check_parameters(jobs: Sequence[Job]) -> None:
    """Raise ``UsageError`` if a job sets what its scene does not have; each scene is loaded once."""
    from mrt_mitsuba import runtime
    from mrt_mitsuba.scene.open import open_scene
    from mrt_mitsuba.scene.parameters import set_parameters

    loaded: dict[tuple[int, str], Any] = {}
    known = set()
    for job in jobs:
        params = job.arguments.get("params", {})
        declared = {name: value for name, value in params.items() if "." not in name}
        which = id(job.scene), repr(declared)
        if params and which not in loaded:
            runtime.use()
            loaded[which] = open_scene(job.scene, params=declared).scene
        for key in params.keys() - declared.keys():
            if (*which, key, repr(params[key])) not in known:
                set_parameters(loaded[which], {key: params[key]})
                known.add((*which, key, repr(params[key])))


class Opener:
    """Opens scenes as ``open_scene`` does, and keeps the last: where the next differs in nothing but the
    values of parameters that both set, these are set once more."""

    def __init__(self) -> None:
        self._kind, self._source = "", cast(Any, None)

    def __call__(
        self, scene: Any, *, budget: Any = None, params: Mapping[str, Any] | None = None, **how: Any
    ) -> Any:
        import mitsuba as mi

        from mrt_mitsuba.scene.open import open_scene
        from mrt_mitsuba.scene.parameters import set_parameters

        values = {key: value for key, value in (params or {}).items() if "." in key}
        # names that a file declares; and a film's size is read when the scene is opened
        fixed = {key: value for key, value in (params or {}).items() if key not in values or "film" in key}
        kind = fingerprint(_state(scene), sorted(values), sorted(fixed.items()), how, mi.variant())
        if kind != self._kind:
            self._kind, self._source = "", None  # free before the next one is loaded
            self._source = open_scene(scene, budget=budget, params=params, **how)
            self._kind = kind
        elif values:
            set_parameters(self._source.scene, values)
        return self._source


def _state(scene: Any) -> Any:
    """Return what changes with a scene; of a file its date, as it may name others that change."""
    if isinstance(scene, str):
        found = os.stat(scene)
        return scene, found.st_mtime_ns, found.st_size
    return scene


def fingerprint(*values: Any) -> str:
    """Return 32 letters that differ where the values do."""
    return hashlib.sha256(encode(values, "a setting")).hexdigest()[:32]


def encode(value: Any, what: str) -> bytes:
    """Return what is made of Python's and NumPy's types as bytes, the same for equal values.

    Raises ``UsageError`` for what lives in this process only, such as a loaded Mitsuba scene.
    """
    stream = io.BytesIO()
    try:
        _Pickler(stream).dump(value)
    except (TypeError, AttributeError, pickle.PicklingError, RecursionError) as error:
        raise UsageError(
            f"{what} cannot be sent to other processes ({error}): give a number, a dict or a path"
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
            return _transform, (np.array(value.matrix, np.float64).reshape(4, 4),)
        if mi is not None and isinstance(value, mi.Bitmap):
            return _bitmap, (np.array(value), value.srgb_gamma())
        return NotImplemented


def _transform(matrix: Any) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f(matrix)


def _bitmap(pixels: Any, srgb: bool) -> Any:
    import mitsuba as mi

    bitmap = mi.Bitmap(pixels)
    bitmap.set_srgb_gamma(srgb)
    return bitmap
