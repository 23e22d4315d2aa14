"""Diagrams with labels next to their lines, in colours that colour-blind people can distinguish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# Those of ``work_precision``, which imports this module
Findings = Any
Point = Any

# Okabe and Ito's colours, without yellow, which is pale on white
COLORS = ("#0072b2", "#d55e00", "#009e73", "#aa4499", "#56b4e9", "#e69f00", "#6a3d9a", "#8c510a")
GREY = "#8a8f98"
TEXT = "#30343b"
LABELS = 9.0  # points, of labels at lines
WORDS: dict[str, Any] = {"fontsize": LABELS, "color": TEXT}  # at axes
MARKERS = "osD^vPXh"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")  # exponents
# curves that are the best at some error, and those that never are
NOTABLE: dict[str, Any] = {"markersize": 5, "linewidth": 1.6, "elinewidth": 0.8, "zorder": 3}
OTHERS = NOTABLE | {"markersize": 3, "linewidth": 0.8, "alpha": 0.7, "zorder": 2}


def figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure of a size in inches, and its plots [rows, columns], without frames."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height))
    drawn.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    plots = drawn.subplots(rows, columns, squeeze=False)
    for axes in plots.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(GREY)
        axes.tick_params(colors=TEXT, labelsize=LABELS)
        axes.set_xlabel("", **WORDS)
        axes.set_ylabel("", **WORDS)
    return drawn, plots


def panel(title: str, width: float = 5.0, height: float = 4.4) -> tuple[Figure, Axes]:
    """A figure of one plot with a title, of a size in inches that a phone shows whole."""
    drawn, plots = figure(1, 1, width, height)
    plots[0, 0].set_title(title, loc="left", fontsize=LABELS + 1, color=TEXT)
    return drawn, plots[0, 0]


def plain_numbers(*scales: Axis) -> None:
    """Write decimal numbers at logarithmic axes: 1, 2 and 5 of each decade, fewer if there are many."""
    from matplotlib.ticker import LogLocator, NullLocator

    for scale in scales:
        least, most = scale.get_view_interval()
        span = most / least
        subs = (1, 2, 5) if span < 300 else (1, 3) if span < 1e4 else (1,)
        scale.set_major_locator(LogLocator(subs=subs))
        scale.set_major_formatter("{x:g}")
        scale.set_minor_locator(NullLocator())


def powers_of_ten(*scales: Axis) -> None:
    """Write powers of ten at logarithmic axes of many decades, where smaller ticks would only take time."""
    from matplotlib.ticker import NullLocator

    for scale in scales:
        scale.set_major_formatter(_power_of_ten)
        scale.set_minor_locator(NullLocator())


def _power_of_ten(place: float, _: float) -> str:
    """The label of a tick, in characters of its font: a formula would be parsed for each."""
    exponent = f"{np.log10(place):.0f}"
    return "10" + exponent.translate(RAISED)


def note(axes: Axes, x: float, y: float, text: str, **looks: Any) -> None:
    """Write a text into a plot, at a place in shares of its width and height."""
    looks = {"fontsize": LABELS, "color": GREY, **looks}
    axes.text(x, y, text, transform=axes.transAxes, **looks)


def label_ends(axes: Axes, ends: Mapping[str, tuple[float, float, str]]) -> None:
    """Write labels to the right of a plot, next to where their lines end: x, y and colour by label.

    Where ends are close to each other, labels move apart, and thin lines lead to them.
    """
    drawn: Any = axes.figure
    drawn.get_layout_engine().execute(drawn)  # places the axes
    gap = 1.35 * LABELS * drawn.dpi / 72 / axes.get_window_extent().height
    to_axes = axes.transData - axes.transAxes
    ascending = sorted(ends.items(), key=lambda end: end[1][1])
    wanted = [to_axes.transform((x, y))[1] for _, (x, y, _) in ascending]
    for (name, (x, y, color)), place in zip(ascending, apart(wanted, gap), strict=True):
        lead = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "alpha": 0.7, "shrinkB": 3}
        axes.annotate(
            name,
            (x, y),
            xytext=(1.03, place),
            textcoords="axes fraction",
            color=color,
            fontsize=LABELS,
            va="center",
            arrowprops=lead,
            annotation_clip=False,
        )


def apart(places: Sequence[float], gap: float) -> list[float]:
    """Move ascending places as little as makes neighbours a gap apart, within 0 and 1 if they fit there."""
    from scipy.optimize import isotonic_regression

    steps = gap * np.arange(len(places))
    moved = isotonic_regression(places - steps).x
    highest = max(1 - gap * (len(places) - 1), 0.0)
    return list(np.clip(moved, 0, highest) + steps)


# --------------------------------------- Error against time ---------------------------------------


def work_precision(title: str, found: Findings) -> Figure:
    """Draw the error of each case over its seconds; down and to the left is better.

    Curves that are the best at some error are coloured, and their points named; the others are grey. Bars are
    intervals, the band at the bottom is the reference's own error.
    """
    drawn, axes = panel(title)
    axes.set(xscale="log", yscale="log", xlabel="seconds of a warm render", ylabel="error (RMSE, linear)")
    points = list(found.points.values())
    best = frontier(points)
    errors = [error for error in (found.reference_error, *(p.rmse for p in points)) if error]
    bottom = 0.7 * min(errors, default=1e-6)

    def places(some: Sequence[Point]) -> np.ndarray:
        """Seconds and errors [2, points]; cases without an error are drawn at the bottom."""
        return np.reshape([(p.seconds, max(p.rmse, bottom)) for p in some], (-1, 2)).T

    axes.plot(*places(best), color="#ffd34d", linewidth=7, alpha=0.6, zorder=1)
    colors = dict(zip(dict.fromkeys(p.family for p in best), COLORS, strict=False))
    ends = {}
    for marker, (family, curve) in zip(cycle(MARKERS), found.families.items()):
        at = places(curve)
        intervals = np.array([(p.seconds_interval, p.rmse_interval) for p in curve])  # [points, 2, 2]
        reach = np.nan_to_num(abs(intervals.transpose(1, 2, 0) - at[:, None]))
        color = colors.get(family, GREY)
        look = NOTABLE if family in colors else OTHERS
        bars: Any = {"xerr": reach[0], "yerr": reach[1], "ecolor": (color, 0.45)}
        axes.errorbar(at[0], at[1], **bars, color=color, marker=marker, **look)
        words = family.replace("%", "").split()
        # without names that only numbers followed
        shown = [word for word in words if f"{word}=" not in curve[-1].name]
        ends[" ".join(shown or words)] = (*at[:, -1], color)
    if found.reference_error:
        axes.axhspan(bottom / 10, found.reference_error, color="0.92", zorder=0)
        note(axes, 0.02, 0.01, "within the reference's own error", fontsize=LABELS - 1.5)
    seconds, shown_errors = places(points)
    axes.set_xlim(seconds.min() / 2.5, seconds.max() * 1.3)  # intervals may go on beyond
    axes.set_ylim(0.8 * bottom, 1.6 * shown_errors.max())
    plain_numbers(axes.xaxis, axes.yaxis)
    note(axes, 0.98, 0.98, "the best at each error", ha="right", va="top", color="#a67c00")
    axes.grid(alpha=0.25)
    _name_points(axes, best, places(best).T)
    label_ends(axes, ends)
    return drawn


def frontier(points: Sequence[Point]) -> list[Point]:
    """The points that no other one beats in both time and error, fastest first.

    No claim is made about errors within the reference's own.
    """
    best: list[Point] = []
    for point in sorted(points, key=attrgetter("seconds", "rmse")):
        if not best or point.rmse < best[-1].rmse:
            best.append(point)
    return [point for point in best if point.resolved or not point.reference_error]


def _name_points(axes: Axes, best: Sequence[Point], places: np.ndarray) -> None:
    """Write what distinguishes the best points [points, 2] from their curve, where there is room for it."""
    taken: list[np.ndarray] = []
    for point, place in zip(best, places, strict=True):
        name = " ".join(word for word in point.name.split() if word not in point.family.split())
        pixel = axes.transData.transform(place)
        if name and all(abs((pixel - other) / (46, 13)).max() > 1 for other in taken):
            taken.append(pixel)
            shift: dict[str, Any] = {"xytext": (-4, -5), "textcoords": "offset points"}
            axes.annotate(name, place, **shift, fontsize=LABELS - 1.5, color=TEXT, ha="right", va="top")
