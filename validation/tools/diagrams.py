"""Diagrams with lines that are labelled directly, in colours that colour-blind people can distinguish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Those of ``work_precision``, which draws by this module
Findings = Any
Point = Any

# Okabe and Ito's colours, without yellow, which is pale on white
COLORS = ("#0072b2", "#d55e00", "#009e73", "#aa4499", "#56b4e9", "#e69f00", "#6a3d9a", "#8c510a")
GREY = "#8a8f98"
TEXT = "#30343b"
LABELS = 9.0  # points, of labels at lines
WORDS: dict[str, Any] = {"fontsize": LABELS, "color": TEXT}  # at axes
MARKERS = "osD^vPXh"


def figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure of a size in inches, and its plots [rows, columns], without frames."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height))
    drawn.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    plots = drawn.subplots(rows, columns, squeeze=False)
    for axes in plots.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(GREY)
        axes.tick_params(colors=TEXT, labelsize=LABELS)
    return drawn, plots


def panel(title: str, width: float = 5.0, height: float = 4.4) -> tuple[Figure, Axes]:
    """Return a figure of one plot with a title, of a size in inches that a phone shows whole."""
    drawn, plots = figure(1, 1, width, height)
    plots[0, 0].set_title(title, loc="left", fontsize=LABELS + 1, color=TEXT)
    return drawn, plots[0, 0]


def plain_numbers(scale: Any) -> None:
    """Write decimal numbers at a logarithmic axis: 1, 2 and 5 of each decade, fewer if it has many."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    least, most = scale.get_view_interval()
    span = most / least
    subs = (1, 2, 5) if span < 300 else (1, 3) if span < 1e4 else (1,)
    scale.set_major_locator(LogLocator(subs=subs))
    scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    scale.set_minor_locator(NullLocator())


def label_ends(axes: Axes, ends: Mapping[str, tuple[float, float, str]], size: float = LABELS) -> None:
    """Write labels to the right of a plot, next to where their lines end: x, y and colour by label.

    Where ends are close to each other, labels move apart, and thin lines lead to them.
    """
    drawn: Any = axes.figure
    drawn.draw_without_rendering()  # places the axes
    height = axes.get_window_extent().height
    gap = 1.35 * size * drawn.dpi / 72 / height
    to_axes = axes.transAxes.inverted()
    wanted = {name: to_axes.transform(axes.transData.transform(end[:2]))[1] for name, end in ends.items()}
    names = sorted(wanted, key=wanted.__getitem__)
    for name, place in zip(names, apart([wanted[name] for name in names], gap), strict=True):
        x, y, color = ends[name]
        lead = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "alpha": 0.7, "shrinkB": 3}
        axes.annotate(
            name,
            (x, y),
            xytext=(1.03, place),
            textcoords="axes fraction",
            color=color,
            fontsize=size,
            va="center",
            arrowprops=lead,
            annotation_clip=False,
        )


def apart(places: Sequence[float], gap: float) -> list[float]:
    """Return ascending places moved so little that neighbours are a gap apart, within 0 and 1 if they fit."""
    steps = gap * np.arange(len(places))
    # neighbours that meet share the mean of where they want to be
    groups: list[tuple[float, int]] = []
    for place in np.asarray(places) - steps:
        mean = float(place)
        count = 1
        while groups and groups[-1][0] > mean:
            other, more = groups.pop()
            mean = (mean * count + other * more) / (count + more)
            count += more
        groups.append((mean, count))
    moved = np.repeat([mean for mean, _ in groups], [count for _, count in groups])
    highest = max(1 - gap * (len(places) - 1), 0.0)
    return list(np.clip(moved, 0, highest) + steps)


# --------------------------------------- Error against time ---------------------------------------


def work_precision(title: str, found: Findings) -> Figure:
    """Draw the error of each case over its seconds; down and to the left is better.

    Curves that are the best at some error are coloured, with what distinguishes their points; the others are
    grey. Bars are intervals, the band at the bottom is the reference's own error.
    """
    drawn, axes = panel(title)
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("seconds of a warm render", **WORDS)
    axes.set_ylabel("error (RMSE, linear)", **WORDS)
    _draw_curves(axes, found)
    label_ends(axes, _ends(found))
    return drawn


