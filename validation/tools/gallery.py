"""Pictures side by side, each under its name, in a figure that a phone can show."""

from __future__ import annotations

from collections.abc import Mapping
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
