"""Figures that studies share: pictures side by side, each under its name, and curves."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from mrt_mitsuba.output.files import to_8bit


def gallery(pictures: Mapping[str, np.ndarray], *, columns: int = 2) -> Any:
    """Return a matplotlib figure of linear pictures [H, W, 3] of one size, as sRGB, ``columns`` to a row."""
    from matplotlib.figure import Figure

    rows = -(-len(pictures) // columns)
    height, width, _ = next(iter(pictures.values())).shape
    cell = 8 / columns
    figure = Figure(figsize=(8, rows * (cell * height / width + 0.35)), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (name, image) in zip(axes, pictures.items(), strict=False):
        axis.imshow(to_8bit(image, "srgb"))
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
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
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
