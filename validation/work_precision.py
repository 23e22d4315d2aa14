"""``error_vs_time``: what settings of ``render`` cost, how far off they are, and which is the fastest.

Each case is repeated with other seeds. Its pictures x₁ … x_R and two independent halves h₁, h₂ of the
reference give the matrix G[r, s] = mean (x_r − h₁)(x_s − h₂), in which the reference's own noise cancels. The
mean of its diagonal is the squared error, that of the rest the squared bias; the difference is the variance.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, UsageError, needs_extra
from mrt_mitsuba.options import is_path
from mrt_mitsuba.rendering.api import Result, render
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.compare import Array, Difference, compare, read_layer
from mrt_mitsuba.validation.study import Study, Values, notebook, save_report

TITLE = "Error against time"
LEAST = 0.05  # seconds that one timing takes: a shorter render is repeated, and the mean counts
REFERENCE_SEEDS = (2**20 + 1, 2**20 + 2)  # far from those of the repeats
RESOLVED = 2.0  # an error is known from this many times the reference's own error on
ERRORS = 4  # that the time is given for, unless they are chosen
NUMBER = r"=?[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?:/\d+)?"
NOTHING = 1e-15  # an RMSE of 0, as logarithms have it
LEVEL = 0.95  # of all intervals

Options = Mapping[str, Any]
Given = Any  # a scene, as ``render`` takes it, or a reference
Run = Callable[[Options, int], Result]  # a render with options and a seed
Timed = tuple[Result, float]  # a render, and its seconds without loading the scene
Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Point:
    """One case: what it costs and how far off it is. Of one repeat, intervals, variance and bias are NaN."""

    name: str
    seconds: float  #: median of warm renders, without loading the scene
    seconds_interval: Interval
    rmse: float  #: over all repeats
    rmse_interval: Interval
    variance: float  #: mean variance of a pixel between repeats
    bias: float  #: √(MSE − variance), 0 where noise explains the whole error
    bias_interval: Interval
    efficiency: float  #: 1 / (variance × seconds); NaN where nothing is random
    cold: float  #: seconds of a first run, its kernels compiled or read from a cache
    compile: float  #: seconds of that in the compiler
    rays: Mapping[str, int]
    image: Array  #: of the first repeat
    difference: Difference  #: of it from the reference
    reference_error: float

    @classmethod
    def of(cls, name: str, times: Array, gram: Array, **more: Any) -> Point:
        """The figures from the seconds of repeats and their matrix G; ``more``: the other fields."""
        seconds = float(np.median(times))
        squares = np.diag(gram)
        repeats = len(times)
        # The standard error of a median is at most √(π/2) times that of a mean
        slower = math.exp(math.sqrt(math.pi / 2) * _reach(np.log(times)))
        mse = max(float(squares.mean()), NOTHING**2)
        rmse = math.sqrt(mse)
        worse = math.exp(min(_reach(squares) / mse / 2, 99))
        # Pairs of different repeats: their mean varies as twice that of what they have in common
        pairs = (gram.sum(axis=1) - squares) / (repeats - 1 or math.nan)
        square = float(pairs.mean())
        width = 2 * _reach(pairs) if repeats > 2 else math.inf
        bias, low, high = np.sqrt(np.maximum([square, square - width, square + width], 0)).tolist()
        variance = float(np.maximum(mse - square, 0))
        return cls(
            name=name,
            seconds=seconds,
            seconds_interval=(seconds / slower, seconds * slower),
            rmse=rmse if rmse > NOTHING else 0.0,
            rmse_interval=(rmse / worse, rmse * worse),
            variance=variance,
            bias=bias,
            bias_interval=(low, high),
            efficiency=1 / variance / seconds if variance > 1e-12 * mse else math.nan,
            **more,
        )

    @property
    def family(self) -> str:
        """The name without its numbers: cases that differ in these alone are one curve."""
        return " ".join(re.sub(NUMBER, " ", self.name).split()) or self.name

    @property
    def resolved(self) -> bool:
        """Whether the error can be distinguished from the reference's own."""
        return self.rmse > RESOLVED * self.reference_error

    def row(self) -> Values:
        """The row of the table of all cases."""

        def interval(ends: Interval) -> str:
            return f"{ends[0]:.3g} to {ends[1]:.3g}" if np.isfinite(ends[0]) else "one repeat"

        return {
            "case": self.name,
            "seconds": self.seconds,
            "interval, s": interval(self.seconds_interval),
            "cold, s": self.cold,
            "of it compiling, s": self.compile,
            "RMSE": self.rmse if self.resolved else "at the floor",
            "interval": interval(self.rmse_interval) if self.resolved else "",
            "|bias|": self.bias,
            "interval of it": interval(self.bias_interval),
            "1 / (variance × s)": self.efficiency,
            "relMSE": self.difference.rel_mse,
            "largest": self.difference.largest,
            "FLIP": self.difference.flip,
            "rays": sum(self.rays.values()),
        }


