"""The mean of renders with different seeds, and its error."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.adaptive.error import ErrorEstimate
from mrt_mitsuba.files.images import read_exr
from mrt_mitsuba.files.layers import DERIVED, FIRST_HIT, LAYERS
from mrt_mitsuba.rendering.api import Result, open_with
from mrt_mitsuba.rendering.plan import make_plan
from mrt_mitsuba.rendering.progress import Timings
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.rendering.shading import Shader, camera_matrices
from mrt_mitsuba.scene.open import sized
from mrt_mitsuba.sweeps.jobs import Facts, Job

BLOCK = 8  # pixels along the side of a block whose noise is taken as independent of other blocks'


def mean_of_seeds(folder: str, job: Job, rows: Sequence[Facts]) -> Result:
    """Return the mean of the pictures in ``rows``; ``job``: one of theirs, for the plan and the camera."""
    # By B. P. Welford's updates (Technometrics 4, 1962), in which no digits cancel
    mean = squares = np.zeros(())
    layers: dict[str, Any] = {}
    for number, row in enumerate(rows, 1):
        picture = read_exr(os.path.join(folder, row["file"]))
        deviation = picture.image - mean
        mean = mean + deviation / number
        squares = squares + deviation * (picture.image - mean)
        for name, values in picture.layers.items():
            source = getattr(LAYERS.get(name.split(".")[0]), "source", "")
            if name == "samples.Y":
                layers[name] = layers.get(name, 0) + values
            elif source in (FIRST_HIT, DERIVED):
                layers[name] = values
            else:
                layers[name] = layers.get(name, 0) + values / np.float32(len(rows))
    variance = squares / (len(rows) - 1) / len(rows)  # of the mean
    for number, name in enumerate(("variance.R", "variance.G", "variance.B")):
        if name in layers:
            layers[name] = variance[..., number].astype(np.float32)
    layers["error.Y"] = np.sqrt(variance.mean(-1)).astype(np.float32)
    settings = RenderSettings.of(**job.arguments)
    with runtime.render_lock, runtime.within(settings.variant or runtime.use()):
        source = open_with(job.scene, settings)
        with sized(source):
            plan = make_plan(source, Shader(source, settings.motion), settings)
            camera = camera_matrices(source.sensor)
    return Result(
        image=mean.astype(np.float32),
        layers=layers,
        plan=plan,
        timings=Timings(total=sum(row["seconds"] or 0.0 for row in rows)),
        rays={"all": sum(row["rays"] or 0 for row in rows)},
        kernel_launches=0,
        options={**plan.options, "seed": [row["seed"] for row in rows]},
        versions=runtime.versions(),
        camera=camera,
        error=_estimate(variance),
    )


def _estimate(variance: np.ndarray) -> ErrorEstimate:
    """Return the error of a mean from the variance of its pixels, [H, W, 3].

    The interval is that of a mean of blocks, within which a reconstruction filter correlates pixels.
    """
    rows, columns = (math.ceil(count / BLOCK) for count in variance.shape[:2])
    strips = np.array_split(variance, rows)
    blocks = [block.mean() for strip in strips for block in np.array_split(strip, columns, axis=1)]
    mean = float(variance.mean())
    doubt = 1.96 * float(np.std(blocks)) / math.sqrt(len(blocks))
    return ErrorEstimate(
        rmse=math.sqrt(mean), low=math.sqrt(max(mean - doubt, 0.0)), high=math.sqrt(mean + doubt)
    )
