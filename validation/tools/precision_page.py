"""The page of an ``error_vs_time``: the work-precision diagram, the answers, the strips and the tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from mrt_mitsuba.validation.tools.gallery import gallery, panels
from mrt_mitsuba.validation.tools.intervals import Estimate
from mrt_mitsuba.validation.tools.precision import Findings, Interval, Panel, Point
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Error against time"
MARKERS = "osD^vP*X<>hp"
LABELLED = 30  # points up to which each has its number in the diagram; of more only those ahead
PANEL = (160, 120)  # pixels of a larger picture that a strip shows
SAME = 0.02  # errors closer than this are the same: no reason to wait longer


def study(found: Findings) -> Study:
    """Return the findings in the form that pages are made of."""
    made = Study(
        "error-vs-time",
        f"{TITLE}: {found.scene if not found.scene.isdigit() else 'scene ' + found.scene}",
        seconds=found.took,
    )
    describe(made, found, "", "All cases")
    return made


def describe(study: Study, found: Findings, name: str, title: str, truth: str = "") -> None:
    """Add the diagram, the answers and the tables to a study; ``truth`` says what the reference is."""
    prefix = f"{name}-" if name else ""
    where = f"{name}: " if name else ""
    study.at_most(f"{where}cases that failed", len(found.failed), 0, "each of them could be rendered")
    if not found.points:
        return
    caption = " ".join([_caption(found), _reference(found, truth), *found.verdicts])
    study.plot(f"{prefix}diagram", f"{title}: work and precision", diagram(found), caption)
    for number, (seconds, shown) in enumerate(found.strips, 1):
        caption = "In sRGB; where a picture is cut, it is where the cases differ most."
        figure = strip_figure(found, shown)
        study.plot(f"{prefix}strip-{number}", f"{title}: what {seconds:.2g} s buy", figure, caption)
    if found.errors:
        study.table(
            f"{prefix}times",
            f"{title}: seconds to an error",
            ["curve", *(f"RMSE {error:g}" for error in found.errors)],
            [[curve, *(_reached(found.times[e][curve]) for e in found.errors)] for curve in found.families],
            "With 95 % intervals. Between measured cases a curve is straight in logarithms; beyond them "
            "nothing is assumed.",
            first=not name,
        )
    ahead = {point.name for point in front(list(found.points.values())) if found.repeats > 1}
    rows = [_row(number, point, point.name in ahead) for number, point in numbered(found)]
    note = (
        "Seconds: medians of warm renders without loading the scene; cold: a first run. Errors in units of "
        "linear light. Ahead: no other case has less error in less time."
    )
    study.records(f"{prefix}points", f"{title}: every case", rows, note)
    if found.failed:
        reasons = [list(item) for item in found.failed.items()]
        study.table(f"{prefix}failed", f"{title}: cases that failed", ["case", "why"], reasons)


def _reference(found: Findings, truth: str) -> str:
    named = f"Reference: {truth}. " if truth else ""
    if found.reference_error == 0:
        return f"{named}The error of the reference itself is not known: every RMSE has it in it."
    own = f"{found.reference_error:.2g}"
    return f"{named}The RMSE of the reference itself is about {own}; no claim is made below twice that."


def _reached(time: Estimate) -> str:
    return str(time) if np.isfinite(time.value) else "not reached"


def numbered(found: Findings) -> Iterator[tuple[int, Point]]:
    """Yield the points with their numbers in diagram and table, curve by curve."""
    return enumerate((point for points in found.families.values() for point in points), 1)


def front(points: Sequence[Point]) -> list[Point]:
    """Return the points that gain error over all faster ones, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.rmse)):
        if not best or point.rmse < (1 - SAME) * best[-1].rmse:
            best.append(point)
    return best


def _row(number: int, p: Point, ahead: bool) -> dict[str, Any]:
    d = p.difference
    return {
        "#": number,
        "case": p.name,
        "seconds": p.seconds,
        "interval, s": _interval(p.seconds_interval),
        "cold, s": p.cold,
        "of it compiling, s": p.compile,
        "RMSE": p.rmse if p.resolved else "at the floor",
        "interval": _interval(p.rmse_interval) if p.resolved else "",
        "|bias|": p.bias if np.isfinite(p.bias) else "–",
        "interval of it": _interval(p.bias_interval) if np.isfinite(p.bias) else "",
        "1 / (variance × s)": p.efficiency if np.isfinite(p.efficiency) else "–",
        "relMSE": d.rel_mse,
        "largest": d.largest,
        "FLIP": "–" if d.flip is None else d.flip,
        "rays": sum(p.rays.values()),
        "ahead": "yes" if ahead else "",
    }


