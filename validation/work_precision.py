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
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, MrtWarning, UsageError, needs_extra
from mrt_mitsuba.options import is_path
from mrt_mitsuba.rendering.api import Result, render
from mrt_mitsuba.rendering.film import derived_seed
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.compare import Array, compare, read_layer
from mrt_mitsuba.validation.page import save_report
from mrt_mitsuba.validation.study import Study, Values

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Error against time"
MIN_SECONDS = 0.05  # that one timing takes: a shorter render is repeated, and the mean counts
RESOLVED = 2.0  # an error is known from this many times the reference's own error on
ERRORS = 4  # number of errors for which the time is given
MAX_DOUBLINGS = 8  # of the rays of reference="auto"
MIN_RMSE = 1e-15  # a smaller one is 0, which has no logarithm

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
    cold: float  #: seconds of the first run, its kernels compiled or read from a cache
    image: Array  #: of the first repeat
    reference_error: float

    @classmethod
    def of(cls, name: str, times: Array, gram: Array, **more: Any) -> Point:
        """Return the figures from the seconds of repeats and their matrix G; ``more``: the other fields."""
        seconds = float(np.median(times))
        squares = np.diag(gram)
        repeats = len(times)
        # The standard error of a median is at most √(π/2) times that of a mean
        slower = math.exp(math.sqrt(math.pi / 2) * _reach(np.log(times)))
        mse = max(float(squares.mean()), MIN_RMSE**2)
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
            rmse=rmse if rmse > MIN_RMSE else 0.0,
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
        return re.sub(r"=?[+-]?\d[\w.%/+-]*", "", self.name).strip(" ,") or self.name

    @property
    def resolved(self) -> bool:
        """True if the error can be distinguished from the reference's own."""
        return self.rmse > RESOLVED * self.reference_error

    def row(self) -> Values:
        """Return the row of the table of all cases."""
        return {
            "case": self.name,
            "seconds": self.seconds,
            "interval, s": _interval(*self.seconds_interval),
            "cold, s": self.cold,
            "RMSE": self.rmse if self.resolved else "not resolved",
            "interval": _interval(*self.rmse_interval) if self.resolved else "",
            "|bias|": self.bias,
            "interval of it": _interval(*self.bias_interval),
            "1 / (variance × s)": self.efficiency,
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
    took: float = 0.0  #: seconds, in all

    @property
    def families(self) -> dict[str, list[Point]]:
        """The points of each curve, fastest first."""
        groups: dict[str, list[Point]] = {point.family: [] for point in self.points.values()}
        for point in sorted(self.points.values(), key=attrgetter("seconds")):
            groups[point.family].append(point)
        return groups

    @property
    def errors(self) -> list[float]:
        """RMSEs over the range that was measured, for which the time is given."""
        known = [p.rmse for p in self.points.values() if p.resolved and p.rmse > 1e-9]
        if not known:
            return []
        inside = np.geomspace(max(known), min(known), ERRORS + 2)[1:-1]
        # rounded up, so that there is a case that comes so low
        return list(dict.fromkeys(float(f"{1.05 * e:.1e}") for e in inside))

    @property
    def warning(self) -> str:
        """Warning naming cases that the reference is too coarse for, else ""."""
        own = self.reference_error
        coarse = [p.name for p in self.points.values() if not p.resolved and max(p.rmse, own) > 0]
        if not coarse:
            return ""
        return (
            f"The reference is too coarse, its own RMSE is {own:.2g}: nothing can be said about "
            f'{", ".join(coarse)}; use more rays for it, or reference="auto".'
        )

    def time_to(self, error: float) -> dict[str, tuple[float, float, float]]:
        """Seconds of each curve to come down to an RMSE, with their interval; infinite where none do.

        The ends of the interval are those of a curve that is as low, or as high, as its intervals allow.
        """
        times: dict[str, Any] = {}
        for name, points in self.families.items():
            seconds = np.transpose([(p.seconds, *p.seconds_interval) for p in points])  # [3, points]
            errors = np.transpose([(p.rmse, *p.rmse_interval) for p in points])
            times[name] = tuple(_crossing(*curve, error) for curve in zip(seconds, errors, strict=True))
        return times

    def verdict(self, error: float) -> str:
        """Say which case is the fastest to an error, how long it takes, and what comes next.

        There is no winner where the intervals of other curves overlap with that of the first.
        """
        (best, times), *others = sorted(self.time_to(error).items(), key=itemgetter(1))
        if math.isinf(times[0]):
            return f"RMSE of {error:g}: nothing comes so low."
        rivals = [name for name, (_, least, _) in others if not times[2] < least]
        if rivals:
            return f"RMSE of {error:g}: no winner: {'; '.join([best, *rivals])}, {_shown(*times)} s."
        case = next(p.name for p in self.families[best] if p.rmse <= error * (1 + 1e-9))
        sentence = f"RMSE of {error:g}: {case}, {_shown(*times)} s"
        if others and math.isfinite(others[0][1][0]):
            sentence += f"; {others[0][0]} takes {others[0][1][0] / times[0]:.2g} times as long"
        return f"{sentence}."

    @property
    def verdicts(self) -> list[str]:
        """A sentence for each of ``errors``; it names a winner only if its interval meets no other."""
        if self.repeats < 2:
            return ["No verdict on time: a single repeat has no interval."]
        if self.points and not self.errors:
            return ["No verdict on time: no case has an error that the reference can resolve."]
        return [self.verdict(error) for error in self.errors]

    def __str__(self) -> str:
        lines = [self.warning] if self.warning else []
        for p in self.points.values():
            error = _shown(p.rmse, *p.rmse_interval)
            lines.append(f"{p.name:<20}  {_shown(p.seconds, *p.seconds_interval)} s, RMSE {error}")
        lines += [f"{name:<20}  FAILED {why}" for name, why in self.failed.items()]
        own = f"{self.reference_error:.2g}" if self.reference_error else "not known"
        return "\n".join([*lines, f"the reference's own error: {own}", *self.verdicts])

    @needs_extra()
    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the page (``index.html``), ``summary.json``, CSV files and plots. Raises ``OutputError``."""
        scene = f"scene {self.scene}" if self.scene.isdigit() else self.scene
        study = Study("error-vs-time", f"{TITLE}: {scene}", seconds=self.took)
        describe(study, self, "All cases")
        save_report(folder, study, title=TITLE)


def _reach(values: Array) -> float:
    """Half width of Student's 95 % interval of the mean of values; NaN of a single one."""
    from scipy import stats

    if len(values) < 2:
        return math.nan
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))


