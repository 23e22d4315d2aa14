"""The page of an ``error_vs_time``: the work-precision diagram, the answers, the strips and the tables."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np

from mrt_mitsuba.output.files import to_8bit
from mrt_mitsuba.validation.tools.gallery import panels
from mrt_mitsuba.validation.tools.precision import Findings, Interval, Panel, Point
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Error against time"
MARKERS = "osD^vP*X<>hp"
LABELLED = 30  # points up to which each has its number in the diagram; of more only those ahead
PANEL = (160, 120)  # pixels of a larger picture that a strip shows
SAME = 0.02  # errors closer than this are the same: no reason to wait longer


def study(found: Findings) -> Study:
    """Return the findings in the form that pages are made of."""
    scene = f"scene {found.scene}" if found.scene.isdigit() else found.scene
    made = Study("error-vs-time", f"{TITLE}: {scene}", seconds=found.took)
    describe(made, found, "", "All cases")
    return made


def describe(study: Study, found: Findings, name: str, title: str, truth: str = "") -> None:
    """Add the diagram, the answers and the tables to a study; ``truth`` says what the reference is."""
    prefix, where = (f"{name}-", f"{name}: ") if name else ("", "")
    study.at_most(f"{where}cases that failed", len(found.failed), 0, "each of them could be rendered")
    if not found.points:
        return
    numbered = list(enumerate((point for points in found.families.values() for point in points), 1))
    study.plot(
        f"{prefix}diagram", f"{title}: work and precision", diagram(found, numbered), caption(found, truth)
    )
    for number, (seconds, shown) in enumerate(found.strips, 1):
        text = "In sRGB; where a picture is cut, it is where the cases differ most."
        figure = strip_figure(found, shown)
        study.plot(f"{prefix}strip-{number}", f"{title}: what {seconds:.2g} s buy", figure, text)
    if found.errors:
        columns = ["curve", *(f"RMSE {error:g}" for error in found.errors)]
        note = (
            "With 95 % intervals. Between measured cases a curve is straight in logarithms; beyond them "
            "nothing is assumed."
        )
        study.table(
            f"{prefix}times", f"{title}: seconds to an error", columns, times(found), note, first=not name
        )
    best = {p.name for p in front(list(found.points.values())) if found.repeats > 1}
    note = (
        "Seconds: medians of warm renders without loading the scene; cold: a first run. Errors in units of "
        "linear light. Ahead: no other case has less error in less time."
    )
    table = [_row(number, point, point.name in best) for number, point in numbered]
    study.records(f"{prefix}points", f"{title}: every case", table, note)
    if found.failed:
        reasons = [list(item) for item in found.failed.items()]
        study.table(f"{prefix}failed", f"{title}: cases that failed", ["case", "why"], reasons)


def times(found: Findings) -> list[list[str]]:
    """Return the seconds in which each curve comes down to each error."""
    rows = []
    for curve in found.families:
        reached = [by_curve[curve] for by_curve in found.times.values()]
        rows.append([curve, *(str(t) if np.isfinite(t.value) else "not reached" for t in reached)])
    return rows


def caption(found: Findings, truth: str) -> str:
    """Return what the diagram shows, who is ahead, how good the reference is, and the verdicts."""
    parts = ["Down and to the left is better. Bars are 95 % intervals, numbers those of the table."]
    if found.repeats > 1 and (ahead := front([p for p in found.points.values() if p.resolved])):
        names = "; ".join(f"{p.name} ({p.seconds:.2g} s, RMSE {p.rmse:.2g})" for p in ahead)
        parts.append(f"Ahead of the others: {names}.")
    parts += [f"Reference: {truth}."] if truth else []
    own = f"about {found.reference_error:.2g}; no claim is made below twice that."
    unknown = "not known: every RMSE has it in it."
    parts.append(f"The RMSE of the reference itself is {own if found.reference_error else unknown}")
    return " ".join(parts + found.verdicts)


def front(points: Sequence[Point]) -> list[Point]:
    """Return the points that gain error over all faster ones, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.rmse)):
        if not best or point.rmse < (1 - SAME) * best[-1].rmse:
            best.append(point)
    return best