@dataclass(frozen=True)
class Findings:
    """The findings of ``error_vs_time`` about several cases."""

    scene: str
    points: Mapping[str, Point]
    failed: Mapping[str, str]  #: why, by case
    reference: Array
    reference_error: float  #: RMSE of the reference itself, below which nothing is claimed; 0: exact
    repeats: int
    errors: Sequence[float]  #: for which the time is given
    took: float = 0.0

    @property
    def families(self) -> dict[str, list[Point]]:
        """The points of each curve, fastest first."""
        groups: dict[str, list[Point]] = {point.family: [] for point in self.points.values()}
        for point in sorted(self.points.values(), key=attrgetter("seconds")):
            groups[point.family].append(point)
        return groups

    def time_to(self, error: float) -> dict[str, tuple[float, ...]]:
        """When each curve comes down to an RMSE, in seconds with an interval; infinite if never.

        The interval is from where the lower ends of all intervals come so low to where the upper ends do.
        """
        times = {}
        for name, points in self.families.items():
            seconds = np.transpose([(p.seconds, *p.seconds_interval) for p in points])  # [3, points]
            errors = np.transpose([(p.rmse, *p.rmse_interval) for p in points])
            times[name] = tuple(_crossing(*curve, error) for curve in zip(seconds, errors, strict=True))
        return times

    @property
    def verdicts(self) -> list[str]:
        """A sentence for each of ``errors``; it names a winner only if its interval meets no other."""
        if self.repeats < 2:
            return ["No verdict on time: a single repeat has no interval."]
        sentences = []
        for error in self.errors:
            reached = {name: t for name, t in self.time_to(error).items() if math.isfinite(t[0])}
            best, *others = sorted(reached, key=reached.__getitem__) or [""]
            like = [name for name in others if not reached[best][2] < reached[name][1]]
            if like:
                verdict = f"no winner, for the intervals overlap: {', '.join([best, *like])}"
            elif others:
                longer = f"{reached[others[0]][0] / reached[best][0]:.2g} times as long"
                verdict = f"{best} is the fastest, {_shown(*reached[best])} s; {others[0]} takes {longer}"
            elif best:
                verdict = f"only {best} comes so low, in {_shown(*reached[best])} s"
            else:
                verdict = "no case comes so low"
            sentences.append(f"RMSE of {error:g}: {verdict}.")
        return sentences

    def advice(self) -> list[Values]:
        """A row for each of ``errors``: the case that gets there first, and the next other curve."""
        rows = []
        fastest_first = sorted(self.points.values(), key=attrgetter("seconds"))
        for error in self.errors:
            low = [p for p in fastest_first if p.rmse <= error]
            others = [p for p in low if p.family != low[0].family]
            row: Values = {"to get to an error of": error, "use": "nothing comes so low"}
            row |= {"seconds": None, "next best": None, "which takes": None}
            if low:
                row["use"] = low[0].name
                row["seconds"] = _shown(low[0].seconds, *low[0].seconds_interval)
            if others:
                times = others[0].seconds / low[0].seconds
                row["next best"] = others[0].name
                row["which takes"] = f"{times:.2g} times as long" if times > 1.05 else "as long"
            rows.append(row)
        return rows

    def __str__(self) -> str:
        width = max(map(len, [*self.points, *self.failed]), default=0)
        lines = [
            f"{p.name:<{width}}  {_shown(p.seconds, *p.seconds_interval)} s, "
            f"RMSE {_shown(p.rmse, *p.rmse_interval)}"
            for p in self.points.values()
        ]
        lines += [f"{name:<{width}}  FAILED {why}" for name, why in self.failed.items()]
        own = f"{self.reference_error:.2g}" if self.reference_error else "not known"
        return "\n".join([*lines, f"the reference's own error: {own}", *self.verdicts])

    def study(self) -> Study:
        """The findings in the form that pages are made of."""
        scene = f"scene {self.scene}" if self.scene.isdigit() else self.scene
        study = Study("error-vs-time", f"{TITLE}: {scene}", seconds=self.took)
        describe(study, self, "", "All cases")
        return study

    @needs_extra()
    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the page (``index.html``), ``summary.json``, CSV files and plots. Raises ``OutputError``."""
        save_report(folder, self.study(), title=TITLE)

    @needs_extra()
    def _repr_html_(self) -> str:
        return notebook(self.study(), title=TITLE)


def _reach(values: Array) -> float:
    """How far Student's interval goes to each side of the mean of values; NaN of a single one."""
    from scipy import stats

    if len(values) < 2:
        return math.nan
    return float(stats.t.ppf((1 + LEVEL) / 2, len(values) - 1) * stats.sem(values))


