"""The Gaussian depth of field, as in the report and corrected, against a lens.

The lens is Mitsuba's ``thinlens`` in front of the same ``mrt_whitted``, so that nothing but the lens differs.

Which lens? The report gives an amount of blur a(d) for a hit at distance d, which no lens has: it knows no
aperture, and grows with d without end up to 8. With R the radius of the aperture, f the distance in focus,
W the picture's width and φ its horizontal field of view, a thin lens shows a point at distance d as a disc
of the radius

    r(d) = B (1/f − 1/d) pixels,  B = R W / (2 tan(φ/2)),

negative in front of the focus. (The aperture seen through the point is R |d − f| / f wide at distance d, and
a pixel there 2 d tan(φ/2) / W.) That is linear in A = B/f and B, so the lens nearest to the report's blur is
a least-squares fit of A − B/d to the disc that has the variance of the report's Pascal line, over the
picture's pixels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Depth of field: the filters against a lens"

MODES = ("report", "corrected")
REACH = filters.dof.MAX_AMOUNT  # pixels that a blurred one takes from in the report
Lens = dict[str, Any]  # of a camera: a thin lens, by the radius of its aperture and its distance in focus


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    size, aa, spp = ((128, 96), 3, 12) if quick else ((400, 300), 4, 32)
    rows: list[dict[str, Any]] = []
    for number in study.each("Depth of field", (3, 4)):
        rows += compare(study, number, size=size, aa=aa, spp=spp)
    note = "Near depth steps: within 8 pixels of an outline. At the border: within 8 pixels of it."
    study.records("errors", "RMSE to a lens", rows, note)


def compare(study: Study, number: int, *, size: tuple[int, int], aa: int, spp: int) -> list[dict[str, Any]]:
    """Blur a sharp render with each filter, and hold both to renders through the fitted lens."""
    scene, name = report_scene(number), f"scene {number}"
    width, height = size
    options: dict[str, Any] = {"aa": aa, "aamode": "none", "lattice": "centered", "focaldist": 0}
    sharp = mrt.render(scene, width=width, height=height, layers=["depth", "normal"], **options)
    depth = sharp.layers["depth.Z"]
    focus: dict[str, Any] = {"focal_distance": scene.focal_distance, "focal_range": scene.focal_range}
    pictures: dict[str, np.ndarray] = {"sharp": sharp.image}
    pictures |= {mode: filters.gaussian_dof(sharp.image, depth, **focus, mode=mode) for mode in MODES}
    lens = fit_lens(scene, depth)
    nodes = scene.to_dict(width=width, height=height)
    nodes["sensor"] |= lens
    one, other = (mrt.render(nodes, **options, spp=spp, seed=seed).image for seed in (1, 100_001))
    truth = pictures["thinlens"] = (one + other) / 2
    normal = np.stack([sharp.layers[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
    border = np.ones(depth.shape, bool)
    border[REACH:-REACH, REACH:-REACH] = False
    outlines = np.asarray(filters.geometry_edges(normal, depth, crease_angle=180).mask)
    steps = binary_dilation(outlines, iterations=REACH) & ~border
    regions = {"all": np.ones(depth.shape, bool), "near depth steps": steps}
    regions |= {"at the border": border, "elsewhere": ~(steps | border)}
    squares = {mode: np.square(pictures[mode] - truth) for mode in ("sharp", *MODES)}
    errors = {
        (mode, region): float(np.sqrt(square[mask].mean()))
        for mode, square in squares.items()
        for region, mask in regions.items()
        if mask.any()
    }
    corrected, why = errors["corrected", "all"], "a correction that is worse is none"
    study.at_most(f"{name}: RMSE of corrected / report", corrected / errors["report", "all"], 1, why)
    study.at_most(f"{name}: RMSE of corrected / no blur at all", corrected / errors["sharp", "all"], 1, why)
    noise = float(np.sqrt(np.mean(np.square(one - other)))) / 2
    why = "else the comparison would be one of noise"
    study.at_most(f"{name}: noise of the lens / RMSE of corrected", noise / corrected, 0.5, why)
    study.record(f"{name}: aperture radius", lens["aperture_radius"])
    study.record(f"{name}: focus distance", lens["focus_distance"])
    sheet = np.concatenate(list(pictures.values()), axis=1)
    caption = f"Left to right: {', '.join(pictures)}."
    study.picture(f"pictures-{number}", f"Scene {number}", sheet, caption)
    return [
        {
            "scene": number,
            "filter": mode,
            "region": region,
            "pixels": int(regions[region].sum()),
            "RMSE": error,
            "RMSE / without": error / errors["sharp", region],
        }
        for (mode, region), error in errors.items()
    ]


def fit_lens(scene: Scene, depth: np.ndarray) -> Lens:
    """Return the lens whose discs are nearest to the report's blur of these hit distances [H, W]."""
    amount = filters.blur_amount(depth, focal_distance=scene.focal_distance, focal_range=scene.focal_range)
    radius = disc_radius(np.asarray(amount, np.float64))
    hit = np.isfinite(depth)
    signed = np.where(depth < scene.focal_distance, -radius, radius)[hit]
    (a, b), *_ = np.linalg.lstsq(np.stack([np.ones(hit.sum()), -1 / depth[hit]], axis=1), signed, rcond=None)
    pixels = depth.shape[1] / (2 * math.tan(math.radians(scene.camera.hfov) / 2))
    return {"type": "thinlens", "aperture_radius": float(b / pixels), "focus_distance": float(b / a)}


def disc_radius(amount: np.ndarray) -> np.ndarray:
    """Return the radius of the disc as wide as the report's blur, pixels.

    The Pascal line of 2k entries has the variance (2k − 1)/4 on each axis, a disc of radius r one of r²/4.
    The whole amount k is continued to all numbers, and by a² below 1, where the report does not blur.
    """
    return np.where(amount < 1, amount, np.sqrt(np.maximum(2 * amount - 1, 0)))
