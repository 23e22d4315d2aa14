"""Errors that can be trusted: is the mean right, is the error as stated, or is doubt stated, calm to wild?"""

from __future__ import annotations

import warnings
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import stats

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools.compare import averaged
from mrt_mitsuba.validation.tools.scenery import load_room
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Errors that can be trusted"
SIZE, SPP = 48, 64
BALLS: dict[str, dict[str, Any]] = {
    "matte": {"type": "diffuse"},
    "plastic": {"type": "plastic"},
    "brushed": {"type": "roughconductor", "alpha": 0.3},
    "polished": {"type": "roughconductor", "alpha": 0.05},
    "mirror": {"type": "conductor"},
    "frosted": {"type": "roughdielectric", "alpha": 0.1},
    "glass": {"type": "dielectric"},
}
LAMPS = {"large": 0.8, "middle": 0.4, "small": 0.15}  # radii
CALM = ("matte", "plastic", "brushed")  # under lamps that are not small
QUICK = (("matte", "large"), ("glass", "small"))


def scene(ball: str, lamp: str) -> Any:
    """A ball on a floor under a lamp and a faint sky."""
    radius = LAMPS[lamp]
    light = {"type": "area", "radiance": {"type": "rgb", "value": 4 / radius**2}}
    return load_room(
        SIZE,
        ball={"type": "sphere", "center": [0, 0.9, 0], "radius": 0.8, "bsdf": BALLS[ball]},
        lamp={"type": "sphere", "center": [1.5, 4, 1], "radius": radius, "emitter": light},
    )


def run(study: Study, *, quick: bool) -> None:
    """Render to the error of so many rays a pixel, with many seeds; compare with the converged picture."""
    cases = QUICK if quick else [(ball, lamp) for ball in BALLS for lamp in LAMPS]
    seeds, truth_rays = (10, 2**13) if quick else (100, 2**17)
    least, most = (0.7, 6) if quick else (0.9, 3.5)  # 6 of 10 hold once in a thousand times
    rows: list[tuple[Any, ...]] = []
    for ball, lamp in study.each("Renders to an error", cases):
        rows.append((f"{ball}, {lamp} lamp", *_measured(scene(ball, lamp), seeds, truth_rays)))
    study.table(
        "honest",
        f"Renders to the error of {SPP} rays, {SIZE}x{SIZE}: shares of {seeds} seeds",
        (
            "scene",
            "held or doubted",
            "doubted",
            "mean off, %",
            "±",
            "true / stated of pixels: least",
            "largest",
            "p of pairs: test",
        ),
        rows,
        "Pixels: the root mean squares of tenths sorted by the stated error, where nothing is in doubt.",
        first=True,
    )
    why = "an interval of 95 %, and what the picture to compare with has of noise"
    study.at_least(
        "stated errors that hold, or are doubted: worst scene", min(r[1] for r in rows), least, why
    )
    calm = [r[2] for r in rows if r[0].startswith(CALM) and "small" not in r[0]]
    study.at_most("calm scenes that are doubted", max(calm), 0.02, "nothing there is rare")
    pairs = "p-values of pairs are uniform: least p of Kolmogorov and Smirnov's test"
    study.at_least(pairs, min(r[7] for r in rows), 0.001, "the least of 21 is that small once in 50 times")
    off = max(abs(r[3]) / r[4] for r in rows)
    why = "the largest of 21 is 3.5 once in a hundred times"
    study.at_most("means off, in standard errors", off, most, why)


def _measured(scene: Any, seeds: int, truth_rays: int) -> tuple[float, ...]:
    once = truth_rays // 16
    pictures = [np.array(mi.render(scene, spp=once, seed=10_000 + k)) for k in range(16)]
    truth, noise = averaged(pictures)
    own = np.std([p.mean() for p in pictures], ddof=1) / len(pictures) ** 0.5  # of its mean
    rounding = (1e-4 * truth.mean()) ** 2  # of many rays of one value, in single precision
    target = float(np.sqrt(noise.mean() * truth_rays / SPP))
    held, doubted, means, stated, true, p = 0, 0, [], [], [], []
    last = None
    for seed in range(seeds):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", mrt.MrtWarning)
            result = mrt.render(scene, target=target, maxspp=512, seed=seed)
        error, squares = result.error, np.square(result.image - truth).mean(-1) - noise
        assert error is not None  # there was a target
        if seed % 2:
            p.append(mrt.compare(result, last).p_value)
        last, doubt = result, error.high == np.inf
        held += doubt or error.low**2 <= squares.mean() <= error.high**2
        doubted += doubt
        means.append(result.image.mean(dtype=np.float64))
        if not doubt:
            stated.append(np.square(result.layers["error.Y"]) + rounding)
            true.append(squares + rounding)
    ratios = [np.nan]
    if stated:
        order = np.array_split(np.argsort(stated, axis=None), 10)
        ratios = [np.mean(np.ravel(true)[i]) / np.mean(np.ravel(stated)[i]) for i in order]
        ratios = [float(np.sqrt(max(ratio, 0))) for ratio in ratios]
    mean = truth.mean()
    spread = float(np.hypot(np.std(means, ddof=1) / seeds**0.5, own))
    off = 100 * (np.mean(means) / mean - 1)
    uniform = float(stats.kstest(p, "uniform").pvalue)
    rest = 100 * spread / float(mean), min(ratios), max(ratios), uniform
    return held / seeds, doubted / seeds, float(off), *rest
