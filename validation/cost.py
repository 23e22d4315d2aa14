"""Where the time of a render goes: kernels, the floor of its rays, what the plan saves, how it grows."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene import Cone, Light, Plane, Scene
from mrt_mitsuba.scenes import _scene_4, report_scene

from .floor import floor
from .knobs import load
from .study import Study
from .warm import measure


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    size: tuple[int, int]
    aa: int
    scenes: Sequence[int]  # with shapes in Mitsuba's tree: a floor is made of queries to it
    repeats: int
    widths: Sequence[int]
    amounts: Sequence[int]
    spheres: Sequence[int]
    lights: Sequence[int]
    depths: Sequence[int]


FULL = Extent(
    (400, 300),
    4,
    (0, 1, 2, 3, 4),
    5,
    (200, 400, 800, 1600, 3200),
    (1, 2, 4, 8, 16),
    (10, 100, 1000, 10_000, 100_000),
    (1, 3, 10, 30, 100, 300, 1000),
    (1, 2, 3, 5, 10),
)
QUICK = Extent((96, 72), 2, (0, 3), 1, (64, 256), (), (), (1, 4), ())


def run(study: Study, extent: Extent) -> None:
    """Add the tables to a study."""
    _where_it_goes(study, extent)
    _what_the_plan_saves(study, extent)
    _growth(study, extent)


# ------------------------------------------- Passes and floor -------------------------------------------


FLOOR_COLUMNS = (
    "scene",
    "seconds",
    "in kernels",
    "launches",
    "compile, first run",
    "camera rays",
    "mirror rays",
    "shadow rays",
    "rays / s",
    "floor",
    "seconds / floor",
    "kernels / floor",
)
RAYS = {"primary": "camera", "mirror": "mirror", "shadow": "shadow"}  # as counted: as recorded


def _where_it_goes(study: Study, extent: Extent) -> None:
    width, height = extent.size
    rows, passes = [], []
    with study.stage("Where the time goes", len(extent.scenes)) as advance:
        for number in extent.scenes:
            rows.append(_floor_row(study, number, extent))
            passes += _pass_rows(number, extent)
            gc.collect()
            advance(1)
    study.table(
        "passes",
        f"Passes of the default render, {width}x{height}, aa={extent.aa}",
        ("scene", "pass", "seconds", "share"),
        passes,
    )
    study.table(
        "floor",
        f"Every pixel supersampled, {width}x{height}, aa={extent.aa}",
        FLOOR_COLUMNS,
        rows,
        "Floor: the same rays, recorded, through Mitsuba's ray queries alone. What is not in kernels is "
        "Python "
        "and Dr.Jit tracing the code, which does not grow with the picture: the larger the picture, the "
        "nearer "
        "the ratio of the kernels.",
    )
    best, worst = (pick(rows, key=lambda row: row[-2]) for pick in (min, max))
    least, most = (pick(row[-1] for row in rows) for pick in (min, max))
    study.text(
        f"A render takes {best[-2]:.2g} (scene {best[0]}) to {worst[-2]:.2g} (scene {worst[0]}) times as "
        f"long "
        f"as its rays alone, its kernels {least:.2g} to {most:.2g} times."
    )


def _floor_row(study: Study, number: int, extent: Extent) -> tuple[Any, ...]:
    """What ``FLOOR_COLUMNS`` name; the recorded rays are held to those that the integrator counts."""
    width, height = extent.size
    options = {"aa": extent.aa, "aamode": "none"}
    scene = load(mrt.scene_dict(number, width=width, height=height))
    repeats = max(3, extent.repeats)
    under = floor(scene, repeats=repeats, **options)
    warm = measure({"": partial(mrt.render, scene, **options)}, repeats=repeats)[""]
    again = mrt.render(scene, **options)
    counted = mrt.render(scene, **options, count_rays=True).rays
    off = max(abs(under.rays.get(recorded, 0) - counted[kind]) for kind, recorded in RAYS.items())
    study.at_most(f"scene {number}: recorded rays of a kind other than those counted", off, 0)
    study.record(f"scene {number}: seconds / floor", warm.seconds / under.seconds)
    kernels = again.timings.kernels
    return (
        number,
        warm.seconds,
        kernels,
        again.kernel_launches,
        warm.result.timings.compile,
        *(counted[kind] for kind in RAYS),
        sum(counted.values()) / warm.seconds,
        under.seconds,
        warm.seconds / under.seconds,
        kernels / under.seconds,
    )


def _pass_rows(number: int, extent: Extent) -> list[tuple[Any, ...]]:
    """Every pass of a warm render with the default options."""
    width, height = extent.size
    for _ in range(2):
        timings = mrt.render(number, width=width, height=height, aa=extent.aa).timings
    parts = {"scene and plan": timings.load, **timings.passes}
    return [(number, name, seconds, seconds / timings.total) for name, seconds in parts.items()]


# ----------------------------------------- What the plan saves ------------------------------------------


def _what_the_plan_saves(study: Study, extent: Extent) -> None:
    """Force into scene 0, which needs none of it, what the plan would leave out."""
    width, height = extent.size
    shared = {"aa": extent.aa, "aamode": "none"}

    def ready(description: dict[str, Any], **more: Any) -> Callable[[], Any]:
        return partial(mrt.render, load(description), **shared, **more)

    def plainly(scene: Scene) -> dict[str, Any]:
        return scene.to_dict(width=width, height=height)

    rows = []
    cases = _forced_in(report_scene(0))
    with study.stage("What the plan saves", len(cases)) as advance:
        for what, (scene, other, change, more) in cases.items():
            without, forced = ready(plainly(scene)), ready(change(plainly(other)), **more)
            if what == "bounce loop":
                forced.args[0].integrator().bounces = lambda prepared: True
            a, b = measure({"without": without, "with": forced}, repeats=extent.repeats).values()
            difference = float(np.abs(a.result.image - b.result.image).max())
            rows.append((what, a.seconds, b.seconds, b.seconds / a.seconds, difference))
            del without, forced
            gc.collect()  # scenes that stay alive slow down the kernels of later ones
            advance(1)
    study.table(
        "plan",
        "What the plan saves on scene 0, which needs none of it",
        ("left out", "seconds without", "seconds with", "with / without", "largest change of the picture"),
        rows,
    )
    most = max(rows, key=lambda row: row[3])
    study.text(
        f"Forcing in what the plan leaves out costs up to {most[3]:.2g} times the whole render ({most[0]})."
    )
    study.at_most(
        "plan: largest change of the picture by what is left out",
        max(row[-1] for row in rows),
        0.5 / 255,
        "half a step of an 8-bit picture",
    )


_Change = Callable[[dict[str, Any]], dict[str, Any]]


def _forced_in(plain: Scene) -> dict[str, tuple[Scene, Scene, _Change, dict[str, Any]]]:
    """By what is left out: a scene without, one that holds it, a change of its dict, and options."""
    dull, stuff = _without_reflection(plain), plain.spheres[0].material
    far_cone = dataclasses.replace(plain, cones=(Cone((1e3, 1, 0), (1e3, 0, 0), 0.1, stuff),))
    far_plane = dataclasses.replace(plain, planes=(*plain.planes, Plane((0, 1, 0), 1e4, stuff)))
    layers = {"layers": ["depth", "normal", "albedo", "direct", "reflection", "bounces"]}
    # without a sky in sight, nothing is out of focus
    inside = dataclasses.replace(plain, planes=(*plain.planes, Plane((1, 0, 0), 20, stuff)))
    return {
        "bounce loop": (dull, dull, dict, {}),
        "shadow rays and paths that cannot matter": (
            plain,
            plain,
            dict,
            {"integrator": {"type": "mrt_whitted", "min_contribution": 0.0}},
        ),
        "cones and cylinders": (plain, far_cone, dict, {}),
        "a plane": (plain, far_plane, dict, {}),
        "textures": (plain, plain, _textured, {}),
        "depth of field": (inside, inside, dict, {"focaldist": 1.0, "focalrange": 1e6}),
        "layers": (plain, plain, dict, layers),
    }


def _without_reflection(scene: Scene) -> Scene:
    """Nothing reflects: a black mirror colour."""

    def dull(thing: Any) -> Any:
        return dataclasses.replace(thing, material=dataclasses.replace(thing.material, specular=(0, 0, 0)))

    return dataclasses.replace(
        scene, spheres=tuple(map(dull, scene.spheres)), planes=tuple(map(dull, scene.planes))
    )


def _textured(description: dict[str, Any]) -> dict[str, Any]:
    """The same colours, each as a picture of one colour."""
    import mitsuba as mi

    for node in description.values():
        if isinstance(node, dict) and node.get("type") == "mrt_bsdf":
            colour = np.full((2, 2, 3), node["diffuse_reflectance"]["value"], np.float32)
            node["diffuse_reflectance"] = {"type": "bitmap", "bitmap": mi.Bitmap(colour), "raw": True}
    return description


# ------------------------------------------------ Growth ------------------------------------------------


def _growth(study: Study, extent: Extent) -> None:
    """Time against the size of the task, and the exponent of the upper half, where fixed costs are least."""
    three = report_scene(3)
    series: dict[str, dict[int, Callable[[], Any]]] = {
        "pixels": {w * (w * 3 // 4): partial(_ready, three, aa=1, width=w) for w in extent.widths},
        "samples a pixel": {aa * aa: partial(_ready, three, aa=aa) for aa in extent.amounts},
        "spheres": {n: partial(_ready, _scene_4(n), aa=2) for n in extent.spheres},
        "lights": {n: partial(_ready, _lit(n), aa=1) for n in extent.lights},
        "bounce limit": {
            d: partial(_ready, three, aa=2, integrator={"type": "mrt_whitted", "max_depth": d})
            for d in extent.depths
        },
    }
    rows, exponents = [], []
    with study.stage("Growth", sum(map(len, series.values()))) as advance:
        for what, runs in series.items():
            if len(runs) < 2:
                continue
            # one scene at a time: those that stay alive slow down the kernels of others
            found = {
                size: measure({"": make()}, repeats=max(3, extent.repeats))[""] for size, make in runs.items()
            }
            rows += [(what, size, w.seconds, w.spread, w.result.timings.compile) for size, w in found.items()]
            upper = list(found.items())[-max(2, (len(found) + 1) // 2) :]
            slope = np.polyfit(np.log([s for s, _ in upper]), np.log([w.seconds for _, w in upper]), 1)[0]
            exponents.append((what, float(slope)))
            gc.collect()
            advance(len(runs))
    study.table(
        "growth",
        "Time against the size of the task",
        ("what grows", "size", "seconds", "spread", "compile, first run"),
        rows,
    )
    study.table(
        "exponents",
        "Exponents of growth, over the larger half of the sizes",
        ("what grows", "exponent"),
        exponents,
        "1: in proportion. Below, fixed costs still show, or a tree saves work.",
    )


def _ready(scene: Scene, *, width: int = 160, **options: Any) -> Callable[[], Any]:
    """A render of a scene that is loaded."""
    loaded = load(scene.to_dict(width=width, height=width * 3 // 4))
    return partial(mrt.render, loaded, aamode="none", **options)


def _lit(count: int) -> Scene:
    """Scene 0 under lights on a circle, together as bright as one."""
    lights = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        lights.append(Light((10 * np.cos(angle), 10.0, 10 * np.sin(angle)), (1 / count,) * 3))
    return dataclasses.replace(report_scene(0), lights=tuple(lights))
