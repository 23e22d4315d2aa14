"""Plots in colours that colour-blind people can distinguish."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mrt_mitsuba.files.images import to_8bit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, without yellow, which is pale on white
COLORS = ("#0072b2", "#d55e00", "#009e73", "#aa4499", "#56b4e9", "#e69f00", "#6a3d9a", "#8c510a")
GREY = "#8a8f98"
FONT = 9.0  # points
MAPS = {"error.Y": "standard error of each pixel", "samples.Y": "samples of each pixel"}  # titles by layer


def panels(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure of a size in inches, and its plots [rows, columns]."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained")
    plots = drawn.subplots(rows, columns, squeeze=False)
    for axes in plots.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=FONT)
        axes.title.set_fontsize(FONT + 1)
    return drawn, plots


def panel(title: str, width: float = 4.6, height: float = 4.4) -> tuple[Figure, Axes]:
    """Return a figure of one plot with a title, of a size in inches that a phone shows whole."""
    drawn, plots = panels(1, 1, width, height)
    plots[0, 0].set_title(title, loc="left", fontsize=FONT + 1)
    return drawn, plots[0, 0]


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


def show_picture(axes: Axes, picture: np.ndarray, tonemap: str = "report") -> None:
    """Show a linear picture [H, W, 3], by default as the report writes it."""
    axes.imshow(to_8bit(np.ascontiguousarray(picture, np.float32), tonemap), interpolation="nearest")
    axes.set(xticks=[], yticks=[], anchor="N")
    axes.spines[:].set_visible(False)


def maps(result: Any) -> list[Figure]:
    """Return plots of the reported error and the samples of each pixel of an adaptive render."""
    height, width = result.image.shape[:2]
    figures = []
    for layer, title in MAPS.items():
        drawn, axes = panel(title, height=4.6 * height / width + 0.8)
        values = result.layers[layer]
        shown = axes.imshow(values.clip(np.quantile(values[values > 0], 0.05)), norm="log")
        drawn.colorbar(shown, location="bottom", fraction=0.05, pad=0.02)
        axes.set(xticks=[], yticks=[], anchor="N")
        axes.spines[:].set_visible(False)
        figures.append(drawn)
    return figures
