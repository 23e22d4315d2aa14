"""Ablation of adaptive sampling: rays and error without each stage and constant, over kinds of noise."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import mitsuba as mi
import numpy as np
from scipy.stats import gmean

import mrt_mitsuba as mrt
from mrt_mitsuba.adaptive import allocate, estimate, rounds
from mrt_mitsuba.plugins import plugin
from mrt_mitsuba.validation.compare import Array, averaged
from mrt_mitsuba.validation.scenery import KINDS, load_kind
from mrt_mitsuba.validation.study import Study, Values

Change = tuple[Any, str, Any]  # an object, the name of an attribute, and a value in its place


def _equal_weights(parts: Array, measured: Array) -> Array:
    return np.full(len(parts), 1 / len(parts))


def _unsmoothed(variance: Array) -> Array:
    return np.sqrt(variance + 1e-30)


def ablations() -> dict[str, list[Change]]:
    """What is changed, by the name of the stage that is left out."""
    sequence = plugin("samplers", "mrt_mitsuba.adaptive").PixelSequence
    return {
        "equal weights in the mixture": [(estimate, "_mixture", _equal_weights)],
        "WINDOWS 2": [(estimate, "WINDOWS", (2, 2))],
        "UNSEEN_PSEUDOCOUNT 0": [(estimate, "UNSEEN_PSEUDOCOUNT", 0.0)],
        "PRIOR_WEIGHT 1e-6": [(estimate, "PRIOR_WEIGHT", 1e-6)],
        "no smoothing of deviations": [(allocate, "_smoothed", _unsmoothed)],
        "PILOT_RATIO 1/24": [(allocate, "PILOT_RATIO", 1 / 24)],
        "PILOT_RATIO 1/6": [(allocate, "PILOT_RATIO", 1 / 6)],
        "GROWTH 8": [(rounds, "GROWTH", 8.0)],
        "MIN_GROWTH 1.01": [(rounds, "MIN_GROWTH", 1.01)],
        "MIN_RAYS 0": [(rounds, "MIN_RAYS", 0)],
        "MIN_RELATIVE_DEVIATION 0": [(rounds, "MIN_RELATIVE_DEVIATION", 0.0)],
        "FIRST_GAIN 0.25": [(rounds, "FIRST_GAIN", 0.25)],
        "SAFETY 0": [(rounds, "SAFETY", 0.0)],
        "gain 0": [(sequence, "gain", 0.0)],
    }


TITLE = "What each stage of adaptive sampling brings"


def run(study: Study, *, quick: bool) -> None:
    """Render without each stage, one at a time."""
    if quick:
        ablate(study, size=48, rays=64, seeds=2, kinds=KINDS[:2])
    else:
        ablate(study, size=96, rays=256, seeds=8)


def ablate(study: Study, *, size: int, rays: int, seeds: int, kinds: Sequence[str] = KINDS) -> None:
    """State a table of rays and of errors without each stage, relative to the sampler as it is."""
    scenes = {kind: load_kind(kind, size) for kind in kinds}
    truths = {kind: truth(scene, rays) for kind, scene in scenes.items()}
    base: dict[str, tuple[float, float]] = {}
    changed = {"as it is": list[Change]()} | ablations()
    rows: list[Values] = []
    for name in study.each("Ablation", list(changed)):
        row: Values = {"stage": name}
        errors = list[float]()
        tenths = list[float]()
        for kind, scene in scenes.items():
            with ExitStack() as changes:
                for change in changed[name]:
                    changes.enter_context(patch.object(*change))
                spent, square, off, tenth = measured(scene, *truths[kind], seeds)
            base.setdefault(kind, (spent, square))
            row[kind] = spent * square / (base[kind][0] * base[kind][1])
            errors.append(off)
            tenths.append(tenth)
        row["mean"] = float(gmean([row[kind] for kind in scenes]))
        row |= {"worst error": max(errors), "worst tenth": max(tenths)}
        rows.append(row)
    note = (
        "Rays times squared error, over those of the sampler as it is; worst error: true over target, the "
        "median of the worst kind; worst tenth: of pixels by stated error, the factor to the true one."
    )
    study.records("ablation", f"Ablation, {size}x{size}, the error of {rays} rays", rows, note)
    least = min(rows[1:], key=lambda row: float(row["mean"]))
    what = f"rays times squared error without a stage, least: {least['stage']}"
    study.at_least(what, least["mean"], 0.9 if seeds > 4 else 0.6, "a stage that costs more must go")


def truth(scene: Any, rays: int) -> tuple[Array, float, float]:
    """A converged picture, the variance of its noise, and the error that so many uniform rays leave."""
    pictures = [np.array(mi.render(scene, spp=4 * rays, seed=1000 + k)) for k in range(8)]
    mean, noise = averaged(pictures)
    left = np.mean([np.square(np.array(mi.render(scene, spp=rays, seed=k)) - mean).mean() for k in range(2)])
    return mean, float(noise.mean()), float(np.sqrt(left))


def measured(
    scene: Any, true: Array, noise: float, target: float, seeds: int
) -> tuple[float, float, float, float]:
    """Mean rays of a pixel, mean squared error, the median of error over target, and the factor between true
    and stated errors in the worst noisy tenth of the pixels, sorted by the latter."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        results = [mrt.render(scene, target=target, seed=seed) for seed in range(seeds)]
    errors = np.array([np.square(result.image - true).mean(-1) for result in results])
    squares = np.maximum(errors.mean((1, 2)) - noise, 1e-12)
    stated = np.array([result.layers["error.Y"] for result in results]).reshape(errors.shape)
    order = np.argsort(stated, axis=None)
    true_squares, squares_stated = (
        np.array([part.mean() for part in np.array_split(values.ravel()[order], 10)])
        for values in (errors, np.square(stated))
    )
    noisy = squares_stated > 0.01 * squares_stated.sum()  # others are as exact as the truth
    ratios = true_squares[noisy] / squares_stated[noisy]
    spent = float(np.mean([result.rounds[-1].spp for result in results]))
    middle = float(np.median(np.sqrt(squares))) / target
    return spent, float(squares.mean()), middle, float(np.exp(np.abs(np.log(ratios)).max() / 2))
