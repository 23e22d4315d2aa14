"""Plots in colours that colour-blind people can distinguish."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, without yellow, which is pale on white
COLORS = ("#0072b2", "#d55e00", "#009e73", "#aa4499", "#56b4e9", "#e69f00", "#6a3d9a", "#8c510a")
GREY = "#8a8f98"
FONT = 9.0  # points


def panel(title: str, width: float = 4.6, height: float = 4.4) -> tuple[Figure, Axes]:
    """Return a figure of one plot with a title, of a size in inches that a phone shows whole."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained")
    axes = drawn.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=FONT)
    axes.set_title(title, loc="left", fontsize=FONT + 1)
    return drawn, axes


def logarithmic(axes: Axes, x: str, y: str) -> None:
    """Make both axes logarithmic, with labels and a grid."""
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel(x, fontsize=FONT)
    axes.set_ylabel(y, fontsize=FONT)
    axes.grid(alpha=0.25)


def plain_numbers(axes: Axes) -> None:
    """Label logarithmic axes with decimal numbers, 1, 2 and 5 of each decade, or fewer of many."""
    from matplotlib.ticker import LogLocator, NullLocator

    for axis in (axes.xaxis, axes.yaxis):
        least, most = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if most < 300 * least else (1,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())


def legend(axes: Axes) -> None:
    """Put the names of lines below the plot."""
    figure: Any = axes.figure
    figure.legend(loc="outside lower left", fontsize=FONT, ncols=2, frameon=False)
