"""Where the time of a render goes: passes, kernels, rays, the floor of its rays, and what the plan saves."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.studies import savings
from mrt_mitsuba.validation.tools import kernels
from mrt_mitsuba.validation.tools.floor import floor
from mrt_mitsuba.validation.tools.kernels import Kernel
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import measure

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
QUICK = Extent((96, 72), 2, (0, 3), 1, (96, 72))

PASS_COLUMNS = ("scene", "pass", "seconds", "share", "in kernels, s", "launches", "compile, s")
KERNEL_COLUMNS = (
    "scene",
    "pass",
    "kernel",
    "hash",
    "launches",
    "threads",
    "operations",
    "compile, s",
    "code, s",
    "running, s",
    "share",
)
FLOOR_COLUMNS = (
    "scene",
    "seconds",
    "spread",
    "in kernels",
    "launches",
    "compile, s",
    "camera rays",
    "mirror rays",
    "shadow rays",
    "million rays / s",
    "floor, s",
    "seconds / floor",
    "kernels / floor",
)
RAYS = {"primary": "camera", "mirror": "mirror", "shadow": "shadow"}  # as counted: as recorded


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    _default_render(study, extent)
    _floors(study, extent)
    savings.table(study, size=extent.plan_size, aa=extent.aa, repeats=3 * extent.repeats)


# ------------------------------------------- The default render -------------------------------------------


def _default_render(study: Study, extent: Extent) -> None:
    """Passes and kernels of a warm render with the default options."""
    width, height = extent.size
    passes, rows = [], []
    with study.stage("Passes and kernels", len(extent.scenes)) as advance:
        for number in extent.scenes:
            render = partial(mrt.render, number, width=width, height=height, aa=extent.aa)
            found = kernels.profile(render, repeats=max(3, extent.repeats))
            passes += _pass_rows(number, render().timings, found)
            rows += _kernel_rows(number, found)
            gc.collect()
            advance(1)
    what = f"of the default render, {width}x{height}, aa={extent.aa}"
    study.table(
        "passes",
        f"Passes {what}",
        PASS_COLUMNS,
        passes,
        "Beyond its kernels a pass takes what Python and Dr.Jit need to write them down, whatever the size.",
    )
    study.table(
        "kernels",
        f"Kernels {what}",
        KERNEL_COLUMNS,
        rows,
        "Compile: of a first run without cached kernels (what a cache holds takes none). Code: what Dr.Jit "
        "takes to write the code, every time. Names like BlockReduce are Dr.Jit's own.",
    )
    study.text(_passes_sentence(passes))


def _pass_rows(number: int, timings: Any, found: Sequence[Kernel]) -> list[tuple[Any, ...]]:
    """``PASS_COLUMNS`` of a warm render, and of the kernels of one like it."""
    rows = []
    for name, seconds in {"scene and plan": timings.load, **timings.passes}.items():
        stage = kernels.OUTSIDE if name == "scene and plan" else name
        own = [k for k in found if k.stage == stage]
        counts = (sum(k.seconds for k in own), sum(k.launches for k in own), sum(k.compile for k in own))
        rows.append((number, name, seconds, seconds / timings.total, *counts))
    return rows


def _kernel_rows(number: int, found: Sequence[Kernel]) -> list[tuple[Any, ...]]:
    """``KERNEL_COLUMNS``: kernels of any weight by themselves, the others together."""
    total = sum(k.seconds for k in found)
    large = [k for k in found if k.seconds >= SMALL_SHARE * total]
    small = [k for k in found if k.seconds < SMALL_SHARE * total]
    rows = [
        (
            number,
            k.stage,
            k.kind,
            k.hash[:6],
            k.launches,
            k.size,
            k.operations,
            k.compile,
            k.codegen,
            k.seconds,
            k.seconds / total,
        )
        for k in large
    ]
    if small:
        sums = [sum(getattr(k, name) for k in small) for name in ("launches", "size", "operations", "compile",
                                                                  "codegen", "seconds")]  # fmt: skip
        rows.append((number, "all", f"{len(small)} others", "", *sums, sums[-1] / total))
    return rows


def _passes_sentence(rows: Sequence[tuple[Any, ...]]) -> str:
    """Where most of the time goes, by scene, and how much of it is in kernels."""
    scenes = dict.fromkeys(row[0] for row in rows)
    longest = [max((row for row in rows if row[0] == n), key=lambda row: row[2]) for n in scenes]
    shares = {n: sum(r[4] for r in rows if r[0] == n) / sum(r[2] for r in rows if r[0] == n) for n in scenes}
    least, most = (pick(shares, key=shares.__getitem__) for pick in (min, max))
    parts = ", ".join(f"{row[1]} in scene {row[0]} ({row[3]:.0%})" for row in longest)
    return (
        f"With the default options most of the time goes into {parts}. Kernels take {shares[least]:.0%} "
        f"(scene {least}) to {shares[most]:.0%} (scene {most}) of it, the rest is start-up of the render in "
        "Python."
    )


# ------------------------------------------------ The floor ------------------------------------------------


def _floors(study: Study, extent: Extent) -> None:
    width, height = extent.size
    with study.stage("Floor of the rays", len(extent.scenes)) as advance:
        rows = []
        for number in extent.scenes:
            rows.append(_floor_row(study, number, extent))
            gc.collect()
            advance(1)
    study.table(
        "floor",
        f"Every pixel supersampled, {width}x{height}, aa={extent.aa}",
        FLOOR_COLUMNS,
        rows,
        "Floor: the same rays, recorded, through Mitsuba's ray queries alone, in turn with renders. What is "
        "not in kernels does not grow with the picture: the larger it is, the nearer the ratio of the "
        "kernels.",
    )
    best, worst = (pick(rows, key=lambda row: row[-2]) for pick in (min, max))
    least, most = (pick(row[-1] for row in rows) for pick in (min, max))
    study.text(
        f"A render takes {best[-2]:.2g} (scene {best[0]}) to {worst[-2]:.2g} (scene {worst[0]}) times as "
        f"long as its rays alone, its kernels {least:.2g} to {most:.2g} times."
    )


def _floor_row(study: Study, number: int, extent: Extent) -> tuple[Any, ...]:
    """What ``FLOOR_COLUMNS`` name; the recorded rays are held to those that the integrator counts."""
    width, height = extent.size
    scene = load(mrt.scene_dict(number, width=width, height=height))
    render = partial(mrt.render, scene, aa=extent.aa, aamode="none")
    repeats = max(3, extent.repeats)
    found = kernels.profile(render, repeats=repeats)
    warm = measure({"": render}, repeats=repeats)[""]
    under = floor(scene, repeats=repeats, aa=extent.aa, aamode="none")
    counted = render(count_rays=True).rays
    off = max(abs(under.rays.get(recorded, 0) - counted[kind]) for kind, recorded in RAYS.items())
    study.at_most(
        f"scene {number}: share of rays recorded or counted, but not both",
        off / sum(counted.values()),
        MOST_OFF,
        "recording takes the loop apart; other code rounds a few rays to the other side of an edge",
    )
    if number in GOAL_SCENES:
        quartiles = f"quartiles {under.time.low:.3g} and {under.time.high:.3g} of {repeats} ratios"
        interval = (under.time.low, under.time.high)
        study.goal(
            f"scene {number}: seconds / floor", under.time.median, FLOOR_GOAL, quartiles, interval=interval
        )
    in_kernels = sum(k.seconds for k in found)
    return (
        number,
        warm.seconds,
        warm.spread,
        in_kernels,
        sum(k.launches for k in found),
        sum(k.compile for k in found),
        *(counted[kind] for kind in RAYS),
        sum(counted.values()) / warm.seconds / 1e6,
        under.time.other_seconds,
        under.time.median,
        in_kernels / under.time.other_seconds,
    )
