"""Figures that studies share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def panels(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    """Return a matplotlib figure of a size in inches, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def curves(series: Mapping[str, tuple[Any, Any]], xlabel: str, ylabel: str, *, level: float) -> Any:
    """Return a matplotlib figure of curves (x, y) by name; ``level``: a horizontal line to compare with."""
    figure, axes = panels(6.4, 4.2)
    for name, (x, y) in series.items():
        axes.plot(x, y, "o-", markersize=4, label=name)
    axes.axhline(level, color="grey", linestyle=":")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.legend(fontsize="small")
    return figure
