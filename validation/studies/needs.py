"""What scenes do not need: rays, code of kernels and seconds as planned, and where nothing is left out.

Then all layers are made, by kernels with all code, from as many rays in every pixel as edges get.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.files import LAYERS
from mrt_mitsuba.rendering.api import Result
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.study import Study, Values
from mrt_mitsuba.validation.timing import operations, timed_in_turns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "What a scene does not need"
SCENES = range(10)
TITLES = {"rays": "rays", "operations": "size of the tracing kernel, operations", "seconds": "time"}
REFINED: Values = {"progress": Progress(), "aa": 4, "aamode": "sobel", "lattice": "report"}
EVERYTHING: Values = {"layers": "all", "aamode": "none"}


def scenes_of(number: int, size: tuple[int, int]) -> tuple[mi.Scene, mi.Scene]:
    """Return a scene, and the same with kernels that leave nothing out."""
    width, height = size
    nodes = mrt.scene_dict(number, width=width, height=height)
    planned = mi.load_dict(nodes)
    whole = mi.load_dict(nodes)
    integrator = whole.integrator()
    data = integrator.prepare(whole)
    kernels = replace(
        data.plan,
        mirrors=True,
        lobes=tuple(name for name, _ in data.facts.lobes),
        bvh=True,
        tangents=True,
    )
    integrator.kernel_plan = lambda facts: kernels
    return planned, whole


def measure(number: int, size: tuple[int, int], repeats: int) -> Values:
    """Return the row of a scene with edges refined: figures as planned, and how much more of each else."""
    planned, whole = scenes_of(number, size)
    ways = (partial(mrt.render, planned, **REFINED), partial(mrt.render, whole, **REFINED | EVERYTHING))

    def in_turn(render: Callable[..., Result], turn: int) -> Result:
        return render()

    turns = timed_in_turns([partial(in_turn, render) for render in ways], repeats)
    figures: dict[str, list[float]] = {
        "rays": [sum(render(count_rays=True).rays.values()) for render in ways],
        "operations": [max(operations(render)) for render in ways],
        "seconds": [float(np.median(seconds)) for _, seconds in turns],
    }
    row: Values = {"scene": number, **{name: own for name, (own, _) in figures.items()}}
    row |= {f"{name}: times as many": other / own for name, (own, other) in figures.items()}
    left_out = turns[0][0][0].plan.left_out
    return row | {"left out": ", ".join(what for what, _ in left_out if what not in LAYERS)}


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    size = (64, 48) if quick else (320, 240)
    show(study, size, (0, 3, 7) if quick else SCENES, 3 if quick else 7)


def show(study: Study, size: tuple[int, int], scenes: Sequence[int], repeats: int) -> None:
    """Add the bars and the table of scenes to a study."""
    rows = []
    for number in study.each(TITLE, scenes):
        row = measure(number, size, repeats)
        rows.append(row)
        for name in ("rays", "operations"):
            why = "what is left out costs nothing; least fault: it stays"
            times_as_many = row[f"{name}: times as many"]
            study.at_least(f"scene {number}: {name} without a plan / with it", times_as_many, 1, why)
    caption = (
        "Blue: as planned, with the figure itself on the left. Orange: where nothing is left out: all code "
        "in the kernels, all layers, and as many rays in every pixel as edges get."
    )
    for name, title in TITLES.items():
        study.picture(f"savings {name}", title, savings(name, rows), caption if name == "rays" else "")
    columns = "{}x{} pixels; operations: of the largest kernel, in Dr.Jit's own code".format(*size)
    study.records("savings", "What each scene goes without", rows, columns, first=True)


def savings(name: str, rows: Sequence[Values]) -> Figure:
    """Draw how many times as much of a measure scenes cost where nothing is left out, a bar for each row."""
    from matplotlib.ticker import EngFormatter

    quantity = EngFormatter("s" if name == "seconds" else "", places=1)
    drawn, axes = plotting.panel(TITLES[name], height=0.3 * len(rows) + 1)
    times = np.array([row[f"{name}: times as many"] for row in rows])
    labels = [f"scene {row['scene']}: {quantity(row[name])}" for row in rows]
    axes.invert_yaxis()
    bars = axes.barh(labels, times, color="#f2b98f")
    axes.bar_label(bars, [f"× {factor:.2f}" for factor in times], padding=3, fontsize=plotting.FONT)
    axes.barh(labels, np.minimum(times, 1), color=plotting.COLORS[0])
    axes.margins(x=0.2)
    axes.set_xlabel("times as much as planned", fontsize=plotting.FONT)
    return drawn