def _crossing(seconds: Array, errors: Array, error: float) -> float:
    """When a curve of seconds and RMSEs comes down to an error, infinity if it does not.

    Between its points it is straight in logarithms; beyond them nothing is assumed.
    """
    down = errors < np.minimum.accumulate([math.inf, *errors[:-1]])
    if not down.any():  # NaN: a single repeat has no interval
        return math.nan
    depths = -np.log(np.maximum(errors[down], MIN_RMSE))
    times = np.log(seconds[down])
    # an error that is met to rounding is met
    return float(np.exp(np.interp(-math.log(error * (1 + 1e-9)), depths, times, right=math.inf)))


def _interval(low: float, high: float) -> str:
    return "" if math.isnan(low) else f"({low:.3g} to {high:.3g})"


def _shown(value: float, low: float, high: float) -> str:
    return f"{value:.3g} {_interval(low, high)}".strip()


# ----------------------------------------------- Reference -----------------------------------------------


Truth = tuple[Array, Array, float]  # two independent halves, or twice the same picture; its own RMSE


def _automatic(run: Run, cases: Mapping[str, Options], step: int) -> Truth:
    """Render the scene by its own integrator, with more rays than the cases, doubled ``step`` times."""
    options: dict[str, Any] = {"aamode": "none", "target": None}
    amount = "spp"
    least = 16
    if run(options, 0).options["lattice"] != "film":
        options["lattice"] = "centered"
        amount = "aa"
        least = 4
    most = max(int(case.get(amount) or least) for case in cases.values())
    return _rendered(run, {**options, amount: 2 * most * 2**step})


