"""Adaptive sampling: what an error costs next to the best of Mitsuba's samplers, and does a render end at it?

In two metrics, that of linear values and that of a display, plain and denoised. ``ablation`` says what each
stage brings.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.stats import gmean

import mrt_mitsuba as mrt
from mrt_mitsuba.adaptive.metric import METRICS
from mrt_mitsuba.validation.compare import Array
from mrt_mitsuba.validation.scenery import KINDS, load_kind
from mrt_mitsuba.validation.study import Study, Values
from mrt_mitsuba.validation.timing import timed_in_turns

TITLE = "The cost of an error, against the best sampler"
SAMPLERS = ("independent", "stratified", "multijitter", "ldsampler")
# Geometric mean of the time over the best sampler's, to its error of 64 and of 256 rays
GOALS = {
    ("linear", False): {64: 0.75, 256: 0.75},
    ("linear", True): {64: 0.6, 256: 0.5},
    ("display", False): {64: 1.0, 256: 1.0},
    ("display", True): {64: 0.55, 256: 0.35},
}
WORST = 1.25  # of any kind
NEAR, WIDE = 1.05, 1.15  # times a target: reached, as far as it can be known; missed, which needs a warning


def run(study: Study, *, quick: bool) -> None:
    """Compare, at one or two sizes and errors, each kind of noise in both metrics."""
    for size, rays in ((96, 64),) if quick else ((192, 64), (256, 256)):
        against_the_best(study, size, rays, turns=3 if quick else 5, seeds=6 if quick else 40)


def uniform(scene: Any, spp: int, seed: int) -> Array:
    """The picture of ``mi.render``."""
    return np.array(mi.render(scene, spp=spp, seed=seed))


def adaptive(scene: Any, options: Values, seed: int) -> mrt.Result:
    """The result of ``mrt.render``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        return mrt.render(scene, seed=seed, **options)


def against_the_best(study: Study, size: int, rays: int, *, turns: int, seeds: int) -> None:
    """Render to the error that the fastest sampler has after so many rays a pixel."""
    rows: list[Values] = []
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # samplers that round numbers of rays say so each time
    try:
        for kind in study.each(f"Renders to an error, {size}x{size}", KINDS):
            scenes = {name: load_kind(kind, size, name) for name in SAMPLERS}
            others = timed_in_turns([partial(uniform, scene, rays) for scene in scenes.values()], turns)
            true = np.mean([uniform(scenes["multijitter"], 4 * rays, 1000 + k) for k in range(8)], axis=0)
            for metric, denoise in GOALS:
                options = {"metric": metric, "denoise": denoise}
                row = to_an_error(scenes["multijitter"], true, options, others, turns, seeds)
                rows.append({"scene": kind} | options | row)
    finally:
        mi.set_log_level(level)
    title = f"Renders to the error of {rays} rays of the best sampler, {size}x{size}"
    note = f"Time over that sampler's; from and to: the middle 80 %. Error: true over target, {seeds} seeds."
    study.records(f"best-{size}", title, rows, note, first=True)
    times = []
    for (metric, denoise), goals in GOALS.items():
        some = [row for row in rows if (row["metric"], row["denoise"]) == (metric, denoise)]
        low, middle, high = gmean([[row[name] for name in ("from", "time", "to")] for row in some]).tolist()
        slowest = max(some, key=lambda row: float(row["time"]))
        row = {"metric": metric, "denoise": denoise, "mean time": middle, "from": low, "to": high}
        row |= {"goal": goals[rays], "slowest": slowest["scene"], "its time": slowest["time"]}
        times.append(row)
    note = f"Geometric means over scenes. Goal of the slowest: {WORST}. Times depend on the load: no bounds."
    study.records(f"goals-{size}", f"Times and their goals, {size}x{size}", times, note, first=True)
    what = f"share of pictures above {NEAR} of their target, {size}x{size}: worst kind"
    study.at_most(what, max(row["missed"] for row in rows), max(0.05, 1 / seeds), "an error is estimated")
    study.at_most(f"pictures above {WIDE} without a warning", sum(row["unsaid"] for row in rows), 0, "or so")


def to_an_error(
    scene: Any,
    true: Array,
    options: Values,
    others: Sequence[tuple[list[Array], Array]],
    turns: int,
    seeds: int,
) -> Values:
    """What a render to the best sampler's own error takes, and how near to its target it ends.

    ``others``: the pictures and the seconds of each sampler.
    """
    rmse = METRICS[options["metric"]].rmse
    errors = [float(np.sqrt(np.mean([rmse(picture, true) ** 2 for picture in side]))) for side, _ in others]
    costs = [error**2 * np.median(times) for error, (_, times) in zip(errors, others, strict=True)]
    best = int(np.argmin(costs))
    target = errors[best]
    options = options | {"target": target}
    ((results, seconds),) = timed_in_turns([partial(adaptive, scene, options)], turns)
    low, middle, high = np.quantile(seconds / np.median(others[best][1]), (0.1, 0.5, 0.9)).tolist()
    results += [adaptive(scene, options, seed) for seed in range(turns, seeds)]
    ends = np.array([rmse(result.image, true) for result in results]) / target
    doubted = np.array([not result.error or result.error.high > WIDE * target for result in results])
    return {
        "sampler": SAMPLERS[best],
        "target": target,
        "rays": float(np.mean([result.rounds[-1].spp for result in results])),
        "time": middle,
        "from": low,
        "to": high,
        "error": float(np.median(ends)),
        "missed": float(np.mean(ends > NEAR)),
        "unsaid": int(np.sum((ends > WIDE) & ~doubted)),
    }
