"""Rays that follow noise: what an error costs next to the best of Mitsuba's samplers, and is it the target?

``honest`` says whether the errors stated are true, and means unbiased.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import gmean

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.compare import Array, averaged, compare
from mrt_mitsuba.validation.scenery import KINDS, LOCAL, SCENES, load, load_kind
from mrt_mitsuba.validation.study import Study, Values
from mrt_mitsuba.validation.timing import kernel_records, timed_in_turns

TITLE = "The cost of an error, against the best sampler"
SAMPLERS = ("independent", "stratified", "multijitter", "ldsampler")
LADDER = (0.5, 1, 2)  # times the rays of multijitter that have the target's error
QUICK = ("gloss", "stratified", "texture_and_sky")
UNIFORM = 128  # rays a pixel of ``SCENES``
TIMED = ("calm", "texture", "gloss", "glass", "spot")  # kinds whose rays are timed
WIDE = 1.15  # of a target: what misses it by more must warn


def run(study: Study, *, quick: bool) -> None:
    """Compare the time to an error, the error with its target, a ray's time, and pictures with Mitsuba's."""
    if quick:
        renders_to_an_error(study, 96, 64, turns=3, seeds=6)
        rays_alone(study, 96, 64, turns=3)
        own_scenes(study, QUICK, (48, 36), turns=3)
        return
    for size, rays in ((128, 256), (256, 64)):
        renders_to_an_error(study, size, rays, turns=5, seeds=20)
        rays_alone(study, size, rays, turns=5)
    own_scenes(study, tuple(SCENES), (96, 72), turns=5)


def uniform(scene: Any, spp: int, seed: int) -> Array:
    """The picture of ``mi.render``."""
    return np.array(mi.render(scene, spp=spp, seed=seed))


def adaptive(scene: Any, options: Values, seed: int) -> mrt.Result:
    """The result of ``mrt.render``."""
    return mrt.render(scene, seed=seed, **options)


def mean_rays(results: Sequence[mrt.Result]) -> float:
    return float(np.median([result.rounds[-1].spp for result in results]))


def goals(study: Study, what: str, rows: Sequence[Values], mean: float, worst: float) -> None:
    """Hold the "time" of rows, and where it is "from" and "to", to goals."""
    low, middle, high = gmean([[row[name] for name in ("from", "time", "to")] for row in rows]).tolist()
    why = "rays that are saved, each a fifth dearer"
    study.goal(f"{what}: geometric mean", middle, mean, why, interval=(low, high))
    slowest = max(rows, key=lambda row: float(row["time"]))
    interval = slowest["from"], slowest["to"]
    study.goal(f"{what}: worst, {slowest['scene']}", slowest["time"], worst, why, interval=interval)


# ---------------------------------------- Against the best sampler ----------------------------------------


def renders_to_an_error(study: Study, size: int, rays: int, *, turns: int, seeds: int) -> None:
    """Render to the error that ``multijitter`` has after so many rays a pixel."""
    costs: list[Values] = []
    aims: list[Values] = []
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # samplers that round numbers of rays say so each time
    try:
        for kind in study.each(f"Renders to an error, {size}x{size}", KINDS):
            cost, aim = to_an_error(kind, size, rays, turns, seeds)
            costs.append(cost)
            aims.append(aim)
    finally:
        mi.set_log_level(level)
    title = f"Renders to the error of {rays} rays of multijitter, {size}x{size}"
    note = "Over the sampler that is fastest to the true error of ours; from and to: the middle 80 %."
    study.records(f"best-{size}", title, costs, note, first=True)
    note = f"True error over target, {seeds} seeds. Warned: of those above {WIDE}."
    study.records(f"aim-{size}", f"{title}: the error in the end", aims, note, first=True)
    mean, worst = (0.45, 1.0) if size > 128 else (0.6, 1.2)
    goals(study, f"time over the best sampler's to the same error, {size}x{size}", costs, mean, worst)
    unsaid = max(row[f"above {WIDE}"] - row["warned"] for row in aims)
    what = f"pictures above {WIDE} of the target without a warning, of {seeds}, {size}x{size}"
    study.at_most(what, unsaid, max(1, seeds // 10), "an interval of 95 %")


def to_an_error(kind: str, size: int, rays: int, turns: int, seeds: int) -> tuple[Values, Values]:
    """What a render to an error takes, and how near to its target it ends."""
    scene = load_kind(kind, size)
    truth, spread = averaged([uniform(scene, 4 * rays, 1000 + k) for k in range(8)])
    noise = float(spread.mean())

    def error(pictures: Sequence[Array]) -> float:
        square = float(np.square(pictures - truth).mean())
        return math.sqrt(max(square - noise, 0.01 * noise))

    target = error([uniform(scene, rays, 2000 + k) for k in range(4)])
    ladder = [round(step * rays) for step in LADDER]
    ours = partial(adaptive, scene, {"target": target})
    loaded = [load_kind(kind, size, sampler) for sampler in SAMPLERS]
    others = [partial(uniform, other, count) for other in loaded for count in ladder]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        (results, seconds), *theirs = timed_in_turns([ours, *others], turns)
    ratios: list[float] = []
    warned: list[bool] = []
    for seed in range(seeds):
        with warnings.catch_warnings(record=True) as messages:
            warnings.simplefilter("always", mrt.MrtWarning)
            ratios.append(error([ours(seed).image]) / target)
        if ratios[-1] > WIDE:
            warned.append(bool(messages))
    aim: Values = {"scene": kind, "median": float(np.median(ratios)), "RMS": math.hypot(*ratios) / seeds**0.5}
    aim |= {"worst": max(ratios), f"above {WIDE}": len(warned), "warned": sum(warned)}
    reached = target * aim["RMS"]
    costs: list[Values] = []
    for k, sampler in enumerate(SAMPLERS):
        rungs = theirs[k * len(ladder) : (k + 1) * len(ladder)]
        errors = [error(pictures) for pictures, _ in rungs]
        medians = [float(np.median(times)) for _, times in rungs]
        there = _at(reached, errors, medians)
        slower = seconds / rungs[1][1] * medians[1] / there
        low, middle, high = np.quantile(slower, (0.1, 0.5, 0.9))
        needed = mean_rays(results) / _at(reached, errors, ladder)
        cost: Values = {"scene": kind, "sampler": sampler, "its seconds": there, "rays": needed}
        costs.append(cost | {"a ray": middle / needed, "time": middle, "from": low, "to": high})
    return min(costs, key=lambda cost: float(cost["its seconds"])), aim


def _at(error: float, errors: Sequence[float], figures: Sequence[float]) -> float:
    """The figure at an error: on a line, as logarithms."""
    slope, level = np.polyfit(np.log(errors), np.log(figures), 1)
    return float(np.exp(level + slope * math.log(error)))


def path_time(records: Sequence[Mapping[str, Any]]) -> float:
    """The time of a ray in all rounds over that in the first, in which all pixels get the same rays.

    ``records``: of the kernels of a render.
    """
    times: dict[Any, list[tuple[float, int]]] = {}
    for record in records:
        if record["type"] == dr.KernelType.JIT:
            times.setdefault(record["hash"], []).append((record["execution_time"], record["size"]))
    traced = max(times.values(), key=lambda launches: sum(time for time, _ in launches))
    seconds, rays = np.sum(traced, axis=0)
    first_seconds, first_rays = traced[0]
    return float(seconds / rays / (first_seconds / first_rays))


def rays_alone(study: Study, size: int, rays: int, *, turns: int) -> None:
    """Trace as many rays as ``multijitter``."""
    rows: list[Values] = []
    for kind in study.each(f"Rays, {size}x{size}", TIMED):
        row: Values = {"scene": kind}
        for rfilter in ("box", "gaussian"):
            scene = load_kind(kind, size, rfilter=rfilter)
            ours = partial(adaptive, scene, {"aamode": "noise", "spp": rays})
            theirs = partial(uniform, scene, rays)
            (results, seconds), (_, others) = timed_in_turns([ours, theirs], turns)
            spent = mean_rays(results) / rays
            ray = float(np.median(seconds / others)) / spent
            path = path_time(kernel_records(partial(mrt.render, scene, aamode="noise", spp=rays)))
            figures = {"rays": spent, "a ray": ray, "path": path, "over": ray / path}
            row |= {f"{rfilter}: {name}": figure for name, figure in figures.items()}
        rows.append(row)
    note = (
        "aamode=noise over multijitter. Path: the time of a ray in its kernel over that of rays that go to "
        "all pixels alike; rays to glass take longer paths than rays to the sky. Over: a ray over its path."
    )
    study.records(f"ray-{size}", f"{rays} rays a pixel, {size}x{size}", rows, note)
    costs = [row[f"{rfilter}: over"] for row in rows for rfilter in ("box", "gaussian")]
    what = f"time of a ray over multijitter's to the same pixels, {size}x{size}: worst"
    study.goal(what, max(costs), 1.2, "rounds and statistics", interval=(min(costs), max(costs)))


# ------------------------------------------ Scenes of one's own ------------------------------------------


def own_scenes(study: Study, names: Sequence[str], size: tuple[int, int], *, turns: int) -> None:
    """Compare pictures with Mitsuba's, and costs with those of the samplers that the scenes name."""
    rows: list[Values] = []
    for name in study.each("Scenes of one's own", names):
        row = own_scene(name, size, turns)
        what = f"{name}: uniform samples off mi.render's, over their noise"
        why = "the same seeds, the same rays; a film's filter or a lattice that is not the scene's leaves 1"
        study.at_most(what, row["off by"], 1e-3, why)
        why = "rays where there is no noise are saved; where it is even, estimating it may cost a tenth"
        limit = 0.6 if name in LOCAL else 1.1
        study.at_most(f"rays to the same error / mi.render's: {name}", row["rays"], limit, why)
        rows.append(row)
    title = f"Renders to the error of {UNIFORM} rays of the scene's own sampler, {size[0]}x{size[1]}"
    note = f"Time, from and to: scaled to equal error. Noise is local in {', '.join(LOCAL)}."
    study.records("equal-error", title, rows, note, first=True)
    what = "time over that of the scene's own sampler"
    goals(study, f"{what}, scaled to equal error", rows, 0.36, 0.95)
    mean = gmean([row["as it is"] for row in rows])
    study.goal(f"{what}, as it is: geometric mean", mean, 0.5, "rays that are saved", interval=(mean, mean))


