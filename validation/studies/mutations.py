"""Mistakes made on purpose, and at how many samples which image test finds them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


Change = Callable[[dict[str, Any]], dict[str, Any]]  # of a scene's dict


def _scaled_lights(nodes: dict[str, Any]) -> dict[str, Any]:
    """Return the scene with lights and sky 1.02 times as bright."""
    result = dict(nodes)
    for name, node in nodes.items():
        for key in ("intensity", "radiance"):
            if isinstance(node, dict) and key in node:
                color = node[key]
                result[name] = {**node, key: {**color, "value": [1.02 * c for c in color["value"]]}}
    return result


def _each_material(key: str, change: Callable[[Any], Any]) -> Change:
    def changed(node: Any) -> Any:
        ours = isinstance(node, dict) and node["type"] == "mrt_bsdf"
        return {**node, key: change(node[key])} if ours else node

    return lambda nodes: {name: changed(node) for name, node in nodes.items()}


NONE, CLAMP = "none", "dropped clamp"
MISTAKES: dict[str, Change] = {
    NONE: dict,
    "radiance x 1.02": _scaled_lights,
    "alpha x 1.05": _each_material("alpha", lambda alpha: 1.05 * alpha),
    "flipped normal of one sphere": lambda n: {**n, "sphere_0": {**n["sphere_0"], "flip_normals": True}},
    "dropped light": lambda nodes: {name: node for name, node in nodes.items() if name != "light_1"},
    "schlick for dielectric": _each_material("fresnel", lambda _: "schlick"),
}


def trials(counts: Sequence[int], *, width: int, height: int) -> dict[str, dict[int, Comparison]]:
    """Compare Mitsuba's ``roughplastic`` with ``mrt_bsdf``, right and wrong, by samples of each render.

    Return what the tests say, by mistake and by samples of each pixel in all renders.
    """
    size: dict[str, Any] = {"width": width, "height": height}
    scene: Scene = physical(report_scene(SCENE), diffuse=False)
    stock = mrt.scene_dict(scene, flavor="stock", **size)
    ours = finite(mrt.scene_dict(scene, fresnel="dielectric", **size), stock)
    found: dict[str, dict[int, Comparison]] = {name: {} for name in (*MISTAKES, CLAMP)}
    for spp in counts:
        theirs = path_estimate(stock, spp=spp, seed=1000)
        for name, change in MISTAKES.items():
            wrong = path_estimate(change(ours), spp=spp)
            found[name][RENDERS * spp] = compare(wrong, theirs, level=LEVEL)
        found[CLAMP][RENDERS * spp] = _without_clamp(spp, size)
    return found


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
    for name, series in found.items():
        p = series[max(series)].p
        if name == NONE:
            study.at_least("p of equality without a mistake", p, LEVEL, POWER)
        else:
            study.at_most(f"p of equality with {name}", p, LEVEL, "it must be seen")
    caption = (
        "Probability of such a difference between equal pictures; below the dashed line they are rejected."
    )
    # a smaller p is as certain
    lines = {name: (list(s), [max(c.p, 1e-40) for c in s.values()]) for name, s in found.items()}
    figure = curves(lines, "samples a pixel", "p of equality", level=LEVEL, ticks=list(found[NONE]))
    study.plot("mutations", "How soon a mistake is found", figure, caption)
    rows = [_row(name, samples, c) for name, series in found.items() for samples, c in series.items()]
    note = (
        f"mrt_bsdf with the mistake against roughplastic, under path, {RENDERS} renders each; the clamp: "
        f"mrt_whitted against itself. Equal pictures are rejected once in {1 / LEVEL:g} times."
    )
    study.records("mutations", "Which test finds which mistake, at how many samples", rows, note)


def _row(mistake: str, samples: int, found: Comparison) -> dict[str, Any]:
    questions = ", ".join(found.detected_by) or "-"
    each = {f"p {v.name}": v.p for v in (found.pixel, found.tile, found.image)}
    named = {"mistake": mistake, "samples a pixel": samples, "found by": questions}
    return {**named, **each, "relRMSE": found.rel_rmse}
