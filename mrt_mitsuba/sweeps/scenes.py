"""Scenes on their way to other processes, and their fingerprints."""

from __future__ import annotations

import hashlib
import io
import operator
import os
import pickle
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, SupportsIndex

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.runtime import use, versions
from mrt_mitsuba.scene.open import open_scene, set_parameters
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.sweeps.jobs import Job

SENT = ".scene"  # ending of a scene that is written next to the pictures, for the workers to read


def sent(jobs: Sequence[Job], folder: str) -> list[Job]:
    """Return jobs as workers take them, with their fingerprints; they need no values of the grid.

    Scenes that are numbers and paths stay, anything else goes into a file in ``folder``. Raises
    ``UsageError`` for a number without a scene and for what cannot leave this process.
    """
    scenes: dict[int, tuple[Any, str]] = {}
    for key, scene in {id(job.scene): job.scene for job in jobs}.items():
        if isinstance(scene, str | os.PathLike):
            scene = os.path.abspath(scene)
        elif isinstance(scene, SupportsIndex):
            scene = operator.index(scene)
            report_scene(scene)
        else:
            payload = _encode(scene, "the scene")
            scene = os.path.join(folder, hashlib.sha256(payload).hexdigest()[:32] + SENT)
            with open(scene, "wb") as file:
                file.write(payload)
        scenes[key] = scene, identify(scene)
    found = []
    for job in jobs:
        scene, identity = scenes[id(job.scene)]
        pixels = sorted((key, value) for key, value in job.arguments.items() if key != "memory")
        made = fingerprint(identity, pixels, versions())
        found.append(replace(job, scene=scene, parameters={}, identity=identity, made_with=made))
    return found


def is_copy(sent: Any) -> bool:
    """Return whether a scene was sent in a file of the sweep's own."""
    return isinstance(sent, str) and sent.endswith(SENT)


def receive(scene: Any) -> Any:
    """Return the scene that was sent; needs a variant, as it may hold Mitsuba's types."""
    if is_copy(scene):
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


def fingerprint(*values: Any) -> str:
    """Return 32 letters that differ where the values do."""
    return hashlib.sha256(_encode(values, "a setting")).hexdigest()[:32]


def _encode(value: Any, what: str) -> bytes:
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
            return transform, (np.array(value.matrix, np.float64).reshape(4, 4),)
        if mi is not None and isinstance(value, mi.Bitmap):
            return bitmap, (np.array(value), value.srgb_gamma())
        return NotImplemented


def transform(matrix: Any) -> Any:
    """Return Mitsuba's transform with a matrix, [4, 4]."""
    import mitsuba as mi

    return mi.ScalarTransform4f(matrix)


def bitmap(pixels: Any, srgb: bool) -> Any:
    """Return Mitsuba's bitmap of pixels, [H, W, C]; ``srgb``: are they encoded so."""
    import mitsuba as mi

    found = mi.Bitmap(pixels)
    found.set_srgb_gamma(srgb)
    return found