def own_scene(name: str, size: tuple[int, int], turns: int) -> Values:
    """How far uniform samples are off Mitsuba's, and what their error costs where rays follow noise.

    A squared error is the distance from the mean of all turns, which needs no truth.
    """
    scene = load(name, *size)
    one, other = (uniform(scene, UNIFORM, seed) for seed in (1000, 1001))
    error = compare(one, other).rmse / math.sqrt(2)
    same = adaptive(scene, {"aa": 1, "aamode": "none", "spp": UNIFORM}, 1000)
    ours = partial(adaptive, scene, {"target": error})
    theirs = partial(uniform, scene, UNIFORM)
    (results, seconds), (pictures, others) = timed_in_turns([ours, theirs], turns)
    images = [result.image for result in results]
    squares = [np.var(side, axis=0, ddof=1).mean() for side in (images, pictures)]
    worth = float(squares[0] / squares[1])
    low, middle, high = np.quantile(seconds / others, (0.1, 0.5, 0.9)).tolist()
    row: Values = {"scene": name, "sampler": scene.sensors()[0].sampler().class_name()}
    row |= {"off by": compare(same, one).rmse / error, "rays": worth * mean_rays(results) / UNIFORM}
    return row | {"as it is": middle, "time": worth * middle, "from": worth * low, "to": worth * high}
