"""Mitsuba against ours: direct light, gloss and mirrors, whole scenes; and mistakes on purpose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import mul
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Material
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.compare import p_values
from mrt_mitsuba.validation.scenery import AT_CENTRES, with_materials
from mrt_mitsuba.validation.study import Study, Values

TITLE = "Against Mitsuba's own integrators, lights and materials"

# direct light alone, as Mitsuba's ``direct`` has it
DIRECT: Values = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
NEAR = 40.0  # the mesh that stands in for a plane ends at 50
RENDERS = 8  # enough for a mean and its variance
# Probability that a comparison calls equal pictures different; seeds are fixed, so it stays passed
LEVEL = 1e-3


def run(study: Study, *, quick: bool) -> None:
    """Compare with Mitsuba's integrators, lights and materials."""
    for part in (direct, gloss, whole_scenes):
        part(study, quick=quick)


def direct(study: Study, *, quick: bool) -> None:
    """Compare direct light in the report's scenes, one light at a time, since ``direct`` picks one at random.

    The light is a stock point light with falloff. Mitsuba's shadow rays start 9e-5 (1 + |p|) off their
    surface, ours a few roundings: single pixels differ at the edges of shadows, as they do at outlines.
    """
    size: Values = {"width": 120, "height": 90} if quick else {"width": 320, "height": 240}
    rows: list[Values] = []
    for number in study.each("Direct light", range(4 if quick else 5)):
        whole = report_scene(number)
        for light, lamp in enumerate(whole.lights):
            scene = replace(whole, lights=(lamp,))
            nodes = mrt.scene_dict(scene, fresnel="dielectric", **size)
            del nodes["sky"]  # direct would light the scene with it
            nodes["light_0"] = mrt.scene_dict(scene, flavor="stock", **size)["light_0"]
            loaded = mi.load_dict(nodes)
            ours = mrt.render(loaded, integrator=DIRECT, **AT_CENTRES, layers=["depth"])
            theirs = mrt.render(loaded, integrator="direct", **AT_CENTRES).image
            depth = ours.layers["depth.Z"]
            near = (depth < NEAR) | np.isinf(depth)
            error = (abs(ours.image - theirs) / (1 + theirs)).max(axis=-1)[near]
            row = {"scene": number, "light": light, "median": np.median(error), "off": np.mean(error > 1e-5)}
            rows.append(row | {"lit": (theirs.max(axis=-1) > 0.05)[near].mean()})
    note = f"Stock point light, no sky. Differences relative to 1 + value, up to {NEAR:g} from the camera."
    study.records("direct", "mrt_whitted without bounces and clamp against direct", rows, note)
    edges = "edges and what hides lights; measured 7 in 76,800, and 36 among the 600 spheres of scene 4"
    median, off, lit = ([row[name] for row in rows] for name in ("median", "off", "lit"))
    study.at_most("direct light: median difference", max(median), 3e-7, "least fault: 1 in a million")
    study.at_most("direct light: share of pixels off by > 1e-5", max(off), 1e-3, edges)
    study.at_least("direct light: share of pixels lit", np.mean(lit), 0.05, "else nothing is compared")


def gloss(study: Study, *, quick: bool) -> None:
    """Hold ``path`` to the mirrors of ``mrt_whitted``: four black, shiny spheres under a sky."""
    size: Values = {"width": 64, "height": 48} if quick else {"width": 160, "height": 120}
    alpha = 0.003 if quick else 0.001
    black: Values = {"alpha": alpha, "ior": 3.0, "diffuse": (0, 0, 0), "specular": (1, 1, 1)}
    scene = with_materials(report_scene(0), partial(replace, **black))
    scene = mi.load_dict(replace(scene, planes=(), lights=()).to_dict(**size, fresnel="dielectric"))
    whitted = {"type": "mrt_whitted", "min_contribution": 0.0}
    mirror = mrt.render(scene, **AT_CENTRES, layers=["depth"], integrator=whitted)
    path = {"type": "path", "max_depth": 8, "rr_depth": 100}
    image = mrt.render(scene, **AT_CENTRES, spp=64 if quick else 512, integrator=path).image
    sphere = np.isfinite(mirror.layers["depth.Z"])
    error = abs(image - mirror.image)[sphere].mean() / mirror.image[sphere].mean()
    why = "what is left is noise, as wide as the lobe; at alpha 0.3 it is above 0.1"
    study.at_most(f"gloss of alpha {alpha:g} against the mirror term", error, 2e-3, why)


