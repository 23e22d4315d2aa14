"""How time grows with the size of the task, and that the length of the code does not."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Light, Scene
from mrt_mitsuba.scene.report import _scene_4, report_scene
from mrt_mitsuba.scene.shapes import terrain
from mrt_mitsuba.validation.tools import kernels
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import Warm, measure

TITLE = "How time grows with resolution, samples, objects, lights and bounces"

MEMORY = "4G"  # of pictures as large as they come
LEVEL = 0.95  # of the confidence in an exponent
ENOUGH_SECONDS = 3.0  # of warm renders of one size, after which three of them do
MOST_CODE = 1.05  # operations at the largest size over the most at smaller ones: the code must not grow

Job = tuple[Scene, tuple[int, int], dict[str, Any]]  # a scene, its size in pixels, and options


@dataclass(frozen=True)
class Extent:
    """Sizes to measure by what grows, and how often."""

    sizes: Mapping[str, Sequence[int]]
    repeats: int


@dataclass(frozen=True)
class Found:
    """What one size cost."""

    warm: Warm
    kernels: int  # different ones
    operations: int  # of them together
    compile: float  # seconds


@dataclass(frozen=True)
class Exponent:
    """Of time over size: a straight line through the logarithms."""

    value: float
    half_width: float  # of its confidence interval
    scale: float  # seconds at size 1
    sizes: Sequence[int]  # that it was fitted over


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    series: dict[str, dict[int, Found]] = {}
    with study.stage("Growth", sum(map(len, extent.sizes.values()))) as advance:
        for what, sizes in extent.sizes.items():
            series[what] = {}
            for size in sizes:
                series[what][size] = _measure(SERIES[what](size), extent.repeats)
                gc.collect()  # scenes that stay alive slow down the kernels of later ones
                advance(1)
    exponents = {what: fit({n: f.warm.seconds for n, f in found.items()}) for what, found in series.items()}
    study.table(
        "exponents",
        "Exponents of growth, over the larger half of the sizes",
        ("what grows", "from", "to", "exponent", f"{LEVEL:.0%} interval", "reading"),
        [_exponent_row(what, e) for what, e in exponents.items()],
        "Exponent 1: in proportion; 0: no growth. The interval is that of the slope of a straight line "
        "through the logarithms; wide where that is no straight line.",
        first=True,
    )
    study.plot("growth", "Time against the size of the task", _figure(series, exponents), _caption(series))
    study.table(
        "growth",
        "Time and code against the size of the task",
        ("what grows", "size", "seconds", "spread", "compile, s", "kernels", "operations"),
        [(w, n, *_cells(f)) for w, found in series.items() for n, f in found.items()],
        "Seconds: medians of warm renders. Kernels and operations: different kernels, and the length of "
        "their code.",
    )
    for what, found in series.items():
        _hold_code(study, what, found)


def _hold_code(study: Study, what: str, found: Mapping[int, Found]) -> None:
    """The code of the largest task is no longer than that of smaller ones."""
    *smaller, largest = found.values()
    study.at_most(
        f"{what}: operations in kernels at {max(found)} / at smaller sizes",
        largest.operations / max(f.operations for f in smaller),
        MOST_CODE,
        "numbers are data, not code",
    )
    study.at_most(
        f"{what}: kernels at {max(found)} / at smaller sizes",
        largest.kernels / max(f.kernels for f in smaller),
        1,
        "as above",
    )


def _measure(job: Job, repeats: int) -> Found:
    scene, (width, height), options = job
    loaded = load(scene.to_dict(width=width, height=height))
    render = partial(mrt.render, loaded, aamode="none", memory=MEMORY, **options)
    found = kernels.profile(render, repeats=1)
    own = {k.hash: k for k in found if k.hash}
    warm = measure({"": lambda: render().timings}, repeats=repeats, enough=ENOUGH_SECONDS)[""]
    return Found(
        warm, len(own), sum(k.operations for k in own.values()), sum(k.compile + k.codegen for k in found)
    )


def _cells(f: Found) -> tuple[Any, ...]:
    return f.warm.seconds, f.warm.spread, f.compile, f.kernels, f.operations


# ------------------------------------------- What it says -------------------------------------------


def fit(seconds: Mapping[int, float]) -> Exponent:
    """The exponent of time over size, of the larger half of the sizes, and at least four of them."""
    from scipy import stats

    sizes = sorted(seconds)[-max(4, (len(seconds) + 1) // 2) :]
    x, y = np.log(sizes), np.log([seconds[n] for n in sizes])
    line = stats.linregress(x, y)
    freedom = len(sizes) - 2
    spread = stats.t.ppf((1 + LEVEL) / 2, freedom) * line.stderr if freedom > 0 else float("inf")
    return Exponent(float(line.slope), float(spread), float(np.exp(line.intercept)), sizes)


def _exponent_row(what: str, e: Exponent) -> tuple[Any, ...]:
    low, high = e.value - e.half_width, e.value + e.half_width
    return (what, e.sizes[0], e.sizes[-1], e.value, f"{low:.2f} to {high:.2f}", _reading(e))


def _reading(e: Exponent) -> str:
    low, high = e.value - e.half_width, e.value + e.half_width
    if high < 1 and low <= 0:
        return "not told apart from no growth"
    if high < 1:
        return f"ten times as much takes {10**e.value:.2g} times as long: less than in proportion"
    if low > 1:
        return f"ten times as much takes {10**e.value:.2g} times as long: more than in proportion"
    if low <= 0:
        return "too uncertain to tell from no growth, or from growth in proportion"
    return "not told apart from growth in proportion"


def _caption(series: Mapping[str, Mapping[int, Found]]) -> str:
    """Two sentences: what a large task takes, and what becomes of the code."""
    largest = [
        f"{max(found)} {what} in {found[max(found)].warm.seconds:.2g} s" for what, found in series.items()
    ]
    growth = [max(f.operations for f in found.values()) / min(f.operations for f in found.values())
              for found in series.values()]  # fmt: skip
    same = sum(g == 1 for g in growth)
    return (
        f"The largest of each: {', '.join(largest)}. The code is the same at every size in {same} of "
        f"{len(growth)} series, and at most {max(growth):.2g} times as long elsewhere."
    )


def _figure(series: Mapping[str, Mapping[int, Found]], exponents: Mapping[str, Exponent]) -> Any:
    from matplotlib.figure import Figure

    columns = 2
    rows = -(-len(series) // columns)
    figure = Figure(figsize=(7, 2.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(series) :]:
        axis.remove()
    for axis, (what, found) in zip(axes, series.items(), strict=False):
        e = exponents[what]
        axis.loglog(list(found), [f.warm.seconds for f in found.values()], "o", markersize=4)
        ends = np.array([e.sizes[0], e.sizes[-1]], float)
        axis.loglog(ends, e.scale * ends**e.value, "-", color="0.4", linewidth=1)
        for of_axis, values in (
            (axis.xaxis, list(found)),
            (axis.yaxis, [f.warm.seconds for f in found.values()]),
        ):
            low, high = np.log10([min(values), max(values)])
            of_axis.set_view_interval(10 ** np.floor(low), 10 ** np.ceil(high + 1e-9), ignore=True)
            of_axis.set_minor_formatter("")
        axis.set_title(f"{what}: {e.value:.2f} ± {e.half_width:.2f}", fontsize=9)
        axis.set_ylabel("seconds", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    return figure


# -------------------------------------------- What grows --------------------------------------------


SMALL = (160, 120)


def _pixels(count: int) -> Job:
    side = round(count**0.5)
    return report_scene(3), (side, side), {"aa": 1}


def _samples(count: int) -> Job:
    return report_scene(3), SMALL, {"aa": round(count**0.5)}


def _spheres(count: int) -> Job:
    return _scene_4(count), SMALL, {"aa": 4}


def _triangles(count: int) -> Job:
    """Hills under the camera and the lights of scene 0."""
    plain = report_scene(0)
    cells = max(1, round((count / 2) ** 0.5))
    hills = terrain(
        lambda x, z: 0.2 * np.sin(5 * x) * np.cos(7 * z), 3.0, cells, [(np.inf, plain.planes[0].material)]
    )
    return dataclasses.replace(plain, planes=(), meshes=hills), SMALL, {"aa": 4}


def _lights(count: int) -> Job:
    """Scene 0 under lights on a circle, together as bright as one."""
    lights = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        lights.append(Light((10 * np.cos(angle), 10.0, 10 * np.sin(angle)), (1 / count,) * 3))
    return dataclasses.replace(report_scene(0), lights=tuple(lights)), SMALL, {"aa": 1}


def _bounces(limit: int) -> Job:
    return report_scene(3), SMALL, {"aa": 4, "integrator": {"type": "mrt_whitted", "max_depth": limit}}


SERIES: dict[str, Callable[[int], Job]] = {
    "pixels": _pixels,
    "samples a pixel": _samples,
    "spheres": _spheres,
    "triangles": _triangles,
    "lights": _lights,
    "bounces": _bounces,
}
FULL = Extent(
    {
        "pixels": tuple(side * side for side in (256, 512, 1024, 2048, 4096, 8192)),
        "samples a pixel": (1, 4, 16, 64, 256, 1024),
        "spheres": (10, 100, 1_000, 3_000, 10_000, 30_000, 100_000),
        "triangles": (100, 1_000, 10_000, 30_000, 100_000, 300_000, 1_000_000),
        "lights": (1, 3, 8, 30, 100, 300, 1_000),
        "bounces": (2, 3, 4, 5, 7, 10),
    },
    5,
)
QUICK = Extent({"pixels": (64**2, 128**2, 256**2), "triangles": (100, 1_000, 5_000), "lights": (1, 8, 40)}, 1)
