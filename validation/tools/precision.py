"""Findings about error against time: the figures of each case, what they answer, how sure it is; the page.

The pictures x₁ … x_R of a case and two independent halves h₁, h₂ of the reference give the matrix G[r, s] =
mean (x_r − h₁)(x_s − h₂), in which the reference's own noise cancels. The mean of its diagonal is the squared
error, that of the rest the squared bias; the difference is the variance.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np

from mrt_mitsuba.validation.tools import report
from mrt_mitsuba.validation.tools.compare import Difference
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Error against time"
RESOLVED = 2.0  # times the reference's own error from which on an error can be distinguished from it
NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?:/\d+)?"
NOTHING = 1e-15  # an RMSE of 0, as logarithms have it
LEVEL = 0.95  # of all intervals
LABELLED = 30  # points up to which each has its number in the diagram; of more only those ahead
SAME = 0.02  # errors closer than this are the same: no reason to wait longer


class Estimate(NamedTuple):
    """A value with its interval; NaN where nothing is known, infinite where it is never reached."""

    value: float
    low: float
    high: float

    def overlaps(self, other: Estimate) -> bool:
        """Return whether the intervals share a value; NaN shares all."""
        return not (self.high < other.low or other.high < self.low)

    def __str__(self) -> str:
        if np.isnan(self.low):
            return f"{self.value:.3g}"
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


def reach(values: np.ndarray) -> float:
    """Return how far Student's interval goes to each side of the mean of values; NaN of a single one."""
    from scipy import stats

    count = len(values)
    if count < 2:
        return math.nan
    return float(stats.t.ppf((1 + LEVEL) / 2, count - 1) * values.std(ddof=1) / math.sqrt(count))


@dataclass(frozen=True, eq=False)
class Point:
    """One case: what it costs and how far off it is."""

    name: str
    times: np.ndarray  #: seconds of each repeat, warm, without loading the scene
    gram: np.ndarray  #: G[r, s], see above
    cold: float  #: seconds of a first run, its kernels compiled or read from a cache
    compile: float  #: seconds of that in the compiler
    rays: Mapping[str, int]
    image: np.ndarray  #: of the first repeat
    difference: Difference  #: of it from the reference
    reference_error: float

    @property
    def family(self) -> str:
        """The name without its numbers: cases that differ in these alone are one curve."""
        bare = re.sub(rf"(\w+=)?{NUMBER}", " ", self.name).split()
        return " ".join(bare or re.sub(f"=?{NUMBER}", " ", self.name).split()) or self.name

    @cached_property
    def time(self) -> Estimate:
        """The median; its standard error is at most √(π/2) times that of the mean."""
        middle, width = float(np.median(self.times)), math.sqrt(np.pi / 2) * reach(np.log(self.times))
        return Estimate(middle, middle * math.exp(-width), middle * math.exp(width))

    @cached_property
    def error(self) -> Estimate:
        """The RMSE over all repeats."""
        squares = np.diag(self.gram)
        mean = max(float(squares.mean()), NOTHING**2)
        width, rmse = min(reach(squares) / mean / 2, 99), math.sqrt(mean)  # in logarithms
        return Estimate(rmse, rmse * math.exp(-width), rmse * math.exp(width))

    @cached_property
    def bias_squared(self) -> Estimate:
        """By pairs of different repeats, whose mean varies as twice that of what they have in common."""
        count = len(self.times)
        if count < 2:
            return Estimate(math.nan, math.nan, math.nan)
        of_each = (self.gram.sum(axis=1) - np.diag(self.gram)) / (count - 1)
        value, width = float(of_each.mean()), 2 * reach(of_each) if count > 2 else math.inf
        return Estimate(value, value - width, value + width)

    @property
    def seconds(self) -> float:
        return self.time.value

    @property
    def seconds_interval(self) -> tuple[float, float]:
        return self.time.low, self.time.high

    @property
    def rmse(self) -> float:
        return self.error.value if self.error.value > NOTHING else 0.0

    @property
    def rmse_interval(self) -> tuple[float, float]:
        return self.error.low, self.error.high

    @property
    def variance(self) -> float:
        """Mean variance of a pixel between repeats; NaN for one repeat."""
        return max(0.0, float(np.diag(self.gram).mean()) - self.bias_squared.value)

    @property
    def bias(self) -> float:
        """Absolute bias, √(MSE − variance), 0 where noise explains the whole error; NaN for one repeat."""
        return float(np.sqrt(np.maximum(self.bias_squared.value, 0)))

    @property
    def bias_interval(self) -> tuple[float, float]:
        low, high = np.sqrt(np.maximum(self.bias_squared[1:], 0))
        return float(low), float(high)

    @property
    def efficiency(self) -> float:
        """1 / (variance × seconds); NaN where nothing is random or there is one repeat."""
        product = self.variance * self.seconds
        return 1 / product if product > 1e-12 * self.rmse**2 * self.seconds else math.nan

    @property
    def resolved(self) -> bool:
        """Return whether the error can be distinguished from the reference's own."""
        return self.rmse > RESOLVED * self.reference_error