def _rendered(run: Run, options: Options) -> Truth:
    """Render half of the rays twice, with other seeds; where nothing is random, ``aa`` and a quarter less.

    Odd multiples of an ``aa`` share samples, and with them errors.
    """
    spp = int(options.get("spp") or 1)
    half = {**options, "spp": spp // 2} if spp > 1 else options
    results = [run(half, derived_seed(0, reference=part)) for part in (1, 2)]
    first, second = map(_picture, results)
    aa = results[0].options["aa"]
    if aa == 1 or not np.array_equal(first, second):
        return first, second, compare(first, second).rmse / 2
    coarse = _picture(run({**options, "aa": aa * 3 // 4}, 0))
    return first, first, compare(first, coarse).rmse


def _picture(result: Result) -> Array:
    bad = np.argwhere(~np.isfinite(result.image).all(axis=-1))
    if len(bad):
        raise MrtError(f"{len(bad)} pixels are NaN or infinite, the first at {tuple(bad[0].tolist())}")
    return np.asarray(result.image, np.float64)


# ----------------------------------------------- Measuring -----------------------------------------------


@needs_extra()
def error_vs_time(
    scene: Given,
    cases: Mapping[str, Options],
    *,
    reference: Given = "auto",
    repeats: int = 5,
    shared: Options | None = None,
    progress: Progress | None = None,
) -> Findings:
    """Measure the error and the time of settings of ``render``.

    Args:
        scene: whatever ``render`` takes.
        cases: options of ``render`` by a name; names that differ in numbers only make one curve. A case may
            bring a ``scene`` of its own, of the same size.
        reference: "auto" renders the scene by its own integrator, with more and more rays until the error of
            each case is at least twice the reference's own. Or options that give the truth: where something
            is random, it is rendered as two halves of its ``spp``, with other seeds, and their difference is
            its own error; elsewhere a render with an ``aa`` less by a quarter is compared. Or a picture: an
            array, the path of an EXR or a ``Result``, whose error is read from its layer "error".
        repeats: with other seeds, in turn, after a first run of each case. A render of less than 0.05 s is
            timed as the mean of several.
        shared: options of all cases and of the reference.

    A case that fails is kept, with the reason. Warns where a reference is too coarse for a case. Raises
    ``UsageError`` for wrong arguments, and what ``render`` raises for the reference.
    """
    start = time.perf_counter()
    shared = shared or {}
    if not cases or repeats < 1:
        raise UsageError("error_vs_time needs at least one case and one repeat")
    for name, options in {"shared": shared, **cases}.items():
        if "seed" in options:
            raise UsageError(f"{name} sets a seed: repeats have seeds of their own; leave it out")
    run = _runner(scene, shared)
    automatic = isinstance(reference, str) and reference == "auto"
    if automatic:
        *halves, own_error = _automatic(run, cases, 0)
    elif isinstance(reference, Mapping):
        *halves, own_error = _rendered(run, reference)
    else:
        picture, variance, _ = read_layer(reference)
        halves = [picture, picture]
        own_error = 0.0 if variance is None else float(variance.mean()) ** 0.5
    runs, failed = _measure(run, cases, halves[0], repeats, progress or Progress())
    points = _points(runs, halves, own_error)
    for step in range(1, MAX_DOUBLINGS + 1 if automatic else 1):
        if own_error < min((p.rmse for p in points.values() if p.rmse), default=math.inf) / RESOLVED:
            break
        *halves, own_error = _automatic(run, cases, step)
        points = _points(runs, halves, own_error)
    found = Findings(
        scene=next((result.plan.scene for (result, _), *_ in runs.values()), "scene"),
        points=points,
        failed=failed,
        reference=np.mean(halves, axis=0),
        reference_error=own_error,
        repeats=repeats,
        took=time.perf_counter() - start,
    )
    if found.warning:
        warnings.warn(found.warning, MrtWarning, stacklevel=2)
    return found


def _runner(scene: Given, shared: Options) -> Run:
    """Return a function that renders cases; it loads each scene once for each set of parameters."""
    variant = runtime.use(shared.get("variant"))
    loaded: dict[tuple[int, str], tuple[Any, Options]] = {}

    def run(options: Options, seed: int) -> Result:
        given = {"scene": scene, "variant": variant, "progress": Progress(), **shared, **options}
        one = given.pop("scene")
        if (isinstance(one, dict) or is_path(one, ".xml")) and given["variant"] == variant:
            params = given.pop("params", None)
            key = id(one), repr(params)  # the caller holds the scene
            if key not in loaded:
                source = open_scene(one, integrator=given.get("integrator"), params=params)
                focus: Options = {"focaldist": source.focal_distance, "focalrange": source.focal_range}
                loaded[key] = source.scene, focus if source.focal_distance is not None else {}
            one, focus = loaded[key]
            given = {**focus, **given}
        return render(one, **given, seed=seed)

    return run


def _measure(
    run: Run, cases: Mapping[str, Options], truth: Array, repeats: int, progress: Progress
) -> tuple[dict[str, list[Timed]], dict[str, str]]:
    """Return the results of cases, of a first run and ``repeats``, and why others failed.

    Repeats take turns, so that a load on the machine meets all alike.
    """
    failed: dict[str, str] = {}
    runs: dict[str, list[Timed]] = {name: [] for name in cases}
    with progress.stage(TITLE, len(cases) * (repeats + 1)) as advance:
        for turn in range(-1, repeats):
            for name in list(runs):
                try:
                    seconds: list[float] = []
                    while not seconds or (turn >= 0 and sum(seconds) < MIN_SECONDS):
                        result = run(cases[name], derived_seed(0, repeat=max(turn, 0)))
                        seconds.append(result.timings.total - result.timings.load)
                    compare(_picture(result), truth)  # raises for another size
                    runs[name].append((result, float(np.mean(seconds))))
                except Exception as error:
                    failed[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    del runs[name]
                advance(1)
    return runs, failed


def _points(
    runs: Mapping[str, Sequence[Timed]], halves: Sequence[Array], own_error: float
) -> dict[str, Point]:
    """Return the figures of cases, by name; their first run, which compiles, does not count."""
    points = {}
    for name, (first, *counted) in runs.items():
        pictures = np.array([result.image for result, _ in counted], np.float64)  # [repeats, H, W, 3]
        errors = [(pictures - half).reshape(len(pictures), -1) for half in halves]
        gram = errors[0] @ errors[1].T / errors[0].shape[1]
        seconds = np.array([taken for _, taken in counted])
        more = {"cold": first[1], "image": counted[0][0].image, "reference_error": own_error}
        points[name] = Point.of(name, seconds, (gram + gram.T) / 2, **more)
    return points


# ------------------------------------------------ The page ------------------------------------------------


def frontier(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other one beats in both time and error, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=attrgetter("seconds", "rmse")):
        if not best or point.rmse < best[-1].rmse:
            best.append(point)
    return [point for point in best if point.resolved or not point.reference_error]


def diagram(title: str, found: Findings) -> Figure:
    """Draw the error of each case over its seconds; down and to the left is better.

    Curves that are the best at some error are coloured. Bars are intervals, the band at the bottom is the
    reference's own error.
    """
    drawn, axes = plotting.panel(title, 5.0, 5.2)
    plotting.logarithmic(axes, "seconds of a warm render", "error (RMSE, linear)")
    points = list(found.points.values())
    best = frontier(points)
    bottom = 0.7 * min([e for e in (found.reference_error, *(p.rmse for p in points)) if e], default=1e-6)
    axes.plot([p.seconds for p in best], [p.rmse for p in best], color="#ffd34d", linewidth=7, alpha=0.6)
    colors = dict(zip(dict.fromkeys(p.family for p in best), plotting.COLORS, strict=False))
    for marker, (family, curve) in zip(cycle("osD^vPXh"), found.families.items()):
        at = np.array([(p.seconds, max(p.rmse, bottom)) for p in curve])  # [points, 2]
        ends = np.array([(p.seconds_interval, p.rmse_interval) for p in curve])  # [points, 2, 2]
        bars = np.nan_to_num(abs(ends - at[:, :, None])).transpose(1, 2, 0)
        color = colors.get(family, plotting.GREY)
        x, y = at.T
        axes.errorbar(
            x, y, bars[1], bars[0], label=family, color=color, marker=marker, markersize=4, elinewidth=0.8
        )
    if found.reference_error:
        label = "within the reference's own error"
        axes.axhspan(bottom / 10, found.reference_error, color="0.9", zorder=0, label=label)
    axes.set_ylim(bottom=0.8 * bottom)
    if len(points) == 1:  # a single value spans no axis
        axes.set_xlim(points[0].seconds / 2, 2 * points[0].seconds)
    plotting.plain_numbers(axes)
    plotting.legend(axes)
    return drawn


def describe(study: Study, found: Findings, title: str, name: str = "") -> None:
    """Add the answers, the diagram and the tables to a study, under names that start with ``name``."""
    prefix = name and f"{name}-"
    failed = [{"case": case, "why": why} for case, why in found.failed.items()]
    study.at_most(f"cases that failed: {title}", len(failed), 0, "each of them could be rendered")
    if failed:
        study.records(f"{prefix}failed", f"{title}: cases that failed", failed)
    if not found.points:
        return
    if found.warning:
        study.texts.append(f"{title}. {found.warning}")
    own = f"about {found.reference_error:.2g}" if found.reference_error else "not known"
    caption = (
        "Down and to the left is better. Yellow: the best at each error; grey: curves that are never the "
        f"best. Bars: 95 % intervals. The reference's own RMSE is {own}."
    )
    study.texts += [f"{title}. {verdict}" for verdict in found.verdicts]
    study.picture(f"{prefix}diagram", title, diagram(title, found), caption)
    note = "Medians of warm renders without loading the scene; cold: the first run. Errors in linear light."
    points = [point.row() for curve in found.families.values() for point in curve]
    study.records(f"{prefix}points", f"{title}: every case", points, note)