def _crossing(seconds: Array, errors: Array, error: float) -> float:
    """When a curve of seconds and RMSEs comes down to an error, infinity if it does not.

    Between its points it is straight in logarithms; beyond them nothing is assumed.
    """
    down = errors < np.minimum.accumulate([math.inf, *errors[:-1]])
    if not down.any():  # NaN: a single repeat has no interval
        return math.nan
    depths = -np.log(np.maximum(errors[down], NOTHING))
    times = np.log(seconds[down])
    # an error that is met to rounding is met
    return float(np.exp(np.interp(-math.log(error * (1 + 1e-9)), depths, times, right=math.inf)))


def _shown(value: float, low: float, high: float) -> str:
    if math.isinf(value):
        return "not reached"
    return f"{value:.3g}" if math.isnan(low) else f"{value:.3g} ({low:.3g} to {high:.3g})"


# ---------------------------------------------- Measuring ----------------------------------------------


@needs_extra()
def error_vs_time(
    scene: Given,
    cases: Mapping[str, Options],
    *,
    reference: Given,
    repeats: int = 5,
    shared: Options | None = None,
    errors: Sequence[float] | None = None,
    cold: bool = True,
    progress: Progress | None = None,
) -> Findings:
    """Measure the error and the time of settings of ``render``.

    Args:
        scene: whatever ``render`` takes.
        cases: options of ``render`` by a name; names that differ in numbers only make one curve. A case may
            bring a ``scene`` of its own, of the same size.
        reference: options that give the truth. Where something is random, it is rendered as two halves of
            its ``spp``, with other seeds, and their difference is its own error; elsewhere a render with
            ``aa`` less by one is compared. Two sets of options, the better first: what they differ by bounds
            the error of the first. Or a picture: an array, the path of an EXR or a ``Result``, whose error is
            read from its layer "error".
        repeats: with other seeds, in turn, after a cold and a warm run of each case. A render of less than
            0.05 s is timed as the mean of several.
        shared: options of all cases and of the reference.
        errors: RMSEs to give the time for; by default four over the range that was measured.
        cold: whether the kernels of each case are compiled anew for its first run, which takes longer.

    A case that fails is kept, with the reason. Raises ``UsageError`` for wrong arguments, and what
    ``render`` raises for the reference.
    """
    start = time.perf_counter()
    shared = shared or {}
    if not cases or repeats < 1:
        raise UsageError("error_vs_time needs at least one case and one repeat")
    for name, options in {"shared": shared, **cases}.items():
        if "seed" in options:
            raise UsageError(f"{name} sets a seed: repeats have seeds of their own; leave it out")
    run = _runner(scene, shared)
    *halves, own_error = _reference(reference, run)
    for error in errors or ():
        if not error > RESOLVED * own_error:
            raise UsageError(
                f"no claim can be made about an RMSE of {error:g}: the reference's own error is "
                f"{own_error:.2g}, and only errors above twice that stand out; take a better reference"
            )
    runs, failed = _measure(run, cases, halves[0], repeats, cold, progress or Progress())
    points = {name: _point(name, found, repeats, halves, own_error) for name, found in runs.items()}
    known = [p.rmse for p in points.values() if p.resolved and p.rmse > 1e-9]
    if errors is None and known:  # rounded up, so that there is a case that comes so low
        inside = np.geomspace(max(known), min(known), ERRORS + 2)[1:-1]
        errors = list(dict.fromkeys(float(f"{1.05 * e:.1e}") for e in inside))
    return Findings(
        scene=next((result.plan.scene for (result, _), *_ in runs.values()), "scene"),
        points=points,
        failed=failed,
        reference=np.mean(halves, axis=0),
        reference_error=own_error,
        repeats=repeats,
        errors=list(errors or ()),
        took=time.perf_counter() - start,
    )