@dataclass(frozen=True)
class Findings:
    """The findings of ``error_vs_time`` about several cases."""

    scene: str
    points: Mapping[str, Point]
    failed: Mapping[str, str]  #: why, by case
    reference: np.ndarray
    reference_error: float  #: RMSE of the reference itself, below which nothing is claimed; 0: exact
    repeats: int
    errors: Sequence[float]  #: for which the time is given
    took: float = 0.0

    @property
    def families(self) -> dict[str, list[Point]]:
        """The points of each curve, fastest first."""
        groups: dict[str, list[Point]] = {point.family: [] for point in self.points.values()}
        for point in sorted(self.points.values(), key=lambda p: p.seconds):
            groups[point.family].append(point)
        return groups

    @property
    def ordered(self) -> list[Point]:
        """The points, curve after curve."""
        return [point for points in self.families.values() for point in points]

    def time_to(self, error: float) -> dict[str, Estimate]:
        """Return the seconds in which each curve comes down to an RMSE; infinite where it never does.

        The interval is from where the lower ends of all intervals come so low to where the upper ends do.
        """
        return {
            name: Estimate(*(_crossing([(p.time[i], p.error[i]) for p in points], error) for i in range(3)))
            for name, points in self.families.items()
        }

    @cached_property
    def verdicts(self) -> list[str]:
        """A sentence for each of ``errors``; it names a winner only if its interval meets no other."""
        if self.repeats < 2:
            return ["No verdict on time: a single repeat has no interval."]
        sentences = []
        for error in self.errors:
            times = self.time_to(error)
            reached = sorted((time.value, name) for name, time in times.items() if np.isfinite(time.value))
            best = reached[0][1] if reached else ""
            like = [name for _, name in reached[1:] if times[name].overlaps(times[best])]
            if not reached:
                verdict = "no case comes so low"
            elif like:
                verdict = f"no winner, for the intervals overlap: {', '.join([best, *like])}"
            elif len(reached) == 1:
                verdict = f"only {best} comes so low, in {times[best]} s"
            else:
                verdict = f"{best} is the fastest, {times[best]} s; {reached[1][1]} takes "
                verdict += f"{reached[1][0] / reached[0][0]:.2g} times as long"
            sentences.append(f"RMSE of {error:g}: {verdict}.")
        return sentences

    def __str__(self) -> str:
        width = max(map(len, [*self.points, *self.failed]), default=0)
        lines = [f"{p.name:<{width}}  {p.time} s, RMSE {p.error}" for p in self.points.values()]
        lines += [f"{name:<{width}}  FAILED {why}" for name, why in self.failed.items()]
        own = f"{self.reference_error:.2g}" if self.reference_error else "not known"
        return "\n".join([*lines, f"the reference's own error: {own}", *self.verdicts])

    def study(self) -> Study:
        """Return what the page shows."""
        scene = f"scene {self.scene}" if self.scene.isdigit() else self.scene
        study = Study("error-vs-time", f"{TITLE}: {scene}", seconds=self.took)
        describe(study, self, "", "All cases")
        return study

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the page (``index.html``), ``summary.json``, CSV files and plots. Raises ``OutputError``."""
        report.save(folder, self.study(), title=TITLE)

    def _repr_html_(self) -> str:
        return report.notebook(self.study(), title=TITLE)


def _crossing(curve: Iterable[tuple[float, float]], error: float) -> float:
    """Return when a curve of (seconds, RMSE) comes down to an error, infinity if it does not.

    Between its points it is straight in logarithms; beyond them nothing is assumed.
    """
    error *= 1 + 1e-9  # an error that is met to rounding is met
    before = (math.nan, math.inf)
    for seconds, rmse in curve:
        if math.isnan(rmse):
            return math.nan
        if rmse <= error:
            if math.isinf(before[1]):
                return seconds
            share = math.log(before[1] / error) / math.log(before[1] / rmse)
            return float(before[0] ** (1 - share) * seconds**share)
        before = seconds, rmse
    return math.inf


# ------------------------------------------------ The page ------------------------------------------------


def describe(study: Study, found: Findings, name: str, title: str, truth: str = "") -> None:
    """Add the diagram, the answers and the tables to a study; ``truth`` says what the reference is."""
    prefix, where = (f"{name}-", f"{name}: ") if name else ("", "")
    study.at_most(f"{where}cases that failed", len(found.failed), 0, "each of them could be rendered")
    if not found.points:
        return
    figure, caption = _diagram(found), _caption(found, truth)
    study.picture(f"{prefix}diagram", f"{title}: work and precision", figure, caption)
    if found.errors:
        note = "With 95 % intervals. Between measured cases a curve is straight in logarithms; beyond them "
        note += "nothing is assumed."
        study.records(f"{prefix}times", f"{title}: seconds to an error", _times(found), note, first=not name)
    note = (
        "Seconds: medians of warm renders without loading the scene; cold: a first run. Errors in units of "
    )
    note += "linear light. Ahead: no other case has less error in less time."
    study.records(f"{prefix}points", f"{title}: every case", _rows(found), note)
    if found.failed:
        reasons = [list(item) for item in found.failed.items()]
        study.table(f"{prefix}failed", f"{title}: cases that failed", ["case", "why"], reasons)


def _times(found: Findings) -> list[dict[str, str]]:
    """Return the seconds in which each curve comes down to each error."""
    rows: dict[str, dict[str, str]] = {name: {"curve": name} for name in found.families}
    for error in found.errors:
        for name, t in found.time_to(error).items():
            rows[name][f"RMSE {error:g}"] = str(t) if np.isfinite(t.value) else "not reached"
    return list(rows.values())


def _caption(found: Findings, truth: str) -> str:
    """Return what the diagram shows, who is ahead, how good the reference is, and the verdicts."""
    parts = ["Down and to the left is better. Bars are 95 % intervals, numbers those of the table."]
    if found.repeats > 1 and (ahead := front(p for p in found.points.values() if p.resolved)):
        names = "; ".join(f"{p.name} ({p.seconds:.2g} s, RMSE {p.rmse:.2g})" for p in ahead)
        parts.append(f"Ahead of the others: {names}.")
    parts += [f"Reference: {truth}."] if truth else []
    own = f"about {found.reference_error:.2g}; no claim is made below twice that."
    unknown = "not known: every RMSE has it in it."
    parts.append(f"The RMSE of the reference itself is {own if found.reference_error else unknown}")
    return " ".join(parts + found.verdicts)


def front(points: Iterable[Point]) -> list[Point]:
    """Return the points that gain error over all faster ones, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.rmse)):
        if not best or point.rmse < (1 - SAME) * best[-1].rmse:
            best.append(point)
    return best


