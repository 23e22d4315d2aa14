"""Figures of real runs, for the documentation and for your own scenes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.files.images import to_8bit
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.compare import averaged
from mrt_mitsuba.validation.originals import read_original
from mrt_mitsuba.validation.studies import error_vs_time, needs
from mrt_mitsuba.validation.studies.honest import by_tenths
from mrt_mitsuba.validation.studies.stability import curves
from mrt_mitsuba.validation.study import Study, findings
from mrt_mitsuba.validation.work_precision import Findings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Rows = list[dict[str, Any]]
Drawn = tuple[list["Figure"], Rows]  # and the rows of its table

SMALL = (160, 120)
MAPS = {"error.Y": "stated error of each pixel", "samples.Y": "rays of each pixel"}  # titles by layer


def error_against_time(*scenes: error_vs_time.Number, quick: bool = False) -> Drawn:
    """Diagrams of all that a user can choose in scenes, and what to use to get to an error."""
    panels: dict[str, Findings] = {}
    for scene in scenes:
        cost = replace(error_vs_time.QUICK, cold=False) if quick else error_vs_time.shown(scene)
        panels |= error_vs_time.choices(scene, cost)
    drawn = [plotting.work_precision(title, found) for title, found in panels.items()]
    return drawn, error_vs_time.advice(panels)


def hard_axes(*, quick: bool = False) -> Drawn:
    """Errors in roundings of float32 along the axes that are hard on it, and where lines break."""
    return _of_study("roundings", findings(curves.show, quick=True, places=3 if quick else 21))


def left_out(*, quick: bool = False) -> Drawn:
    """What the numbered scenes would cost if nothing were left out, and what each goes without."""
    scenes, repeats = ((3,), 1) if quick else (needs.SCENES, 3)
    return _of_study("savings", findings(needs.show, size=SMALL, scenes=scenes, repeats=repeats))


def _of_study(name: str, study: Study) -> Drawn:
    table = study.tables[name]
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    return [image["content"] for image in study.images.values()], rows


def beside_the_original(folder: str | os.PathLike[str]) -> Drawn:
    """Scenes 0 to 4 by the original program and by ours, with their difference times 100.

    ``folder``: of the pictures ``sN_none_aa4.exr``, whole or shortened.
    """
    drawn, plots = plotting.figure(5, 3, 7.2, 9.4)
    rows: Rows = []
    for scene, row in enumerate(plots):
        original = read_original(Path(folder) / f"s{scene}_none_aa4.exr")
        result = mrt.render(original.scene, fresnel="dielectric", progress=Progress(), **original.options)
        ours = original.like(result.image)
        difference = np.abs(ours - original.image)
        for axes, picture in zip(row, (original.image, ours, 100 * difference), strict=True):
            show_picture(axes, picture)
        row[0].set_ylabel(f"scene {scene}")
        off = (difference.max(axis=-1) > 1 / 255).mean()
        rows.append(
            {
                "scene": scene,
                "mean difference": float(difference.mean()),
                "pixels off by > 1/255": f"{off:.2%}",
            }
        )
    for axes, title in zip(plots[0], ("original", "ours", "|difference| × 100"), strict=True):
        axes.set_title(title, loc="left", **plotting.WORDS)
    return [drawn], rows


def show_picture(axes: Any, picture: np.ndarray, tonemap: str = "report") -> None:
    """Show a linear picture [H, W, 3], by default as the report writes it."""
    axes.imshow(to_8bit(np.ascontiguousarray(picture, np.float32), tonemap), interpolation="nearest")
    _unframe(axes)


def _unframe(axes: Any) -> None:
    axes.set(xticks=[], yticks=[], anchor="N")
    axes.spines[:].set_visible(False)


def maps(result: mrt.Result) -> list[Figure]:
    """The stated error of each pixel, and its rays, of a render in rounds."""
    height, width = result.image.shape[:2]
    figures = []
    for layer, title in MAPS.items():
        drawn, axes = plotting.panel(title, 4.6, 4.6 * height / width + 0.8)
        show_map(axes, result.layers[layer])
        figures.append(drawn)
    return figures


def show_map(axes: Any, values: np.ndarray) -> None:
    """Show positive values [H, W] in colours, on a scale of logarithms."""
    least, most = np.quantile(values[values > 0], (0.05, 1))
    shown = axes.imshow(np.maximum(values, least), cmap="viridis", norm="log", vmin=least, vmax=most)
    bar = axes.figure.colorbar(shown, ax=axes, location="bottom", fraction=0.05, pad=0.02)
    plotting.plain_numbers(bar.ax.xaxis)
    _unframe(axes)


def tenths(scene: Any, *, seeds: int, truth_spp: int, spp: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """The stated and the true error of tenths of the pixels [10], sorted by the stated one.

    Of renders by ``path`` with a mean of ``spp`` rays a pixel where they are needed, one for each seed. The
    noise of the truth is subtracted from its squares.
    """
    path = mi.load_dict({"type": "path"})
    parts = [mi.render(scene, integrator=path, spp=truth_spp // 8, seed=1000 + k) for k in range(8)]
    truth, noise = averaged(parts)
    stated: list[np.ndarray] = []
    true: list[np.ndarray] = []
    for seed in range(seeds):
        result = mrt.render(scene, integrator="path", aamode="noise", spp=spp, seed=seed, progress=Progress())
        stated.append(np.square(result.layers["error.Y"]))
        true.append(np.square(result.image - truth).mean(axis=-1) - noise)
    return by_tenths(np.array(stated), np.array(true))


def stated_and_true(scenes: Mapping[str, Any], *, seeds: int = 8, truth_spp: int = 2048) -> Figure:
    """A plot of the true over the stated error of tenths of the pixels, a line for each loaded scene."""
    found = {name: tenths(scene, seeds=seeds, truth_spp=truth_spp) for name, scene in scenes.items()}
    drawn, axes = plotting.panel("tenths of the pixels, sorted by stated error", 4.6, 4.0)
    ends = {}
    for (name, (stated, true)), color in zip(found.items(), plotting.COLORS, strict=False):
        axes.plot(stated, true, marker="o", markersize=4, color=color)
        ends[name] = (stated[-1], true[-1], color)
    values = np.concatenate([np.ravel(lines) for lines in found.values()])
    span = np.array([values.min() / 1.3, values.max() * 1.3])
    axes.plot(span, span, color=plotting.TEXT, linewidth=0.8)
    axes.fill_between(span, span / 3, span * 3, color="0.93", zorder=0)
    axes.set(xscale="log", yscale="log", xlim=span, ylim=span, xlabel="stated error", ylabel="true error")
    plotting.plain_numbers(axes.xaxis, axes.yaxis)
    plotting.note(axes, 0.03, 0.97, "grey: within a factor of 3", va="top")
    plotting.label_ends(axes, ends)
    return drawn
