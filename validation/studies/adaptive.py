"""Scenes of one's own: as Mitsuba renders them; and rendering to an error: is it held, unbiased, worth it?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools.own_scenes import LOCAL, SCENES, SPP, load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.timing import in_turns, timed

TITLE = "Scenes of one's own, and rendering to an error"

TARGETS = (0.5, 0.8, 1.2)  # of the error of uniform samples
LEVEL = 0.95  # of the intervals
ENOUGH = 0.9  # of them must hold the truth


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    scenes: Sequence[str]
    size: tuple[int, int]
    truth: int  #: rays of a pixel
    seeds: int  #: for each target
    repeats: int  #: of pictures to compare, and to time
    pictures: int  #: to find a bias in
    timed: tuple[int, int]  #: size of pictures that are timed


FULL = Extent(tuple(SCENES), (64, 48), 2**13, 4, 5, 32, (192, 144))
QUICK = Extent(("gloss", "stratified", "texture_and_sky"), (32, 24), 2**12, 2, 3, 12, (48, 36))
Truths = dict[str, tuple[Any, np.ndarray]]  # scenes and their pictures by name


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    once = min(extent.truth, 2**12)
    truths: Truths = {}
    for name in extent.scenes:
        scene, seeds = load(name, *extent.size), range(10_000, 10_000 + extent.truth // once)
        pictures = [np.array(mi.render(scene, spp=once, seed=seed), np.float64) for seed in seeds]
        truths[name] = scene, np.mean(pictures, axis=0)
    for part in (uniform_samples, calibration, bias, equal_error):
        part(study, extent, truths)


def rmse(picture: np.ndarray, truth: np.ndarray) -> float:
    """Return the root of the mean squared difference."""
    return float(np.sqrt(np.mean(np.square(picture - truth, dtype=np.float64))))


def shift(picture: np.ndarray, truth: np.ndarray) -> float:
    """Return how far a picture is shifted, in pixels: the step that explains most of what is different.

    Least squares of the difference against the truth's slopes, which is the top of the cross-correlation
    where the step is small.
    """
    rows, columns = np.gradient(truth.astype(np.float64), axis=(0, 1))
    slopes = np.stack([columns.ravel(), rows.ravel()], axis=1)
    step, *_ = np.linalg.lstsq(-slopes, (picture - truth).ravel().astype(np.float64), rcond=None)
    return math.hypot(*step)


def uniform_samples(study: Study, extent: Extent, truths: Truths) -> None:
    """Compare uniform samples with Mitsuba's, in error and place."""
    rows: list[tuple[Any, ...]] = []
    for name, (scene, truth) in study.each("Uniform samples", truths.items()):
        seeds = range(extent.repeats)
        ours = [mrt.render(scene, aa=1, aamode="none", spp=SPP, seed=seed).image for seed in seeds]
        theirs = [np.array(mi.render(scene, spp=SPP, seed=seed)) for seed in seeds]
        errors = [np.sqrt(np.mean([rmse(p, truth) ** 2 for p in ps])) for ps in (ours, theirs)]
        step = shift(np.mean(ours, axis=0), np.mean(theirs, axis=0))
        rows.append((name, *errors, errors[0] / errors[1], step))
    study.table(
        "uniform",
        f"RMSE of {SPP} rays a pixel, ours and mi.render's, {extent.size[0]}x{extent.size[1]}",
        ("scene", "ours", "mi.render", "ratio", "shift, pixels"),
        rows,
        "With the same seeds, the rays are the same.",
    )
    worst, why = (
        max(abs(r[3] - 1) for r in rows),
        "the same rays; least fault: a tenth of them left out",
    )
    study.at_most("uniform: largest distance of the ratio from 1", worst, 0.05, why)
    why = "a lattice off by half a sample shifts by 0.06, one by half a pixel by 0.5"
    study.at_most("uniform: largest shift, pixels", max(r[4] for r in rows), 0.02, why)


def calibration(study: Study, extent: Extent, truths: Truths) -> None:
    """Render to errors, and compare the stated with the true ones."""
    rows, held, count = [], 0, 0
    for name, (scene, truth) in study.each("Stated errors", truths.items()):
        uniform = rmse(np.array(mi.render(scene, spp=SPP, seed=1)), truth)
        found = []
        for target in TARGETS:
            for seed in range(extent.seeds):
                result = mrt.render(scene, target=target * uniform, seed=seed)
                true, error = rmse(result.image, truth), result.error
                assert error is not None  # there was a target
                found.append((true / error.rmse, error.low <= true <= error.high, error.high / error.rmse))
        ratios, inside, widths = zip(*found, strict=True)
        held, count = held + sum(inside), count + len(inside)
        rows.append((name, len(found), sum(inside), np.mean(ratios), np.std(ratios), np.mean(widths)))
    study.table(
        "calibration",
        f"True error against the stated one, with its interval of {LEVEL:.0%}",
        ("scene", "renders", "held", "true / stated", "spread", "upper end / stated"),
        rows,
        f"Targets: {', '.join(map(str, TARGETS))} of the error of {SPP} uniform rays a pixel.",
    )
    why = f"intervals of {LEVEL:.0%}, of which so many renders may miss a few more by chance"
    study.at_least("stated errors that hold", held / count, ENOUGH, why)