def frontier(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other one beats in both time and error, fastest first.

    Of errors within the reference's own nothing is claimed.
    """
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.seconds, point.rmse)):
        if not best or point.rmse < best[-1].rmse:
            best.append(point)
    return [point for point in best if point.resolved or not point.reference_error]


def _shown_error(point: Point, bottom: float) -> float:
    return max(point.rmse, bottom)


def _bottom(found: Findings) -> float:
    """Return where cases without an error are drawn."""
    errors = [error for error in (found.reference_error, *(p.rmse for p in found.points.values())) if error]
    return 0.7 * min(errors, default=1e-6)


def _colors(found: Findings) -> dict[str, str]:
    """Return the colour of each curve."""
    best = dict.fromkeys(point.family for point in frontier(list(found.points.values())))
    colors = dict.fromkeys(found.families, GREY)
    return colors | dict(zip(best, COLORS, strict=False))


def _ends(found: Findings) -> dict[str, tuple[float, float, str]]:
    """Return the last point of each curve, and its colour."""
    colors = _colors(found)
    bottom = _bottom(found)
    ends = {}
    for family, curve in found.families.items():
        last = curve[-1]
        words = family.replace("%", "").split()
        # without names that only numbers followed
        shown = [word for word in words if f"{word}=" not in last.name]
        ends[" ".join(shown or words)] = (last.seconds, _shown_error(last, bottom), colors[family])
    return ends


def _draw_curves(axes: Axes, found: Findings) -> None:
    colors = _colors(found)
    bottom = _bottom(found)
    best = frontier(list(found.points.values()))
    line = [(p.seconds, _shown_error(p, bottom)) for p in best]
    axes.plot(*np.reshape(line, (-1, 2)).T, color="#ffd34d", linewidth=7, alpha=0.6, zorder=1, label="best")
    for order, (name, curve) in enumerate(found.families.items()):
        notable = colors[name] != GREY
        places = np.array([(p.seconds, _shown_error(p, bottom)) for p in curve]).T  # [2, points]
        ends = np.array([(p.seconds_interval, p.rmse_interval) for p in curve]).transpose(1, 2, 0)
        reach = abs(ends - places[:, None])  # [2, 2, points]
        axes.errorbar(
            places[0],
            places[1],
            xerr=np.nan_to_num(reach[0]),
            yerr=np.nan_to_num(reach[1]),
            color=colors[name],
            ecolor=(colors[name], 0.45),
            marker=MARKERS[order % len(MARKERS)],
            markersize=5 if notable else 3,
            linewidth=1.6 if notable else 0.8,
            elinewidth=0.8,
            alpha=1 if notable else 0.7,
            zorder=3 if notable else 2,
        )
    if found.reference_error:
        axes.axhspan(bottom / 10, found.reference_error, color="0.92", zorder=0)
        words = "within the reference's own error"
        axes.text(0.02, 0.01, words, transform=axes.transAxes, fontsize=LABELS - 1.5, color=GREY)
    seconds, errors = np.array([(p.seconds, _shown_error(p, bottom)) for p in found.points.values()]).T
    axes.set_xlim(seconds.min() / 2.5, seconds.max() * 1.3)  # intervals may go on beyond
    axes.set_ylim(0.8 * bottom, 1.6 * errors.max())
    for scale in (axes.xaxis, axes.yaxis):
        plain_numbers(scale)
    top_right: Any = {"transform": axes.transAxes, "ha": "right", "va": "top"}
    axes.text(0.98, 0.98, "the best at each error", fontsize=LABELS, color="#a67c00", **top_right)
    axes.grid(alpha=0.25)
    _name_points(axes, best, bottom)


def _name_points(axes: Axes, best: Sequence[Point], bottom: float) -> None:
    """Write what distinguishes the best points from their curve below them, where there is room for it."""
    taken: list[np.ndarray] = []
    for point in best:
        name = " ".join(word for word in point.name.split() if word not in point.family.split())
        place = axes.transData.transform((point.seconds, _shown_error(point, bottom)))
        if name and all(abs((place - other) / (46, 13)).max() > 1 for other in taken):
            taken.append(place)
            shift: dict[str, Any] = {"xytext": (-4, -5), "textcoords": "offset points"}
            at = (point.seconds, _shown_error(point, bottom))
            axes.annotate(name, at, **shift, fontsize=LABELS - 1.5, color=TEXT, ha="right", va="top")
