"""Mistakes made on purpose, and at how many samples which image test finds them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies.approximations import (
    LEVEL,
    POWER,
    RENDERS,
    finite,
    path_estimate,
    physical,
)
from mrt_mitsuba.validation.tools.gallery import curves
from mrt_mitsuba.validation.tools.image_tests import Comparison, Estimate, compare, estimate
from mrt_mitsuba.validation.tools.study import Study

# Scene 0, black but for its gloss, which mrt_bsdf and roughplastic must show alike; alpha of its materials is
# 0.1
SCENE = 0
# The clamp has no counterpart among Mitsuba's plugins: what it is dropped from, and compared with, are our
# own renders
CLAMPED_SCENE = 1


@dataclass(frozen=True)
class Mistake:
    """A change of a scene's dict that a comparison must notice."""

    name: str
    change: Callable[[dict[str, Any]], dict[str, Any]]


def _scaled_lights(nodes: dict[str, Any]) -> dict[str, Any]:
    """Return the scene with lights and sky 1.02 times as bright."""
    result = dict(nodes)
    for name, node in nodes.items():
        for key in ("intensity", "radiance"):
            if isinstance(node, dict) and key in node:
                color = node[key]
                result[name] = {**node, key: {**color, "value": [1.02 * c for c in color["value"]]}}
    return result


def _each_material(**changes: Callable[[Any], Any]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    def change(nodes: dict[str, Any]) -> dict[str, Any]:
        return {
            name: {**node, **{key: f(node[key]) for key, f in changes.items()}}
            if isinstance(node, dict) and node["type"] == "mrt_bsdf"
            else node
            for name, node in nodes.items()
        }

    return change


MISTAKES = (
    Mistake("radiance x 1.02", _scaled_lights),
    Mistake("alpha x 1.05", _each_material(alpha=lambda alpha: 1.05 * alpha)),
    Mistake(
        "flipped normal of one sphere",
        lambda nodes: {**nodes, "sphere_0": {**nodes["sphere_0"], "flip_normals": True}},
    ),
    Mistake("dropped light", lambda nodes: {name: node for name, node in nodes.items() if name != "light_1"}),
    Mistake("schlick for dielectric", _each_material(fresnel=lambda _: "schlick")),
)
CLAMP = "dropped clamp"
NONE = "none"


@dataclass(frozen=True)
class Trial:
    """One mistake at one sample count: what the tests said."""

    mistake: str
    samples: int  # of each pixel, in all renders
    found: Comparison


def trials(counts: Sequence[int], *, width: int, height: int) -> list[Trial]:
    """Compare Mitsuba's ``roughplastic`` with ``mrt_bsdf``, right and wrong; ``counts``: samples of each
    render."""
    size: dict[str, Any] = {"width": width, "height": height}
    scene: Scene = physical(report_scene(SCENE), diffuse=False)
    stock = mrt.scene_dict(scene, flavor="stock", **size)
    ours = finite(mrt.scene_dict(scene, fresnel="dielectric", **size), stock)
    result = []
    for spp in counts:
        theirs = path_estimate(stock, spp=spp, seed=1000)
        for mistake in (Mistake(NONE, dict), *MISTAKES):
            found = compare(path_estimate(mistake.change(ours), spp=spp), theirs, level=LEVEL)
            result.append(Trial(mistake.name, RENDERS * spp, found))
        result.append(Trial(CLAMP, RENDERS * spp, _without_clamp(spp, size)))
    return result


def _without_clamp(spp: int, size: dict[str, Any]) -> Comparison:
    """Return ``mrt_whitted`` with and without clamp, in Mitsuba's own render loop: at random places in the
    pixels."""
    scene = mi.load_dict(mrt.scene_dict(CLAMPED_SCENE, fresnel="dielectric", **size))

    def drawn(clamp: bool, seed: int) -> Estimate:
        whitted = mi.load_dict({"type": "mrt_whitted", "clamp": clamp})
        return estimate(
            [np.array(mi.render(scene, integrator=whitted, spp=spp, seed=seed + i)) for i in range(RENDERS)]
        )

    return compare(drawn(False, 0), drawn(True, 1000), level=LEVEL)


def run(study: Study, *, quick: bool) -> None:
    """Check that every mistake is found at the largest count, and none where there is none."""
    counts = (4, 16) if quick else (4, 16, 64, 256)
    size: dict[str, Any] = {"width": 64, "height": 48} if quick else {"width": 120, "height": 90}
    found = trials(counts, **size)
    by_mistake = {trial.mistake: [t for t in found if t.mistake == trial.mistake] for trial in found}
    for name, series in by_mistake.items():
        if name == NONE:
            study.at_least("p of equality without a mistake", series[-1].found.p, LEVEL, POWER)
        else:
            study.at_most(f"p of equality with {name}", series[-1].found.p, LEVEL, "it must be seen")
    caption = (
        "Probability of such a difference between equal pictures; below the dashed line they are rejected."
    )
    lines = {  # a smaller p is as certain
        name: ([t.samples for t in series], [max(t.found.p, 1e-40) for t in series])
        for name, series in by_mistake.items()
    }
    samples = [trial.samples for trial in by_mistake[NONE]]
    figure = curves(lines, "samples a pixel", "p of equality", level=LEVEL, ticks=samples)
    study.plot("mutations", "How soon a mistake is found", figure, caption)
    study.table(
        "mutations",
        "Which test finds which mistake, at how many samples",
        ["mistake", "samples a pixel", "found by", "p pixel", "p tile", "p image", "relRMSE"],
        [_row(trial) for series in by_mistake.values() for trial in series],
        f"mrt_bsdf with the mistake against roughplastic, under path, {RENDERS} renders each; the clamp: "
        f"mrt_whitted against itself. Equal pictures are rejected once in {1 / LEVEL:g} times.",
    )


def _row(trial: Trial) -> list[Any]:
    found = trial.found
    questions = ", ".join(found.detected_by) or "-"
    values = (found.pixel.p, found.tile.p, found.image.p, found.rel_rmse)
    return [trial.mistake, trial.samples, questions, *values]