def _runner(scene: Given, shared: Options) -> Run:
    """A function that renders cases, each scene loaded once where it can be."""
    variant = runtime.use(shared.get("variant"))
    loaded = {}  # by the id of what a scene is loaded from, which the caller holds

    def run(options: Options, seed: int) -> Result:
        given = {
            "scene": scene,
            "variant": variant,
            "progress": Progress(),
            **shared,
            **options,
            "seed": seed,
        }
        one = given.pop("scene")
        loadable = isinstance(one, dict) or is_path(one, ".xml")
        if loadable and given["variant"] == variant and "params" not in given:
            if id(one) not in loaded:
                loaded[id(one)] = open_scene(one, integrator=given.get("integrator")).scene
            one = loaded[id(one)]
        return render(one, **given)

    return run


def _reference(reference: Given, run: Run) -> tuple[Array, Array, float]:
    """Two independent halves of the reference, or twice the same picture; and its own error."""
    if isinstance(reference, Mapping):
        spp = {"spp": int(reference["spp"]) // 2} if reference.get("spp", 1) > 1 else {}
        results = [run({**reference, **spp}, seed) for seed in REFERENCE_SEEDS]
        first, second = map(_picture, results)
        aa = results[0].options["aa"]
        if aa == 1 or (first != second).any():
            return first, second, compare(first, second).rmse / 2
        reference = reference, {**reference, "aa": aa - 1}
    if isinstance(reference, Sequence) and not isinstance(reference, str):
        first, second = (_picture(run(r, s)) for r, s in zip(reference, REFERENCE_SEEDS, strict=True))
        return first, first, compare(first, second).rmse
    picture, variance, _ = read_layer(reference)
    return picture, picture, 0.0 if variance is None else float(variance.mean()) ** 0.5


def _picture(result: Result) -> Array:
    bad = np.argwhere(~np.isfinite(result.image).all(axis=-1))
    if len(bad):
        raise MrtError(f"{len(bad)} pixels are NaN or infinite, the first at {tuple(bad[0].tolist())}")
    return np.asarray(result.image, np.float64)


def _measure(
    run: Run, cases: Mapping[str, Options], truth: Array, repeats: int, cold: bool, progress: Progress
) -> tuple[dict[str, list[Timed]], dict[str, str]]:
    """The results of cases, of which the last ``repeats`` count, and why others failed.

    Each runs first, perhaps with its kernels compiled anew and once more, then ``repeats`` times in turn, so
    that a load on the machine meets all alike.
    """
    import drjit as dr

    failed: dict[str, str] = {}
    runs: dict[str, list[Timed]] = {name: [] for name in cases}
    first = -2 if cold else -1
    with progress.stage(TITLE, len(cases) * (repeats - first)) as advance:
        for turn in range(first, repeats):
            for name in list(runs):
                try:
                    if cold and turn == first:
                        dr.flush_kernel_cache()
                    seconds: list[float] = []
                    while not seconds or (turn >= 0 and sum(seconds) < LEAST):
                        result = run(cases[name], max(turn, 0))
                        seconds.append(result.timings.total - result.timings.load)
                    picture = _picture(result)
                    if turn == first:
                        compare(picture, truth)  # raises for another size
                    runs[name].append((result, float(np.mean(seconds))))
                except Exception as error:
                    failed[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    del runs[name]
                advance(1)
    return runs, failed


def _point(
    name: str, runs: Sequence[Timed], repeats: int, halves: Sequence[Array], own_error: float
) -> Point:
    """The figures of a case; its first run was cold, its last ``repeats`` count."""
    results, seconds = zip(*runs, strict=True)
    counted = results[-repeats:]
    image = counted[0].image
    pictures = np.array([result.image for result in counted], np.float64)  # [repeats, H, W, 3]
    errors = [(pictures - half).reshape(len(pictures), -1) for half in halves]
    gram = errors[0] @ errors[1].T / errors[0].shape[1]
    return Point.of(
        name,
        np.array(seconds[-repeats:]),
        (gram + gram.T) / 2,
        cold=seconds[0],
        compile=results[0].timings.compile,
        rays=dict(counted[0].rays),
        image=image,
        difference=compare(image, np.mean(halves, axis=0)),
        reference_error=own_error,
    )


# ------------------------------------------------ The page ------------------------------------------------


def describe(study: Study, found: Findings, name: str, title: str, truth: str = "") -> None:
    """Add the diagram, the answers and the tables to a study; ``truth`` says what the reference is."""
    prefix = name and f"{name}-"
    where = name and f"{name}: "
    study.at_most(f"{where}cases that failed", len(found.failed), 0, "each of them could be rendered")
    if found.failed:
        reasons = [{"case": case, "why": why} for case, why in found.failed.items()]
        study.records(f"{prefix}failed", f"{title}: cases that failed", reasons)
    if not found.points:
        return
    own = f"about {found.reference_error:.2g}; no claim is made below twice that"
    caption = (
        "Down and to the left is better. Yellow: the best at each error; grey: curves that are never the "
        f"best. Bars: 95 % intervals. Reference: {truth or 'as given'}. Its own RMSE is "
        f"{own if found.reference_error else 'not known'}. "
    )
    caption += " ".join(found.verdicts)
    drawn = plotting.work_precision(title, found)
    study.picture(f"{prefix}diagram", f"{title}: work and precision", drawn, caption)
    if found.errors:
        study.records(f"{prefix}advice", f"{title}: what to use", found.advice(), first=not name)
        reached = {f"RMSE {error:g}": found.time_to(error) for error in found.errors}
        times = [
            {"curve": curve} | {what: _shown(*t[curve]) for what, t in reached.items()}
            for curve in found.families
        ]
        note = "With 95 % intervals. Between cases, curves are straight in logarithms; beyond, unknown."
        study.records(f"{prefix}times", f"{title}: seconds to an error", times, note, first=not name)
    note = "Medians of warm renders without loading the scene; cold: a first run. Errors in linear light."
    points = [point.row() for curve in found.families.values() for point in curve]
    study.records(f"{prefix}points", f"{title}: every case", points, note)
