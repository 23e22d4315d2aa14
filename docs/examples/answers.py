"""What pages answer, from renders that are made while the site is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mrt_mitsuba as mrt  # first: it chooses the LLVM library

# isort: split
import numpy as np

import pages
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation import work_precision
from mrt_mitsuba.validation.originals import read_original
from mrt_mitsuba.validation.studies import error_vs_time, needs
from mrt_mitsuba.validation.studies.stability import axes
from mrt_mitsuba.validation.study import Study, findings

Rows = list[dict[str, Any]]


class Answer(NamedTuple):
    """What a page shows: a sentence, plots, and a table."""

    sentence: pages.Markdown
    plots: Any  # as notebooks show it
    table: pages.Markdown


def answer(
    sentence: str,
    plots: Sequence[Any],
    rows: Rows,
    columns: dict[str, str] | None = None,
    width: str = "18rem",
) -> Answer:
    """An answer; ``columns``: headings, and the names of rows below them."""
    if columns:
        rows = [
            {head: row[name] for head, name in columns.items()}
            for row in rows
        ]
    return Answer(
        pages.Markdown(f"**{sentence}**"),
        pages.plots(*plots, width=width),
        pages.table(rows),
    )


def error_against_time() -> Answer:
    """All that a user can choose, in the report's scenes and Mitsuba's."""
    scenes = (0,) if pages.QUICK else (0, 1, 2, 3, 4, "Cornell box")
    panels: dict[str, work_precision.Findings] = {}
    cost = error_vs_time.QUICK if pages.QUICK else error_vs_time.DOCS
    for scene in scenes:
        panels |= error_vs_time.scene_findings(scene, cost)
    plots = [
        work_precision.diagram(title, found)
        for title, found in panels.items()
    ]
    middle = {
        title: found.errors[len(found.errors) // 2]
        for title, found in panels.items()
        if found.errors
    }
    rows = [
        {"in": title, "the fastest": panels[title].verdict(error)}
        for title, error in middle.items()
    ]
    open_ones = sum("no winner" in row["the fastest"] for row in rows)
    return answer(
        f"In {len(rows) - open_ones} of these {len(rows)} comparisons, one "
        "way is the fastest to the error in the table; in the others, no "
        "winner can be named.",
        plots,
        rows,
    )


def hard_axes() -> Answer:
    """Where float32 breaks formulas."""
    mrt.register()
    found = findings(axes.show, quick=True)
    plots, rows = _shown(found, "roundings")
    ours = max(_worst(rows, "ours"))
    theirs = sum(figure > 1000 for figure in _worst(rows, "Mitsuba"))
    return answer(
        f"Ours is off by {ours:.0f} roundings of float32 at most; Mitsuba's "
        f"nearest plugin loses three digits or more along {theirs} of these "
        f"{len(rows)} axes.",
        plots,
        rows,
        {
            "what": "what",
            "along": "along",
            "ours": "ours, worst",
            "promised": "promised",
            "Mitsuba's": "Mitsuba, worst",
        },
    )


def _shown(study: Study, name: str) -> tuple[list[Any], Rows]:
    """The plots of a study, and the rows of one of its tables."""
    rows = study.tables[name]["rows"]
    return [image["content"] for image in study.images.values()], rows


def _worst(rows: Sequence[dict[str, Any]], name: str) -> list[float]:
    return [row[f"{name}, worst"] for row in rows]


def left_out() -> Answer:
    """What scenes would cost if nothing were left out."""
    scenes, repeats = ((3,), 1) if pages.QUICK else (needs.SCENES, 3)
    found = findings(
        needs.show, size=(160, 120), scenes=scenes, repeats=repeats
    )
    plots, rows = _shown(found, "savings")
    rays, size, time = (
        max(row[f"{name}: times as many"] for row in rows)
        for name in ("rays", "operations", "seconds")
    )
    return answer(
        f"What a scene does not need would cost it up to {rays:.1f} times "
        f"the rays, a kernel {size:.1f} times as large, and {time:.1f} times "
        "the time.",
        plots,
        _dots({row["scene"]: row["left out"] for row in rows}),
    )


def _dots(left_out: dict[int, str]) -> list[dict[str, str]]:
    """Rows with a dot for each scene that goes without something."""
    film = "BoxFilter and IndependentSampler"  # the lattice goes without
    without = {
        scene: text.replace(film, "filter and sampler").split(", ")
        for scene, text in left_out.items()
    }
    everything = dict.fromkeys(
        part for parts in without.values() for part in parts
    )
    return [
        {"scene": part}
        | {
            str(scene): "•" if part in without[scene] else ""
            for scene in without
        }
        for part in everything
    ]


def original() -> Answer:
    """Scenes by the original program, by ours, and their difference."""
    pictures: list[np.ndarray] = []
    rows = []
    for scene in range(5):
        known = read_original(f"{pages.ORIGINALS}/s{scene}_none_aa4.exr")
        options = pages.SIZE | {"fresnel": "dielectric"} | known.options
        ours = known.like(mrt.render(scene, **options).image)
        difference = abs(ours - known.image)
        pictures += known.image, ours, 100 * difference
        off = (difference.max(axis=-1) > 1 / 255).mean()
        row = {"scene": scene, "mean difference": float(difference.mean())}
        rows.append(row | {"pixels off by > 1/255": f"{off:.2%}"})
    assert max(row["mean difference"] for row in rows) < 3e-4
    return Answer(
        pages.Markdown(
            "**The rebuilt renders differ from the original's by less than "
            "3e-4 on average.**"
        ),
        pages.show(*pictures),
        pages.table(rows),
    )


Render = tuple[Any, dict[str, Any]]  # a scene and its options


def switches() -> pages.Markdown:
    """What each switch of the ledger changes in a picture."""
    textured, cone = report_scene(8), report_scene(9)
    house = Path(__file__).parent / "house.obj"
    focus = {"focaldist": 3.0, "focalrange": 0.5}
    moving = {"aa": 2, "motion": (0.25, 0, -0.25), "motionsamples": 8}
    unclamped = {"integrator": {"type": "mrt_whitted", "clamp": False}}
    changes: dict[str, tuple[Render, Render]] = {
        "Sub-pixel lattice": _option(
            3, "lattice", "report", "centered", aa=4
        ),
        "Clamp of each light": ((1, {}), (1, unclamped)),
        "Fresnel": _option(3, "fresnel", "schlick", "dielectric"),
        "Sobel, to every pixel": _option(3, "aamode", "sobel", "none", aa=4),
        "Depth of field": _option(3, "dof", "report", "corrected", **focus),
        "The cone and its shadow": (
            (cone, {}),
            (replace(cone, cones=()), {}),
        ),
        "Textures": (
            (textured, {}),
            (replace(textured, texturing="standard"), {}),
        ),
        "MTL files": _option(house, "convention", "report", "standard"),
        "Motion blur": _option(3, "lattice", "report", "film", **moving),
    }
    return pages.table([_changed(what, *changes[what]) for what in changes])


def _option(
    scene: Any, name: str, old: str, new: str, **others: Any
) -> tuple[Render, Render]:
    return (scene, {**others, name: old}), (scene, {**others, name: new})


def _changed(what: str, before: Render, after: Render) -> dict[str, Any]:
    plain = {**pages.SIZE, "aamode": "none", "aa": 1, "focaldist": 0}
    results = [
        mrt.render(scene, **{**plain, **options})
        for scene, options in (before, after)
    ]
    found = mrt.compare(*results)
    assert found.rmse > 0
    steps = np.abs(found.difference).max(axis=2) > 1 / 255
    return {
        "what": what,
        "RMSE": f"{found.rmse:.1e}",
        "pixels changed": f"{np.mean(steps):.1%}",
    }
