"""Do detectors chase noise, and is the Gaussian depth of field like a lens?

The lens is Mitsuba's ``thinlens`` in front of the same ``mrt_whitted``, so that nothing but the lens differs.
Which lens? The report gives an amount of blur for a hit at distance d, which no lens has: it grows with d
without end up to 8. With R the radius of the aperture, f the distance in focus, W the picture's width and φ
its horizontal field of view, a thin lens shows a point at distance d as a disc of the radius

    r(d) = B (1/f − 1/d) pixels,  B = R W / (2 tan(φ/2)),

negative in front of the focus. That is linear in A = B/f and B: the lens nearest to the report's blur is a
least-squares fit of A − B/d to the disc that has the variance of its Pascal line, over the picture's pixels.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.compare import compare
from mrt_mitsuba.validation.renders import load
from mrt_mitsuba.validation.scenery import AT_CENTRES
from mrt_mitsuba.validation.study import Study, Values

TITLE = "Filters: edges against noise, blur against a lens"

BLURS = ("report", "corrected")
# Luma contrast of a 3x3 neighbourhood in the converged picture: below, nothing is worth refining; above, it
# is an edge
FLAT = 0.02
EDGE = 0.2


def run(study: Study, *, quick: bool) -> None:
    """Fill the study. What refining edges gives for its time is in ``error_vs_time``."""
    for part in study.each("Filters", (noise, depth_of_field)):
        part(study, quick=quick)


def noise(study: Study, *, quick: bool) -> None:
    """Count refined pixels where the converged picture is flat, and where it has an edge."""
    width, height, counts = (60, 45, (4, 16)) if quick else (200, 150, (2, 4, 8, 16, 32, 64))
    # scene 0 in Mitsuba's own plugins, lit by a small sphere instead of two points
    stock = mrt.scene_dict(0, width=width, height=height, flavor="stock")
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 30.0}}
    nodes = {name: node for name, node in stock.items() if not name.startswith("light")}
    nodes["light"] = {"type": "sphere", "center": [1, 2, 0.5], "radius": 0.3, "emitter": lamp}
    nodes["sky"] = {"type": "constant", "radiance": 0.2}
    nodes["integrator"] = {"type": "path", "max_depth": 4}
    scene = load(nodes)
    # where the detectors look
    truth = mrt.render(scene, **AT_CENTRES, spp=16 * counts[-1], seed=78).image
    luma = np.sqrt(truth @ np.array(filters.edges.LUMA_WEIGHTS, np.float32))
    contrast = np.ptp(np.lib.stride_tricks.sliding_window_view(luma, (3, 3)), axis=(2, 3))
    flat = contrast < FLAT
    edge = contrast > EDGE
    rows = []
    detectors: dict[Literal["luma", "sobel"], Any] = {
        "luma": filters.luma_edges,
        "sobel": filters.sobel_edges,
    }
    for detector, find in detectors.items():
        for spp in counts:
            refined = mrt.render(scene, aa=2, aamode=detector, lattice="report", spp=spp).layers["samples.Y"]
            seen = refined[1:-1, 1:-1] > 1
            blind = np.asarray(find(mrt.render(scene, **AT_CENTRES, spp=spp).image).mask)[1:-1, 1:-1]
            shares = {"flat": seen[flat].mean(), "edges": seen[edge].mean(), "blind": blind[flat].mean()}
            rows.append({"detector": detector, "rays a pixel": spp, **shares})
    note = f"Flat: luma contrast below {FLAT} in the converged picture; edges: above {EDGE}. Blind: the same "
    note += "flat pixels for a detector that does not know the variance."
    study.records("noise", "Does a detector chase noise? Share of pixels refined", rows, note)
    refined_flat = np.max([row["flat"] for row in rows if row["rays a pixel"] >= 4])
    why = "three deviations: 0.3 % for one normal value; estimated from 4 samples, tails are longer"
    study.at_most("noise: share of flat pixels refined, 4 rays a pixel or more", refined_flat, 0.03, why)
    refined_edges = min(row["edges"] for row in rows if row["rays a pixel"] == 16)
    why = "noise of 0.03, edges from a contrast of 0.2: at three deviations either way, most of them"
    study.at_least("noise: share of edges found with 16 rays", refined_edges, 0.55, why)
    blind_flat = min(row["blind"] for row in rows)
    why = "shows that there is noise to chase"
    study.at_least("noise: the same flat pixels without the variance", blind_flat, 0.3, why)


def depth_of_field(study: Study, *, quick: bool) -> None:
    """Blur sharp renders with each filter, and hold both to renders through the fitted lens."""
    width, height, aa, spp = (96, 72, 2, 12) if quick else (400, 300, 4, 32)
    options: Values = {"aa": aa, "aamode": "none", "lattice": "centered", "focaldist": 0}
    rows: list[Values] = []
    for number in (3, 4):
        scene = report_scene(number)
        sharp = mrt.render(scene, width=width, height=height, layers=["depth"], **options)
        depth = sharp.layers["depth.Z"]
        focus: Values = {"focal_distance": scene.focal_distance, "focal_range": scene.focal_range}
        pictures = {"sharp": sharp.image}
        pictures |= {mode: filters.gaussian_dof(sharp.image, depth, **focus, mode=mode) for mode in BLURS}
        nodes = scene.to_dict(width=width, height=height)
        lens = fit_lens(scene, depth)
        nodes["sensor"] |= {"type": "thinlens", **lens}
        one, other = (mrt.render(nodes, **options, spp=spp, seed=seed).image for seed in (1, 100_001))
        truth = (one + other) / 2
        errors = {f"RMSE, {mode}": compare(picture, truth).rmse for mode, picture in pictures.items()}
        sharp_error, report, corrected = errors.values()
        left = compare(one, other).rmse / 2
        worse = "a correction that is worse is none"
        where = f"scene {number}: "
        study.at_most(f"{where}RMSE of corrected / report", corrected / report, 1, worse)
        study.at_most(f"{where}RMSE of corrected / no blur at all", corrected / sharp_error, 1, worse)
        why = "else noise would be compared"
        study.at_most(f"{where}noise of the lens / RMSE of corrected", left / corrected, 0.5, why)
        rows.append({"scene": number, **errors, **lens})
        sheet = np.concatenate([*pictures.values(), truth], axis=1)
        caption = f"Left to right: {', '.join(pictures)}, thinlens."
        study.picture(f"pictures-{number}", f"Scene {number}", sheet, caption)
    study.records("blur", "RMSE to a lens, and the lens", rows)


def fit_lens(scene: Scene, depth: np.ndarray) -> dict[str, float]:
    """The lens whose discs are nearest to the report's blur of these hit distances [H, W]."""
    amount = filters.blur_amount(depth, focal_distance=scene.focal_distance, focal_range=scene.focal_range)
    radius = disc_radius(np.asarray(amount, np.float64))
    hit = np.isfinite(depth)
    signed = np.where(depth < scene.focal_distance, -radius, radius)[hit]
    (a, b), *_ = np.linalg.lstsq(np.stack([np.ones(hit.sum()), -1 / depth[hit]], axis=1), signed, rcond=None)
    pixels = depth.shape[1] / (2 * math.tan(math.radians(scene.camera.hfov) / 2))
    return {"aperture_radius": float(b / pixels), "focus_distance": float(b / a)}


def disc_radius(amount: np.ndarray) -> np.ndarray:
    """The radius of the disc as wide as the report's blur, pixels.

    The Pascal line of 2k entries has the variance (2k − 1)/4 on each axis, a disc of radius r one of r²/4.
    The whole amount k is continued to all numbers, and by a² below 1, where the report does not blur.
    """
    return np.where(amount < 1, amount, np.sqrt(np.maximum(2 * amount - 1, 0)))