def physical(m: Material) -> Material:
    """Return a material that Mitsuba's plugins take: colours up to 1, positive roughness, no diffuse part.

    Then ``mrt_bsdf`` and ``roughplastic``, which refracts diffuse light, are the same. Lobes narrower than
    0.1 make fireflies: no mean of some hundred samples of them is normal, as the tests need it.
    """
    r, g, b = (min(c, 1.0) for c in m.specular)
    return replace(m, alpha=max(abs(m.alpha), 0.1), specular=(r, g, b), diffuse=(0.0, 0.0, 0.0))


def changed(nodes: Values, key: str, change: Callable[[Any], Any]) -> Values:
    """Return the nodes with a parameter changed wherever one has it."""
    return {n: node | {key: change(node[key])} if key in node else node for n, node in nodes.items()}


def mistakes(nodes: Values) -> dict[str, Values]:
    """Return the nodes with a mistake, by its name."""

    def brighter(color: Values) -> Values:
        return color | {"value": [1.02 * x for x in color["value"]]}

    sphere = nodes["sphere_0"] | {"flip_normals": True}
    return {
        "radiance x 1.02": changed(nodes, "specular_reflectance", brighter),
        "alpha x 1.05": changed(nodes, "alpha", partial(mul, 1.05)),
        "flipped normal of one sphere": nodes | {"sphere_0": sphere},
        "dropped light": {name: node for name, node in nodes.items() if name != "light_1"},
    }


def whole_scenes(study: Study, *, quick: bool) -> None:
    """Compare the report's scenes under path, with their gloss alone; with mistakes they must differ."""
    size: Values = {"width": 64, "height": 48} if quick else {"width": 120, "height": 90}
    options: Values = {"integrator": {"type": "path", "max_depth": 4}, "spp": 16 if quick else 64}
    rows: list[Values] = []

    def renders(nodes: Values, seed: int) -> np.ndarray:
        """Independent renders through the pixels' centres, ``RENDERS`` of them."""
        scene = mi.load_dict(nodes)
        seeds = range(seed, seed + RENDERS)
        return np.array([mrt.render(scene, **options, **AT_CENTRES, seed=s).image for s in seeds])

    for number in study.each("Whole scenes", (0, 1, 3) if quick else (0, 1, 2, 3, 4)):
        scene = with_materials(report_scene(number), physical)
        stock = mrt.scene_dict(scene, flavor="stock", **size)
        # Ours, with the lights and finite planes of the other
        kept = {name: node for name, node in stock.items() if name.startswith(("light_", "plane_"))}
        ours = mrt.scene_dict(scene, fresnel="dielectric", **size) | kept
        theirs = renders(stock, 1000)
        pictures = {f"scene {number}": ours}
        if number == 0:
            pictures |= {f"scene 0, {mistake}": wrong for mistake, wrong in mistakes(ours).items()}
        why = "least fault: 2 % of the light and 5 % of alpha, as the mistakes show: they must be seen"
        for what, nodes in pictures.items():
            p = p_values(renders(nodes, 0), theirs)
            hold = study.at_least if nodes is ours else study.at_most
            hold(f"p of equality, {what}", min(p.values()), LEVEL, why)
            rows.append({"what": what, **p})
    title = "mrt_bsdf against roughplastic in whole scenes, right and with mistakes: p values of equality"
    shared = f"{RENDERS} renders, {options['spp']} samples a pixel"
    study.records("whole-scenes", title, rows, f"{shared}; equal ones are rejected once in {1 / LEVEL:g}.")