def _row(number: int, p: Point, ahead: bool) -> dict[str, Any]:
    def interval(ends: Interval) -> str:
        return f"{ends[0]:.3g} to {ends[1]:.3g}" if np.isfinite(ends[0]) else "one repeat"

    return {
        "#": number,
        "case": p.name,
        "seconds": p.seconds,
        "interval, s": interval(p.seconds_interval),
        "cold, s": p.cold,
        "of it compiling, s": p.compile,
        "RMSE": p.rmse if p.resolved else "at the floor",
        "interval": interval(p.rmse_interval) if p.resolved else "",
        "|bias|": p.bias if np.isfinite(p.bias) else "–",
        "interval of it": interval(p.bias_interval) if np.isfinite(p.bias) else "",
        "1 / (variance × s)": p.efficiency if np.isfinite(p.efficiency) else "–",
        "relMSE": p.difference.rel_mse,
        "largest": p.difference.largest,
        "FLIP": "–" if p.difference.flip is None else p.difference.flip,
        "rays": sum(p.rays.values()),
        "ahead": "yes" if ahead else "",
    }


def diagram(found: Findings, numbered: Sequence[tuple[int, Point]]) -> Any:
    """Return the work-precision diagram: RMSE against seconds, both with intervals, and the floor.

    Points have the numbers of the table next to them; of many points, only those ahead.
    """
    figure, axes = panels(9, 6)
    points, floor = list(found.points.values()), found.reference_error
    errors = [p.rmse for p in points if p.rmse > 0] + ([floor] if floor else [])
    bottom = 0.4 * min(errors, default=1e-6)  # where cases without error are drawn
    for (name, curve), marker in zip(found.families.items(), cycle(MARKERS), strict=False):
        places = np.array([[p.seconds, max(p.rmse, bottom)] for p in curve]).T
        ends = np.array([[p.seconds_interval, p.rmse_interval] for p in curve]).transpose(1, 2, 0)
        reach = np.maximum(np.stack([places - ends[:, 0], ends[:, 1] - places], axis=1), 0)
        bars = dict(zip(("xerr", "yerr"), np.where(np.isnan(reach), 0, reach), strict=True))
        axes.errorbar(*places, **bars, label=name, marker=marker, markersize=5, linewidth=1, capsize=2)
    ahead = {p.name for p in front(points)}
    for number, point in numbered:
        if len(points) <= LABELLED or point.name in ahead:
            place = point.seconds, max(point.rmse, bottom)
            axes.annotate(str(number), place, textcoords="offset points", xytext=(4, 4), fontsize=8)
    if floor:
        axes.axhspan(bottom / 10, floor, color="0.9", zorder=0, label="within the reference's error")
    if any(p.rmse == 0 for p in points):
        axes.axhline(bottom, color="0.9", linewidth=8, zorder=0, label="no error")
    axes.set(xscale="log", yscale="log", xlabel="seconds, warm", ylabel="RMSE")
    axes.set_ylim(bottom=0.8 * bottom)
    axes.margins(x=0.08, y=0.08)
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, ncols=4, loc="outside lower center")
    return figure


def strip_figure(found: Findings, strip: Sequence[Panel]) -> Any:
    """Return the pictures of a strip side by side, the reference last, each with its seconds and error.

    Of larger pictures it shows the window of ``PANEL`` pixels where they differ most from the reference.
    """
    reference = found.reference
    width, height = (min(most, size) for most, size in zip(PANEL, reference.shape[1::-1], strict=True))
    errors = np.square(np.stack([image for _, _, image in strip]) - reference).sum(axis=(0, 3))
    sums = np.pad(errors.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    windows = (
        sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    )
    row, column = np.unravel_index(np.argmax(windows), windows.shape)
    shown = [
        (f"{name}\n{seconds:.3g} s, RMSE {np.sqrt(np.mean((image - reference) ** 2)):.2g}", image)
        for name, seconds, image in strip
    ]
    shown.append(("reference", reference))
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    figure, axes = panels(10, rows * (10 / columns * height / width + 0.6), rows, columns, squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for axis, (title, image) in zip(axes.ravel(), shown, strict=False):
        cut = np.asarray(image[row : row + height, column : column + width], np.float32)
        axis.imshow(to_8bit(cut, "srgb"), interpolation="nearest")
        axis.set_title(title, fontsize="small")
    return figure
