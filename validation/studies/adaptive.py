"""Scenes of one's own: are they what Mitsuba renders, and what does an error cost where rays follow noise?

``honest`` says whether the errors stated are true, and means unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.studies.filters import rmse
from mrt_mitsuba.validation.tools.scenery import LOCAL, SCENES, SPP, load
from mrt_mitsuba.validation.tools.study import Study, in_turns, timed

TITLE = "Scenes of one's own, and the cost of an error"
QUICK = ("gloss", "stratified", "texture_and_sky")
DOORS = ("aamode=noise", "target")  # to rays where the noise is


def run(study: Study, *, quick: bool) -> None:
    """Compare pictures, and costs at equal error, given that uniform rays err by the root of their number."""
    names, size, repeats = (QUICK, (48, 36), 3) if quick else (tuple(SCENES), (192, 144), 5)
    rows: list[dict[str, Any]] = []
    for name in study.each("Scenes of one's own", names):
        same, uniform, *ours = measure(load(name, *size), repeats)
        what, why = (
            f"{name}: uniform samples off mi.render's, over their noise",
            "the same seeds, the same rays",
        )
        study.at_most(
            what, same, 1e-3, f"{why}; a film's filter or a lattice that is not the scene's leaves 1"
        )
        limit, why = 1.1, "noise is even: estimating it may cost a tenth"
        if name in LOCAL:
            limit, why = 0.6, "noise is local: rays elsewhere are saved"
        row: dict[str, Any] = {"scene": name, "off by": same}
        for door, found in zip(DOORS, ours, strict=True):
            worth = found["squares"] / uniform["squares"]
            rays = float(np.median(worth * found["rays"])) / SPP
            low, middle, high = np.quantile(
                worth * found["seconds"] / uniform["seconds"], (0.1, 0.5, 0.9)
            ).tolist()
            figures = {"rays": rays, "seconds": middle, "from": low, "to": high}
            row |= {f"{door}: {column}": figure for column, figure in figures.items()}
            what = f"to the same error / mi.render's: {name}, {door}"
            study.goal(f"time {what}", middle, limit, why, interval=(low, high))
            study.at_most(f"rays {what}", rays, limit, why)
        rows.append(row)
    title = f"Cost of the error that mi.render has with {SPP} rays a pixel, {size[0]}x{size[1]}"
    note = f"Over mi.render's, with the middle 80 % of the seconds. Noise is local in {', '.join(LOCAL)}."
    study.records("equal-error", title, rows, note, first=True)


def measure(scene: Any, repeats: int) -> tuple[Any, ...]:
    """Render by ``mi.render``, with ``aamode="noise"``, and to the error of the first, in turns.

    Return how far our uniform samples are off Mitsuba's, over the noise; then "rays", "seconds" and "squares"
    of each kind, by picture: the squared error by its distance from the mean of all, which needs no truth.
    """

    def theirs(seed: int) -> tuple[np.ndarray, float]:
        return np.array(mi.render(scene, spp=SPP, seed=seed)), SPP

    def ours(seed: int, **options: Any) -> tuple[np.ndarray, float]:
        result = mrt.render(scene, seed=seed, **options)
        return result.image, result.rounds[-1].spp if result.rounds else SPP

    one, other = theirs(1000)[0], theirs(1001)[0]
    error = rmse(one, other) / math.sqrt(2)
    same = rmse(ours(1000, aa=1, aamode="none", spp=SPP)[0], one) / error
    kinds: list[Callable[[int], tuple[np.ndarray, float]]] = [
        theirs,
        lambda seed: ours(seed, aamode="noise", spp=SPP),
        lambda seed: ours(seed, target=error),
    ]
    for kind in kinds:
        kind(1000)  # compiles
    found = []
    sides = [lambda seed, kind=kind: timed(lambda: kind(seed)) for kind in kinds]
    for side in in_turns(sides, repeats):
        pictures, rays = zip(*(result for result, _ in side), strict=True)
        mean = np.asarray(np.mean(pictures, axis=0, dtype=np.float64))
        squares = [rmse(picture, mean) ** 2 * repeats / (repeats - 1) for picture in pictures]
        seconds = [seconds for _, seconds in side]
        found.append({"squares": np.array(squares), "rays": np.array(rays), "seconds": np.array(seconds)})
    return same, *found
