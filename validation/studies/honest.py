"""Errors that can be trusted: is the mean right, is the error as stated, or is doubt stated, calm to wild?"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from scipy import stats

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.compare import Array, averaged
from mrt_mitsuba.validation.scenery import load_room
from mrt_mitsuba.validation.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    return load_room(SIZE, bsdf=BALLS[ball], radius=LAMPS[lamp])


def run(study: Study, *, quick: bool) -> None:
    """Render to the error of so many rays a pixel, with many seeds; compare with the converged picture."""
    cases = QUICK if quick else [(ball, lamp) for ball in BALLS for lamp in LAMPS]
    seeds, truth_rays = (10, 2**13) if quick else (100, 2**17)
    least, most = (0.7, 6) if quick else (0.9, 3.5)  # 6 of 10 hold once in a thousand times
    rows = [
        {"scene": f"{ball}, {lamp} lamp", **measured(scene(ball, lamp), seeds, truth_rays)}
        for ball, lamp in study.each("Renders to an error", cases)
    ]
    title = f"Renders to the error of {SPP} rays, {SIZE}x{SIZE}: shares of {seeds} seeds"
    note = "Pixels: the root mean squares of tenths sorted by the stated error, where nothing is in doubt."
    study.records("honest", title, rows, note, first=True)
    figures = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    why = "an interval of 95 %, and what the picture to compare with has of noise"
    what = "stated errors that hold, or are doubted: worst scene"
    study.at_least(what, figures["held or doubted"].min(), least, why)
    calm = [row["doubted"] for row in rows if row["scene"].startswith(CALM) and "small" not in row["scene"]]
    study.at_most("calm scenes that are doubted", max(calm), 0.02, "nothing there is rare")
    pairs = "p-values of pairs are uniform: least p of Kolmogorov and Smirnov's test"
    why = "the least of 21 is that small once in 50 times"
    study.at_least(pairs, figures["p of pairs: test"].min(), 0.001, why)
    off = abs(figures["mean off, %"] / figures["±"]).max()
    why = "the largest of 21 is 3.5 once in a hundred times"
    study.at_most("means off, in standard errors", off, most, why)


def measured(scene: Any, seeds: int, truth_rays: int) -> dict[str, Any]:
    """The columns of a scene's row but its name, from a render to an error for each seed."""
    pictures = [np.array(mi.render(scene, spp=truth_rays // 16, seed=10_000 + k)) for k in range(16)]
    truth, noise = averaged(pictures)
    mean = truth.mean()
    rounding = (1e-4 * mean) ** 2  # of many rays of one value, in single precision
    target = float(np.sqrt(noise.mean() * truth_rays / SPP))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        results = [mrt.render(scene, target=target, maxspp=512, seed=seed) for seed in range(seeds)]
    squares = np.square([result.image for result in results] - truth).mean(axis=-1) - noise  # [seeds, H, W]
    overall = squares.mean(axis=(1, 2))
    low, high = np.array([(result.error.low, result.error.high) for result in results if result.error]).T
    doubted = np.isinf(high)
    held = doubted | (low**2 <= overall) & (overall <= high**2)
    ratios = np.array([np.nan])
    if not doubted.all():
        stated = np.square([result.layers["error.Y"] for result in results])
        stated_tenths, true_tenths = by_tenths(stated[~doubted] + rounding, squares[~doubted] + rounding)
        ratios = true_tenths / stated_tenths
    means = [result.image.mean(dtype=np.float64) for result in results]
    spread = np.hypot(stats.sem(means), stats.sem([picture.mean() for picture in pictures]))
    p_values = [mrt.compare(*pair).p_value for pair in zip(results[1::2], results[::2], strict=True)]
    return {
        "held or doubted": held.mean(),
        "doubted": doubted.mean(),
        "mean off, %": 100 * (np.mean(means) / mean - 1),
        "±": 100 * spread / mean,
        "true / stated of pixels: least": ratios.min(),
        "largest": ratios.max(),
        "p of pairs: test": stats.kstest(p_values, "uniform").pvalue,
    }


def by_tenths(stated: Array, true: Array) -> tuple[Array, Array]:
    """The root mean squares of stated and true errors [10] in tenths, sorted by the stated ones.

    Both are given as squares, in arrays of one shape.
    """
    order = np.array_split(np.argsort(stated, axis=None), 10)

    def errors(squares: Array) -> Array:
        means = [np.ravel(squares)[part].mean() for part in order]
        return np.sqrt(np.maximum(means, 1e-12))

    return errors(stated), errors(true)


def tenths(scene: Any, *, seeds: int, truth_spp: int, spp: int = 64) -> tuple[Array, Array]:
    """Return the reported and the true error of deciles of the pixels [10], sorted by the reported one.

    Of renders by ``path`` with a mean of ``spp`` rays a pixel, allocated by variance, one for each seed. The
    noise of the truth is subtracted from its squares.
    """
    path = mi.load_dict({"type": "path"})
    parts = [mi.render(scene, integrator=path, spp=truth_spp // 8, seed=1000 + k) for k in range(8)]
    truth, noise = averaged(parts)
    options: dict[str, Any] = {"integrator": "path", "aamode": "noise", "spp": spp, "progress": Progress()}
    results = [mrt.render(scene, seed=seed, **options) for seed in range(seeds)]
    stated = np.square([result.layers["error.Y"] for result in results])
    true = np.square([result.image for result in results] - truth).mean(axis=-1) - noise
    return by_tenths(stated, true)


def stated_and_true(scene: Any, *, seeds: int = 8, truth_spp: int = 2048) -> Figure:
    """Plot the true over the reported error of deciles of the pixels of a loaded scene."""
    stated, true = tenths(scene, seeds=seeds, truth_spp=truth_spp)
    drawn, axes = plotting.panel("deciles of the pixels by reported error")
    plotting.logarithmic(axes, "reported error", "true error")
    span = np.array([min(stated.min(), true.min()) / 1.3, max(stated.max(), true.max()) * 1.3])
    axes.fill_between(span, span / 3, span * 3, color="0.93", label="within a factor of 3")
    axes.plot(span, span, color="black", linewidth=0.8)
    axes.plot(stated, true, marker="o", markersize=4, color=plotting.COLORS[0])
    plotting.plain_numbers(axes)
    plotting.legend(axes)
    return drawn
