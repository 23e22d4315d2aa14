"""Plots of laws that fail, by matplotlib, which is imported when a page is saved."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np

from .faults import PLACE
from .probe import Array
from .sphere import Cells

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .law import Outcome


def as_png(law: Outcome) -> str:
    """The plot of a law as Base64 text; "" if it has none, or matplotlib is not installed."""
    if law.plot is None:
        return ""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return ""
    figure = Figure((7, 4), layout="constrained")
    law.plot(figure)
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=110)
    return base64.b64encode(png.getvalue()).decode()


def density(cells: Cells, seen: Array, angle: float, figure: Figure) -> None:
    """Shares of samples in cells [C] against integrals of pdf(), per steradian, over both hemispheres.

    ``angle`` of incidence in degrees. Cells are summed up to those of the coarsest level.
    """
    side = 2 ** int(cells.level.min())
    edges = np.linspace(0, 1, side + 1)
    areas = 2 * np.pi / side * np.diff(edges**2)[:, None]
    azimuth = 2 * np.pi * edges - np.pi
    r, turn = cells.corner
    axes = figure.subplots(2, 3, subplot_kw={"projection": "polar"})
    for row, half, where in zip(axes, (~cells.below, cells.below), ("above", "below"), strict=True):
        samples, pdf = [
            np.histogram2d(r[half], turn[half], edges, weights=shares[half])[0] / areas
            for shares in (seen, cells.mean)
        ]
        drawn = {"samples": samples, "pdf()": pdf, "samples − pdf()": samples - pdf}
        for each, (name, values) in zip(row, drawn.items(), strict=True):
            top = abs(values).max()
            mesh = each.pcolormesh(azimuth, edges, values, cmap="RdBu_r", vmin=-top, vmax=top)
            each.set_title(f"{name}, wo {where}", fontsize="small")
            each.set_axis_off()
            figure.colorbar(mesh, ax=each, orientation="horizontal", label="per steradian")
    figure.suptitle(f"wi at {angle:.0f}° to the normal")


def swapped(forth: Array, back: Array, figure: Figure) -> None:
    """f(ωi, ωo) against f(ωo, ωi), both [N]."""
    axes = figure.subplots()
    lit = (forth > 0) & (back > 0)
    axes.loglog(back[lit], forth[lit], ".", markersize=2)
    ends = np.sort(back[lit])
    axes.plot(ends, ends, color="black", linewidth=0.8, label="reciprocal")
    axes.tick_params(axis="x", which="both", labelrotation=30)
    axes.set(xlabel="f(ωo, ωi) η_i²", ylabel="f(ωi, ωo) η_o²")
    axes.legend()


def albedo(angles: Array, samples: Array, errors: Array, figure: Figure) -> None:
    """Mean weights of samples, with six standard errors, against the angle of incidence. [N] each"""
    axes = figure.subplots()
    order = np.argsort(angles)
    axes.errorbar(angles[order], samples[order], 6 * errors[order], fmt="o-", label="mean weight of samples")
    axes.axhline(1, color="black", linewidth=0.8, label="all light reflected")
    axes.set(xlabel="angle of incidence (degrees; above 90 from behind)", ylabel="albedo, brightest channel")
    axes.set_ylim(bottom=0)
    axes.legend()


def normals(p: Array, geometric: Array, shading: Array, figure: Figure) -> None:
    """Normals at points [N, 3] of a surface, seen from (0.48, 0.36, 0.8), as colours (n + 1) / 2."""
    right = np.cross((0, 1, 0), PLACE)
    up = np.cross(PLACE, right)
    both = {"geometric normal": geometric, "shading normal": shading}
    for axes, (name, values) in zip(figure.subplots(1, 2), both.items(), strict=True):
        axes.scatter(p @ right, p @ up, s=2, c=np.nan_to_num(np.clip(0.5 * values + 0.5, 0, 1)))
        axes.set_title(f"{name}: (n + 1) / 2 as RGB")
        axes.set_aspect("equal")
        axes.set_axis_off()
