"""Figures that studies share: pictures side by side, each under its name, and curves."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from mrt_mitsuba.output.files import to_8bit


def panels(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    """Return a matplotlib figure of a size in inches, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def gallery(
    pictures: Mapping[str, np.ndarray], *, columns: int = 2, width: float = 8, title: float = 0.35
) -> Any:
    """Return a matplotlib figure of linear pictures [H, W, 3] of one size, as sRGB, ``columns`` to a row.

    ``width`` of the figure and height of a ``title`` are in inches.
    """
    rows = -(-len(pictures) // columns)
    high, wide, _ = next(iter(pictures.values())).shape
    figure, axes = panels(width, rows * (width / columns * high / wide + title), rows, columns, squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for axis, (name, image) in zip(axes.ravel(), pictures.items(), strict=False):
        axis.imshow(to_8bit(image, "srgb"), interpolation="nearest")
        axis.set_title(name, fontsize="small")
    return figure


def curves(
    series: Mapping[str, tuple[Any, Any]],
    xlabel: str,
    ylabel: str,
    *,
    log: bool = True,
    dashed: Collection[str] = (),
    level: float | None = None,
    ticks: Sequence[float] = (),
) -> Any:
    """Return a matplotlib figure of curves (x, y) by name; ``level``: a horizontal line to compare with."""
    figure, axes = panels(6.4, 4.2)
    for name, (x, y) in series.items():
        (axes.loglog if log else axes.plot)(x, y, "--" if name in dashed else "o-", markersize=4, label=name)
    if ticks:
        axes.set_xticks(ticks, [f"{value:g}" for value in ticks])
        axes.minorticks_off()
    if level is not None:
        axes.axhline(level, color="grey", linestyle=":")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.legend(fontsize="small")
    return figure
