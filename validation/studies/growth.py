"""How time grows with the size of the task, and that the length of the code does not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Light, Scene
from mrt_mitsuba.scene.report import report_scene, scene_of_spheres
from mrt_mitsuba.scene.shapes import terrain
from mrt_mitsuba.validation.tools import kernels
from mrt_mitsuba.validation.tools.gallery import panels
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
    """The cost of one size."""

    warm: Warm
    kernels: int  # different ones
    operations: int  # of them together
    compile: float  # seconds

    def row(self, what: str, size: int) -> dict[str, Any]:
        """Return a row of the study's table."""
        times = {"seconds": self.warm.seconds, "spread": self.warm.spread, "compile, s": self.compile}
        code = {"kernels": self.kernels, "operations": self.operations}
        return {"what grows": what, "size": size, **times, **code}


@dataclass(frozen=True)
class Exponent:
    """How time grows with size: the slope of a straight line through the logarithms."""

    value: float
    half_width: float  # of its confidence interval
    scale: float  # seconds at size 1
    sizes: Sequence[int]  # that it was fitted over

    @property
    def low(self) -> float:
        return self.value - self.half_width

    @property
    def high(self) -> float:
        return self.value + self.half_width

    def reading(self) -> str:
        """Return what can be concluded from the interval."""
        if self.low <= 0:
            unknown = "too uncertain: it may not grow, or grow in proportion"
            return "consistent with no growth" if self.high < 1 else unknown
        if self.low <= 1 <= self.high:
            return "consistent with growth in proportion"
        than = "less" if self.high < 1 else "more"
        return f"ten times as much takes {10**self.value:.2g} times as long: {than} than in proportion"


def run(study: Study, *, quick: bool) -> None:
    """Fill the study. A quick one gives no times: it holds the code alone."""
    extent = QUICK if quick else FULL
    series: dict[str, dict[int, Found]] = {what: {} for what in extent.sizes}
    jobs = [(what, size) for what, sizes in extent.sizes.items() for size in sizes]
    for what, size in study.each("Growth", jobs):
        series[what][size] = _measure(SERIES[what](size), extent.repeats)
    if extent.repeats > 1:
        _exponents(study, series)
    rows = [series[what][size].row(what, size) for what, size in jobs]
    note = (
        "Seconds: medians of warm renders. Kernels and operations: different kernels, and the length of "
        "their code."
    )
    study.records("growth", "Time and code against the size of the task", rows, note)
    for what, found in series.items():
        *smaller, largest = found.values()
        for name, limit in (("operations", MOST_CODE), ("kernels", 1)):
            title = f"{what}: {name} at {max(found)} / at smaller sizes"
            why = "numbers are data, not code; a loop that is unrolled makes it as many times longer"
            study.at_most(title, getattr(largest, name) / max(getattr(f, name) for f in smaller), limit, why)


def _exponents(study: Study, series: Mapping[str, Mapping[int, Found]]) -> None:
    exponents = {what: fit({n: f.warm.seconds for n, f in found.items()}) for what, found in series.items()}
    title = "Exponents of growth, over the larger half of the sizes"
    columns = ("what grows", "from", "to", "exponent", f"{LEVEL:.0%} interval", "reading")
    rows = [
        (what, e.sizes[0], e.sizes[-1], e.value, f"{e.low:.2f} to {e.high:.2f}", e.reading())
        for what, e in exponents.items()
    ]
    note = (
        "Exponent 1: in proportion; 0: no growth. The interval is that of the slope of a straight line "
        "through the logarithms; wide where that is no straight line."
    )
    study.table("exponents", title, columns, rows, note, first=True)
    largest = [f"{max(f)} {what} in {f[max(f)].warm.seconds:.2g} s" for what, f in series.items()]
    caption = f"The largest of each: {', '.join(largest)}. The line is the fit."
    study.plot("growth", "Time against the size of the task", _figure(series, exponents), caption)


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


def fit(seconds: Mapping[int, float]) -> Exponent:
    """Return the exponent of time over size, of the larger half of the sizes, and at least four of them."""
    sizes = sorted(seconds)[-max(4, (len(seconds) + 1) // 2) :]
    line = stats.linregress(np.log(sizes), np.log([seconds[n] for n in sizes]))
    freedom = len(sizes) - 2
    spread = stats.t.ppf((1 + LEVEL) / 2, freedom) * line.stderr if freedom > 0 else float("inf")
    return Exponent(float(line.slope), float(spread), float(np.exp(line.intercept)), sizes)


def _figure(series: Mapping[str, Mapping[int, Found]], exponents: Mapping[str, Exponent]) -> Any:
    rows = -(-len(series) // 2)
    figure, grid = panels(9, 2.6 * rows, rows, 2, squeeze=False)
    axes = grid.ravel()
    for axis in axes[len(series) :]:
        axis.remove()
    for axis, (what, found) in zip(axes, series.items(), strict=False):
        e = exponents[what]
        seconds = [f.warm.seconds for f in found.values()]
        axis.loglog(list(found), seconds, "o", markersize=4)
        ends = np.array([e.sizes[0], e.sizes[-1]], float)
        axis.loglog(ends, e.scale * ends**e.value, "-", color="0.4", linewidth=1)
        for of_axis, values in ((axis.xaxis, list(found)), (axis.yaxis, seconds)):
            low, high = np.log10([min(values), max(values)])
            of_axis.set_view_interval(10 ** np.floor(low), 10 ** np.ceil(high + 1e-9), ignore=True)
            of_axis.set_minor_formatter("")
        axis.set_title(f"{what}: {e.value:.2f} ± {e.half_width:.2f}", fontsize=10)
        axis.set_ylabel("seconds", fontsize=9)
        axis.tick_params(labelsize=9)
        axis.grid(alpha=0.3)
    return figure


# -------------------------------------------- What grows --------------------------------------------


SMALL, WHITTED = (160, 120), {"type": "mrt_whitted"}


def _triangles(count: int) -> Job:
    """Return hills under the camera and the lights of scene 0."""
    plain = report_scene(0)
    cells = max(1, round((count / 2) ** 0.5))
    hills = terrain(
        lambda x, z: 0.2 * np.sin(5 * x) * np.cos(7 * z), 3.0, cells, [(np.inf, plain.planes[0].material)]
    )
    return dataclasses.replace(plain, planes=(), meshes=hills), SMALL, {"aa": 4}


def _lights(count: int) -> Job:
    """Return scene 0 under lights on a circle, together as bright as one."""
    angles = 2 * np.pi * np.arange(count) / count
    lights = [Light((10 * np.cos(a), 10.0, 10 * np.sin(a)), (1 / count,) * 3) for a in angles.tolist()]
    return dataclasses.replace(report_scene(0), lights=tuple(lights)), SMALL, {"aa": 1}


SERIES: dict[str, Callable[[int], Job]] = {
    "pixels": lambda n: (report_scene(3), (round(n**0.5), round(n**0.5)), {"aa": 1}),
    "samples a pixel": lambda n: (report_scene(3), SMALL, {"aa": round(n**0.5)}),
    "spheres": lambda n: (scene_of_spheres(n), SMALL, {"aa": 4}),
    "triangles": _triangles,
    "lights": _lights,
    "bounces": lambda n: (report_scene(3), SMALL, {"aa": 4, "integrator": {**WHITTED, "max_depth": n}}),
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
