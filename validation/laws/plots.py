"""Plots of laws that fail, by matplotlib, which is imported when a page is written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .probe import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained")


def density(seen: Array, expected: Array, angle: float) -> Figure:
    """Densities of samples and of pdf() over both hemispheres, for light that arrives at an angle in degrees.

    Both are [2, R, A], per steradian, in equal steps of √(1 − |cos θ|) and of azimuth, from −π on.
    """
    figure = _figure(7, 5.2)
    top = max(float(np.quantile(expected, 0.99)), float(np.quantile(seen, 0.99)), 1e-12)
    radii = np.linspace(0, 1, seen.shape[1] + 1)
    turns = np.linspace(-np.pi, np.pi, seen.shape[2] + 1)
    rows = (
        ("samples", seen, "viridis", 0),
        ("pdf()", expected, "viridis", 0),
        ("difference", seen - expected, "RdBu_r", -top),
    )
    for i, side in enumerate(("cos θo > 0", "cos θo < 0")):
        for j, (name, values, colors, low) in enumerate(rows):
            axes = figure.add_subplot(2, 3, 3 * i + j + 1, projection="polar")
            mesh = axes.pcolormesh(turns, radii, values[i], cmap=colors, vmin=low, vmax=top)
            axes.set_yticks([])
            axes.set_xticks([])
            axes.set_title(f"{name}, {side}", fontsize="small")
            if i == 1 and j:
                figure.colorbar(mesh, ax=axes, orientation="horizontal", format="%.0e")
    figure.suptitle(f"density per steradian, wi at {angle:.0f}° to the normal", fontsize="medium")
    return figure


def swapped(forth: Array, back: Array) -> Figure:
    """f(ωi, ωo) against f(ωo, ωi), both [N]."""
    figure = _figure(5, 4.4)
    axes = figure.add_subplot()
    both = (forth > 0) & (back > 0)
    axes.loglog(back[both], forth[both], ".", markersize=2)
    ends = (
        [min(forth[both].min(), back[both].min()), max(forth[both].max(), back[both].max())]
        if both.any()
        else [0.1, 1]
    )
    axes.plot(ends, ends, color="black", linewidth=0.8, label="reciprocal")
    axes.set_xlabel("f(ωo, ωi) η_i²")
    axes.set_ylabel("f(ωi, ωo) η_o²")
    axes.legend()
    return figure


def albedo(angles: Array, samples: Array, errors: Array, quadrature: Array) -> Figure:
    """Albedos [N] by samples, with standard errors, and by quadrature of eval(), NaN where unknown."""
    figure = _figure(6, 4)
    axes = figure.add_subplot()
    order = np.argsort(angles)
    axes.errorbar(angles[order], samples[order], 6 * errors[order], fmt="o-", label="mean weight of samples")
    known = np.isfinite(quadrature)
    axes.plot(angles[known], quadrature[known], "x", label="∫ eval() dωo")
    axes.axhline(1, color="black", linewidth=0.8)
    axes.set_xlabel("angle of incidence (degrees; above 90 from behind)")
    axes.set_ylabel("albedo, the brightest channel")
    axes.set_ylim(bottom=0)
    axes.legend()
    return figure


def normals(geometric: Array, shading: Array, seen: Array) -> Figure:
    """Normals in a square picture [N, 3] as colours (n + 1) / 2, where a surface is seen [N]."""
    side = int(len(seen) ** 0.5)
    figure = _figure(7, 3.4)
    for i, (name, values) in enumerate((("geometric normal", geometric), ("shading normal", shading))):
        axes = figure.add_subplot(1, 2, i + 1)
        colors = np.where(seen[:, None], np.clip(0.5 * values + 0.5, 0, 1), 1)
        axes.imshow(np.nan_to_num(colors).reshape(side, side, 3))
        axes.set_title(f"{name}: (n + 1) / 2 as RGB", fontsize="small")
        axes.set_axis_off()
    return figure