def bias(study: Study, extent: Extent, truths: Truths) -> None:
    """Compare the mean of many adaptive pictures with the truth."""
    rows: list[tuple[str, float, float, float]] = []
    n = extent.pictures
    for name, (scene, truth) in study.each("Bias", truths.items()):
        pictures = [mrt.render(scene, aamode="noise", spp=32, seed=seed).image for seed in range(n)]
        stack = np.array(pictures, np.float64)
        spread, means = stack.var(axis=0, ddof=1), stack.mean(axis=(1, 2, 3))
        off = np.mean((stack.mean(axis=0) - truth) ** 2 - spread / n)  # what noise does not explain
        whole = float(np.mean(means) - truth.mean()) / float(np.std(means, ddof=1))
        rows.append((name, math.sqrt(max(off, 0) / np.mean(spread)), whole, 1.96 / math.sqrt(n)))
    study.table(
        "bias",
        f"Bias of {n} pictures of a mean of 32 rays, in standard errors of one",
        ("scene", "of a pixel", "of the picture's mean", "± of that"),
        rows,
        "The truth's own error counts as bias.",
    )
    why = "a quarter of what noise does is not seen: it adds 3 % to the error"
    study.at_most("bias of pixels, in standard errors", float(np.median([r[1] for r in rows])), 0.25, why)
    worst = max(abs(r[2]) - 1.5 * r[3] for r in rows)
    study.at_most("bias of means beyond their uncertainty, in standard errors", worst, 0.25, why)


def equal_error(study: Study, extent: Extent, truths: Truths) -> None:
    """Compare costs at equal error, given that uniform rays cost in proportion and err by their root."""
    rows, columns = [], ("rays", "seconds", "from", "to")
    for name in study.each("Equal error", truths):
        uniform, noise, target = _in_turns(load(name, *extent.timed), extent.repeats)
        limit, why = 1.1, "noise is even: estimating it may cost a tenth"
        if name in LOCAL:
            limit, why = 0.6, "noise is local: rays elsewhere are saved"
        row: list[Any] = [name]
        for door, ours in (("aamode=noise", noise), ("target", target)):
            worth = ours["squares"] / uniform["squares"]
            rays = float(np.median(worth * ours["rays"])) / SPP
            seconds = worth * ours["seconds"] / uniform["seconds"]
            low, middle, high = np.quantile(seconds, (0.1, 0.5, 0.9))
            row += [rays, float(middle), float(low), float(high)]
            what = f"to the same error / mi.render's: {name}, {door}"
            study.goal(f"time {what}", middle, limit, why, interval=(low, high))
            study.at_most(f"rays {what}", rays, limit, why)
        rows.append(tuple(row))
    study.table(
        "equal-error",
        f"Cost of the error that mi.render has with {SPP} rays a pixel, {extent.timed[0]}x{extent.timed[1]}",
        ("scene", *(f"{door}: {column}" for door in ("noise", "target") for column in columns)),
        rows,
        f"Over mi.render's, with the middle 80 % of the seconds. Noise is local in {', '.join(LOCAL)}.",
        first=True,
    )


def _in_turns(scene: Any, repeats: int) -> list[dict[str, np.ndarray]]:
    """Render a scene by ``mi.render``, with ``aamode="noise"``, and to the error of the first, in turns.

    Return "rays", "seconds" and "squares" of each kind, by picture: the squared error by its distance
    from the mean of all, for which no truth is needed.
    """

    def uniform(seed: int) -> tuple[np.ndarray, float]:
        return np.array(mi.render(scene, spp=SPP, seed=seed)), SPP

    def ours(seed: int, **options: Any) -> tuple[np.ndarray, float]:
        result = mrt.render(scene, seed=seed, **options)
        return result.image, result.rounds[-1].spp

    error = rmse(uniform(1000)[0], uniform(1001)[0]) / math.sqrt(2)
    kinds: list[Callable[[int], tuple[np.ndarray, float]]] = [
        uniform,
        lambda seed: ours(seed, aamode="noise", spp=SPP),
        lambda seed: ours(seed, target=error),
    ]
    for kind in kinds:
        kind(1000)  # compiles
    sides = [lambda seed, kind=kind: timed(lambda: kind(seed)) for kind in kinds]
    found = []
    for side in in_turns(sides, repeats):
        pictures, rays = zip(*(result for result, _ in side), strict=True)
        mean = np.asarray(np.mean(pictures, axis=0, dtype=np.float64))
        squares = [rmse(picture, mean) ** 2 * repeats / (repeats - 1) for picture in pictures]
        seconds = [seconds for _, seconds in side]
        found.append({"squares": np.array(squares), "rays": np.array(rays), "seconds": np.array(seconds)})
    return found
