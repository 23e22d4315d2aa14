"""What pages answer, from renders that are made while the site is built."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mrt_mitsuba as mrt
import pages
from mrt_mitsuba.validation import figures


class Answer(NamedTuple):
    """What a page shows: a sentence, plots, and a table."""

    sentence: pages.Markdown
    plots: pages.Html
    table: pages.Markdown


def answer(
    sentence: str,
    drawn: figures.Drawn,
    columns: dict[str, str] | None = None,
    width: str = "18rem",
) -> Answer:
    """An answer; ``columns``: headings, and the names of rows below them."""
    plots, rows = drawn
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
    scenes = (0, "Cornell box")
    if not pages.QUICK:
        scenes = (0, 1, 2, 3, 4, "Cornell box")
    drawn = figures.error_against_time(*scenes, quick=pages.QUICK)
    return answer(
        "Centred rays beat the report's lattice at every error; refining "
        "edges is the fastest while they are few (scenes 0 to 3), rays in "
        "every pixel where they are many (scene 4); and against the noise of "
        "paths, a stratified sampler does more than more rays.",
        drawn,
    )


def hard_axes() -> Answer:
    """Where float32 breaks formulas."""
    mrt.register()
    drawn = figures.hard_axes(quick=pages.QUICK)
    rows = drawn[1]
    ours = max(_worst(rows, "ours"))
    theirs = sum(figure > 1000 for figure in _worst(rows, "Mitsuba"))
    first = sum(figure > 1000 for figure in _worst(rows, "as first written"))
    return answer(
        f"Ours is off by {ours:.0f} roundings of float32 at most. Along "
        f"{first} of these {len(rows)} axes, the formula as one would write "
        "it first loses three digits or all of them, and so does Mitsuba's "
        f"nearest along {theirs}.",
        drawn,
        {
            "what": "what",
            "along": "along",
            "ours": "ours, worst",
            "promised": "promised",
            "Mitsuba's": "Mitsuba, worst",
            "first": "as first written, worst",
            "which breaks at": "which breaks at",
        },
    )


def _worst(rows: Sequence[dict[str, Any]], name: str) -> list[float]:
    return [row[f"{name}, worst"] for row in rows]


def left_out() -> Answer:
    """What scenes would cost if nothing were left out."""
    drawn = figures.left_out(quick=pages.QUICK)
    rays, size, time = (
        max(row[f"{name}: times as many"] for row in drawn[1])
        for name in ("rays", "operations", "seconds")
    )
    return answer(
        f"What a scene does not need would cost it up to {rays:.1f} times "
        f"the rays, a kernel {size:.1f} times as large, and {time:.1f} times "
        "the time.",
        drawn,
        {"scene": "scene", "left out": "left out"},
    )


def original() -> Answer:
    """Scenes by the original program, by ours, and their difference."""
    drawn = figures.beside_the_original(pages.ORIGINALS)
    assert max(row["mean difference"] for row in drawn[1]) < 3e-4
    return answer(
        "On average, our pictures are within 3e-4 of the original's.",
        drawn,
        width="40rem",
    )


def own_scene(scene: Any, result: mrt.Result) -> pages.Html:
    """Maps of a render in rounds, and its errors against the true ones."""
    few = {"seeds": 2, "truth_spp": 64} if pages.QUICK else {}
    honest = figures.stated_and_true({"Cornell box": scene}, **few)
    return pages.plots(*figures.maps(result), honest)
