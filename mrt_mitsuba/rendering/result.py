"""The result of a render."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrt_mitsuba.output import files
from mrt_mitsuba.output.error import ErrorEstimate, Round
from mrt_mitsuba.rendering.plan import Plan

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Timings:
    """Seconds of one render; ``load`` and ``passes`` add up to about ``total``."""

    total: float  #: all of the render
    load: float  #: scene and plan
    compile: float  #: kernels that were not in the cache
    kernels: float  #: kernels running
    passes: Mapping[str, float]  #: by the name of the pass


@dataclass(frozen=True)
class Result:
    """A finished picture, its layers, and how it was made."""

    image: Image  #: float32 [H, W, 3], linear, top row first
    layers: Mapping[str, Image]  #: float32 [H, W] by EXR channel name, such as "depth.Z"
    plan: Plan  #: what ran, what was left out and why
    timings: Timings  #: seconds
    rays: Mapping[str, int]  #: number by kind; "mirror" and "shadow" only where they were counted
    kernel_launches: int  #: how many kernels ran
    options: Mapping[str, Any]  #: the values in force
    versions: Mapping[str, str]  #: of what decides about pixels
    camera: Mapping[str, np.ndarray]  #: float64 [4, 4], see ``rendering.view``
    inputs: frozenset[str] = frozenset()  #: paths of the files that the scene was read from
    error: ErrorEstimate | None = None  #: to the converged picture; None where nothing was estimated
    rounds: tuple[Round, ...] = ()  #: what was known after each: the error over the time of this render

    def save(self, *paths: str | os.PathLike[str], tonemap: str = "report") -> None:
        """Write .png and .exr files, all or none; raise ``OutputError``, also for a file that the scene was
        read from.

        ``tonemap`` ("report" or "srgb") concerns a PNG only.
        """
        header = self.header()
        files.save(paths, self.image, layers=self.layers, header=header, tonemap=tonemap, inputs=self.inputs)

    def header(self) -> dict[str, Any]:
        """Return the header attributes of an EXR: how the picture was made, and nothing such as seconds that
        changes when it is made again.
        """
        version = self.versions["mrt-mitsuba"]
        error = self.error and {name: getattr(self.error, name) for name in ("rmse", "low", "high", "tail")}
        if error and error["high"] == np.inf:
            error["high"] = None  # JSON has no infinity
        rounds = [{"spp": each.spp, "rmse": each.rmse} for each in self.rounds]
        return {
            "software": f"mrt-mitsuba {version}",
            "mrt:version": version,
            "mrt:scene": self.plan.scene,
            "mrt:options": dict(self.options),
            "mrt:variant": self.plan.variant,
            **{f"mrt:{name}": self.versions[name] for name in ("mitsuba", "drjit", "llvm")},
            **({"mrt:error": error, "mrt:rounds": rounds} if error else {}),
            **{f"mrt:{name}": matrix.tolist() for name, matrix in self.camera.items()},
        }

    def _repr_png_(self) -> bytes:
        """Show the picture in a notebook, in sRGB as screens expect it."""
        from PIL import Image as PilImage

        buffer = io.BytesIO()
        PilImage.fromarray(files.to_8bit(self.image, "srgb")).save(buffer, format="PNG")
        return buffer.getvalue()