def _rows(found: Findings) -> list[dict[str, Any]]:
    """Return the table of all cases."""
    ahead = front(found.ordered) if found.repeats > 1 else []

    def interval(ends: tuple[float, float]) -> str:
        return f"{ends[0]:.3g} to {ends[1]:.3g}" if np.isfinite(ends[0]) else "one repeat"

    def known(value: float | None) -> float | str:
        return "–" if value is None or np.isnan(value) else value

    return [
        {
            "#": number,
            "case": p.name,
            "seconds": p.seconds,
            "interval, s": interval(p.seconds_interval),
            "cold, s": p.cold,
            "of it compiling, s": p.compile,
            "RMSE": p.rmse if p.resolved else "at the floor",
            "interval": interval(p.rmse_interval) if p.resolved else "",
            "|bias|": known(p.bias),
            "interval of it": interval(p.bias_interval),
            "1 / (variance × s)": known(p.efficiency),
            "relMSE": p.difference.rel_mse,
            "largest": p.difference.largest,
            "FLIP": known(p.difference.flip),
            "rays": sum(p.rays.values()),
            "ahead": "yes" if p in ahead else "",
        }
        for number, p in enumerate(found.ordered, 1)
    ]


def _diagram(found: Findings) -> Any:
    """Return the work-precision diagram: RMSE against seconds, both with intervals, and the floor.

    Points have the numbers of the table next to them; of many points, only those ahead.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    axes, floor, ordered = figure.subplots(), found.reference_error, found.ordered
    errors = [p.rmse for p in ordered if p.rmse > 0] + ([floor] if floor else [])
    bottom = 0.4 * min(errors, default=1e-6)  # where cases without error are drawn
    for (name, curve), marker in zip(found.families.items(), cycle("osD^vP*X<>hp"), strict=False):
        places = np.array([[p.seconds, max(p.rmse, bottom)] for p in curve]).T
        ends = np.array([[p.seconds_interval, p.rmse_interval] for p in curve]).transpose(1, 2, 0)
        x, y = np.nan_to_num(np.maximum(np.stack([places - ends[:, 0], ends[:, 1] - places], axis=1), 0))
        axes.errorbar(
            places[0],
            places[1],
            xerr=x,
            yerr=y,
            label=name,
            marker=marker,
            markersize=5,
            linewidth=1,
            capsize=2,
        )
    ahead = front(ordered)
    for number, point in enumerate(ordered, 1):
        if len(ordered) <= LABELLED or point in ahead:
            place = point.seconds, max(point.rmse, bottom)
            axes.annotate(str(number), place, textcoords="offset points", xytext=(4, 4), fontsize=8)
    if floor:
        axes.axhspan(bottom / 10, floor, color="0.9", zorder=0, label="within the reference's error")
    if any(p.rmse == 0 for p in ordered):
        axes.axhline(bottom, color="0.9", linewidth=8, zorder=0, label="no error")
    axes.set(xscale="log", yscale="log", xlabel="seconds, warm", ylabel="RMSE")
    axes.set_ylim(bottom=0.8 * bottom)
    axes.margins(x=0.08, y=0.08)
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, ncols=4, loc="outside lower center")
    return figure