def _interval(ends: Interval) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g}" if np.isfinite(ends[0]) else "one repeat"


def _caption(found: Findings) -> str:
    text = "Down and to the left is better. Bars are 95 % intervals, numbers those of the table."
    ahead = front([p for p in found.points.values() if p.resolved]) if found.repeats > 1 else []
    names = "; ".join(f"{p.name} ({p.seconds:.2g} s, RMSE {p.rmse:.2g})" for p in ahead)
    return f"{text} Ahead of the others: {names}." if names else text


def diagram(found: Findings) -> Any:
    """Return the work-precision diagram: RMSE against seconds, both with intervals, and the floor."""
    figure, axes = panels(9, 6)
    points, floor = list(found.points.values()), found.reference_error
    errors = [p.rmse for p in points if p.rmse > 0] + ([floor] if floor else [])
    bottom = 0.4 * min(errors, default=1e-6)  # where cases without error are drawn
    for (name, curve), marker in zip(found.families.items(), cycle(MARKERS), strict=False):
        _draw(axes, curve, bottom, label=name, marker=marker)
    _number(axes, found, bottom)
    if floor:
        axes.axhspan(bottom / 10, floor, color="0.9", zorder=0, label="within the reference's error")
    if any(p.rmse == 0 for p in points):
        axes.axhline(bottom, color="0.9", linewidth=8, zorder=0, label="no error")
    axes.set(xscale="log", yscale="log", xlabel="seconds, warm", ylabel="RMSE")
    axes.set_ylim(bottom=0.8 * bottom)
    axes.margins(x=0.08, y=0.08)
    axes.grid(alpha=0.3)
    _label_between_decades(axes.xaxis)
    _label_between_decades(axes.yaxis)
    figure.legend(fontsize=8, ncols=4, loc="outside lower center")
    return figure


def _number(axes: Any, found: Findings, bottom: float) -> None:
    """Write the numbers of the table next to the points; of many points, only those ahead have theirs."""
    ahead = {p.name for p in front(list(found.points.values()))}
    for number, point in numbered(found):
        if len(found.points) <= LABELLED or point.name in ahead:
            place = point.seconds, max(point.rmse, bottom)
            axes.annotate(str(number), place, textcoords="offset points", xytext=(4, 4), fontsize=8)


def _draw(axes: Any, curve: Sequence[Point], bottom: float, **style: Any) -> None:
    """Draw the points of a curve with their intervals."""
    x, y = [p.seconds for p in curve], [max(p.rmse, bottom) for p in curve]
    bars = {"xerr": _bars([p.time for p in curve], x), "yerr": _bars([p.error for p in curve], y)}
    axes.errorbar(x, y, **bars, markersize=5, linewidth=1, capsize=2, **style)


def _bars(estimates: Sequence[Estimate], values: Sequence[float]) -> np.ndarray:
    """Return how far intervals reach below and above values, [2, points]; 0 where unknown."""
    ends = np.array([[v if np.isnan(e.low) else e.low, v if np.isnan(e.high) else e.high]
                     for e, v in zip(estimates, values, strict=True)]).T  # fmt: skip
    return np.maximum([values - ends[0], ends[1] - values], 0)


def _label_between_decades(axis: Any) -> None:
    """Label a logarithmic axis of a decade or two with 10, 20, 50, 100."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    low, high = np.log10(axis.get_view_interval())
    if high - low < 2.5:
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
        axis.set_minor_formatter(plain)
        axis.set_tick_params(which="minor", labelsize=8)


def strip_figure(found: Findings, panels: Sequence[Panel]) -> Any:
    """Return the pictures of a strip side by side, the reference last, each with its seconds and error."""
    cut = _most_different(np.stack([image for _, _, image in panels]), found.reference)
    pictures = {}
    for name, seconds, image in panels:
        rmse = np.sqrt(np.mean((image - found.reference) ** 2))
        pictures[f"{name}\n{seconds:.3g} s, RMSE {rmse:.2g}"] = image
    pictures["reference"] = found.reference
    cuts = {title: np.asarray(picture[cut], np.float32) for title, picture in pictures.items()}
    return gallery(cuts, columns=min(4, len(cuts)), width=10, title=0.6)


def _most_different(images: np.ndarray, reference: np.ndarray) -> tuple[slice, slice]:
    """Return the window of ``PANEL`` pixels where pictures [N, H, W, 3] differ most from the reference."""
    width, height = min(PANEL[0], reference.shape[1]), min(PANEL[1], reference.shape[0])
    errors = np.square(images - reference).sum(axis=(0, 3))
    sums = np.pad(errors.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    windows = (
        sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    )
    row, column = np.unravel_index(np.argmax(windows), windows.shape)
    return slice(row, row + height), slice(column, column + width)
