"""Where the time of a render goes: passes, kernels, rays, the floor of its rays, and what the plan saves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.studies import savings
from mrt_mitsuba.validation.tools import kernels
from mrt_mitsuba.validation.tools.costs import scene_cost
from mrt_mitsuba.validation.tools.kernels import Kernel
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Where the time of a render goes"

FLOOR_GOAL = 1.3  # seconds over the floor, of scenes with something to bounce
GOAL_SCENES = (1, 2, 3, 4)
MOST_OFF = 1e-5  # ten times what was seen: 16 of 30 million rays
SMALL_SHARE = 0.01  # of a render's time in kernels: below, kernels share a row


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    size: tuple[int, int]
    aa: int
    scenes: Sequence[int]  # with shapes in Mitsuba's tree: a floor is made of queries to it
    repeats: int
    plan_size: tuple[int, int]


FULL = Extent((800, 600), 4, (0, 1, 2, 3, 4), 5, (400, 300))
QUICK = Extent((96, 72), 2, (0, 3), 3, (96, 72))

PASS_COLUMNS = ("scene", "pass", "seconds", "share", "in kernels, s", "launches", "compile, s")
WEIGHTS = ("launches", "size", "operations", "compile", "codegen", "seconds")
KERNEL_COLUMNS = ("scene", "pass", "kernel", "hash", "launches", "threads", "operations", "compile, s",
                  "code, s", "running, s", "share")  # fmt: skip


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    _default_render(study, extent)
    _floors(study, extent, goals=not quick)
    savings.table(study, size=extent.plan_size, aa=extent.aa, repeats=3 * extent.repeats)


# ------------------------------------------- The default render -------------------------------------------


def _default_render(study: Study, extent: Extent) -> None:
    """Add the passes and kernels of a warm render with the default options."""
    width, height = extent.size
    passes: list[tuple[Any, ...]] = []
    rows: list[tuple[Any, ...]] = []
    for number in study.each("Passes and kernels", extent.scenes):
        render = partial(mrt.render, number, width=width, height=height, aa=extent.aa)
        found = kernels.profile(render, repeats=extent.repeats)
        passes += _pass_rows(number, render().timings, found)
        rows += _kernel_rows(number, found)
    what = f"of the default render, {width}x{height}, aa={extent.aa}"
    note = (
        "Beyond its kernels a pass takes what Python and Dr.Jit need to write them down, whatever the size."
    )
    study.table("passes", f"Passes {what}", PASS_COLUMNS, passes, note)
    note = (
        "Compile: of a first run without cached kernels (what a cache holds takes none). Code: what Dr.Jit "
        "takes to write the code, every time. Names like BlockReduce are Dr.Jit's own."
    )
    study.table("kernels", f"Kernels {what}", KERNEL_COLUMNS, rows, note)


def _pass_rows(number: int, timings: Any, found: Sequence[Kernel]) -> list[tuple[Any, ...]]:
    """Return ``PASS_COLUMNS`` of a warm render, and of the kernels of one like it."""
    rows = []
    for name, seconds in {"scene and plan": timings.load, **timings.passes}.items():
        stage = kernels.OUTSIDE if name == "scene and plan" else name
        own = [k for k in found if k.stage == stage]
        counts = (sum(k.seconds for k in own), sum(k.launches for k in own), sum(k.compile for k in own))
        rows.append((number, name, seconds, seconds / timings.total, *counts))
    return rows


def _kernel_rows(number: int, found: Sequence[Kernel]) -> list[tuple[Any, ...]]:
    """Return ``KERNEL_COLUMNS``: kernels of any weight by themselves, the others together."""
    total = sum(k.seconds for k in found)
    small = [k for k in found if k.seconds < SMALL_SHARE * total]
    groups = [((k.stage, k.kind, k.hash[:6]), [k]) for k in found if k not in small]
    groups += [(("all", f"{len(small)} others", ""), small)] if small else []
    sums = [(names, [sum(getattr(k, w) for k in group) for w in WEIGHTS]) for names, group in groups]
    return [(number, *names, *weights, weights[-1] / total) for names, weights in sums]


# ------------------------------------------------ The floor ------------------------------------------------


def _floors(study: Study, extent: Extent, *, goals: bool) -> None:
    scenes = study.each("Floor of the rays", extent.scenes)
    rows = [_floor_row(study, number, extent, goals) for number in scenes]
    title = f"Every pixel supersampled, {extent.size[0]}x{extent.size[1]}, aa={extent.aa}"
    note = (
        "Floor: the same rays, recorded, through Mitsuba's ray queries alone, in turn with renders. What is "
        "not in kernels does not grow with the picture: the larger it is, the nearer the ratio of the "
        "kernels."
    )
    study.records("floor", title, rows, note)


def _floor_row(study: Study, number: int, extent: Extent, goals: bool) -> dict[str, Any]:
    """Return a row of the table of floors; the recorded rays are held to those that the integrator counts."""
    found = scene_cost(number, extent.size, extent.aa, repeats=extent.repeats)
    time, floor = found.floor, found.floor.other_seconds
    what = f"scene {number}: share of rays recorded or counted, but not both"
    why = (
        "recording takes the loop apart; other code rounds a few rays to the other side of an edge. One kind "
        "of ray that is not counted, or counted twice, leaves tens of percent"
    )
    study.at_most(what, found.share_off, MOST_OFF, why)
    if goals and number in GOAL_SCENES:
        quartiles = f"quartiles {time.low:.3g} and {time.high:.3g} of {extent.repeats} ratios"
        interval = (time.low, time.high)
        study.goal(f"scene {number}: seconds / floor", time.median, FLOOR_GOAL, quartiles, interval=interval)
    return {
        "scene": number,
        "seconds": found.warm.seconds,
        "spread": found.warm.spread,
        "in kernels": found.in_kernels,
        "launches": sum(k.launches for k in found.each),
        "compile, s": found.compile,
        "camera rays": found.counted["primary"],
        "mirror rays": found.counted["mirror"],
        "shadow rays": found.counted["shadow"],
        "million rays / s": found.rays_per_second / 1e6,
        "floor, s": floor,
        "seconds / floor": time.median,
        "kernels / floor": found.in_kernels / floor,
    }
