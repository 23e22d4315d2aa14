"""Adaptive anti-aliasing against full supersampling, and the Gaussian depth of field against a lens.

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
from collections.abc import Sequence
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.tools.renders import load
from mrt_mitsuba.validation.tools.scenery import AT_CENTRES, sensor
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Filters: adaptive anti-aliasing against full, blur against a lens"

MODES = ("none", "luma", "sobel", "geometry")
BLURS = ("report", "corrected")
# Luma contrast of a 3x3 neighbourhood in the converged picture: below, nothing is worth refining; above, it
# is an edge
FLAT, EDGE = 0.02, 0.2


class Extent(NamedTuple):
    """How much to measure."""

    scenes: Sequence[int]
    amounts: Sequence[int]
    reference_aa: int
    size: tuple[int, int]
    light: tuple[int, int, int]  # width, height and samples, for each of the reference's
    noise_spp: Sequence[int]
    lens: tuple[int, int, int, int]  # width, height, aa and samples


NOISE = (2, 4, 8, 16, 32, 64)
FULL = Extent(range(5), (2, 4, 8), 32, (400, 300), (200, 150, 64), NOISE, (400, 300, 4, 32))
QUICK = Extent((0, 3), (2, 4), 16, (120, 90), (80, 60, 16), (4, 16), (128, 96, 3, 12))


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    for part in study.each("Filters", PARTS):
        part(study, QUICK if quick else FULL)


def rmse(image: np.ndarray, truth: np.ndarray) -> float:
    """Return the root of the mean squared difference."""
    return float(np.sqrt(np.mean(np.square(image - truth, dtype=np.float64))))


# ---------------------------------------------- Anti-aliasing ----------------------------------------------


def modes(study: Study, extent: Extent) -> None:
    """Compare every mode and amount in the report's scenes with full supersampling of the same lattice."""
    (width, height), most = extent.size, max(extent.amounts)
    rows: list[dict[str, Any]] = []
    for number in extent.scenes:
        scene = load(mrt.scene_dict(number, width=width, height=height))
        options: dict[str, Any] = {"lattice": "report"}
        reference = mrt.render(scene, aa=extent.reference_aa, aamode="none", **options).image
        full: dict[int, tuple[float, int]] = {}
        off, ratio = 0, math.nan
        for mode in MODES:
            for aa in extent.amounts:
                result = mrt.render(scene, aa=aa, aamode=mode, **options)
                error, refined, rays = (
                    rmse(result.image, reference),
                    refined_pixels(result),
                    result.rays["primary"],
                )
                if mode == "none":
                    full[aa] = error, rays
                else:
                    off = max(off, abs(rays - refined.size - int(refined.sum()) * (aa**2 - 1)))
                if (mode, aa) == ("sobel", most):
                    ratio = error / full[aa][0]
                figures = {
                    "RMSE": error,
                    "error / full": error / full[aa][0],
                    "rays / full": rays / full[aa][1],
                }
                where = {"scene": number, "mode": mode, "aa": aa}
                rows.append({**where, **figures, "pixels refined": float(refined.mean())})
        title = f"scene {number}: camera rays other than one a pixel and aa² - 1 in refined ones"
        study.at_most(title, off, 0, "a count")
        why = (
            "scene 4 leaves a fifth of its pixels alone and twice the error, scene 2 the outlines of its "
            "dark spheres; a detector that finds nothing has four times the error or more"
        )
        study.at_most(f"scene {number}: error of sobel / full at aa={most}", ratio, 2.2, why)
    study.records("modes", f"Error to aa={extent.reference_aa} of the same lattice, {width}x{height}", rows)


def refined_pixels(result: Any) -> np.ndarray:
    """Return which pixels [H, W] have more than one sample."""
    every = np.full(result.image.shape[:2], np.inf)
    return np.asarray(result.layers.get("samples.Y", every) > 1)


def variance_error(*, spp: int, lattice: str) -> float:
    """Return the share of pixels whose Sobel edges are not those by the unbiased variance of their rays.

    Behind a veil that stops half of the rays: of n zeros and ones with mean m, it is m (1 - m) / (n - 1).
    """
    black = {"type": "diffuse", "reflectance": 0.0}
    scene = {
        "type": "scene",
        "sensor": sensor([0, 0, 0], [0, 0, 1], "box", film={"width": 40, "height": 30}),
        "integrator": {"type": "path", "rr_depth": 100},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        "veil": {"type": "sphere", "radius": 2, "bsdf": {"type": "mask", "opacity": 0.5, "nested": black}},
    }
    options: dict[str, Any] = {"aa": 1, "aamode": "sobel", "layers": ["edges"], "lattice": lattice}
    found = mrt.render(mi.load_dict(scene), spp=spp, **options)
    mean = found.image
    expected = np.asarray(filters.sobel_edges(mean, variance=mean * (1 - mean) / (spp - 1)).value)
    # whole numbers: a value next to none may be none
    return float((np.abs(found.layers["edges.Y"] - expected) > 1).mean()) if expected.any() else 1.0


def noise(study: Study, extent: Extent) -> None:
    """Count refined pixels where the converged picture is flat, and where it has an edge."""
    for lattice in ("report", "film"):
        why = "of 2 rays: a variance by n in place of n - 1 is half as large, and changes nearly all"
        what = f"noise: share of pixels of another variance, lattice={lattice}"
        study.at_most(what, variance_error(spp=2, lattice=lattice), 0.02, why)
    width, height, most = extent.light
    # scene 0 in Mitsuba's own plugins, lit by a small sphere instead of two points
    nodes = mrt.scene_dict(0, width=width, height=height, flavor="stock")
    nodes = {
        name: node for name, node in nodes.items() if not name.startswith(("light", "sky", "integrator"))
    }
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 30.0}}
    nodes["light"] = {"type": "sphere", "center": [1, 2, 0.5], "radius": 0.3, "emitter": lamp}
    nodes["sky"] = {"type": "constant", "radiance": 0.2}
    scene = load(nodes | {"integrator": {"type": "path", "max_depth": 4}})
    # where the detectors look
    truth = mrt.render(scene, **AT_CENTRES, spp=16 * most, seed=78).image
    luma = np.sqrt(truth @ np.array(filters.edges.LUMA_WEIGHTS, np.float32))
    windows = np.lib.stride_tricks.sliding_window_view(luma, (3, 3))
    contrast = windows.max(axis=(2, 3)) - windows.min(axis=(2, 3))
    flat, edge = contrast < FLAT, contrast > EDGE
    rows: list[tuple[Any, ...]] = []
    for detector, find in (("luma", filters.luma_edges), ("sobel", filters.sobel_edges)):
        for spp in extent.noise_spp:
            seen = refined_pixels(mrt.render(scene, aa=2, aamode=detector, lattice="report", spp=spp))[
                1:-1, 1:-1
            ]
            blind = np.asarray(find(mrt.render(scene, **AT_CENTRES, spp=spp).image).mask)[1:-1, 1:-1]
            rows.append((detector, spp, seen[flat].mean(), seen[edge].mean(), blind[flat].mean()))
    columns = ("detector", "rays a pixel", "flat", "edges", "flat, without the variance")
    note = f"Flat: luma contrast below {FLAT} in the converged picture; edges: above {EDGE}."
    study.table("noise", "Does a detector chase noise? Share of pixels refined", columns, rows, note)
    why = "three deviations: 0.3 % for one normal value; estimated from 4 samples, tails are longer"
    what = "noise: share of flat pixels refined, 4 rays a pixel or more"
    study.at_most(what, max(r[2] for r in rows if r[1] >= 4), 0.03, why)
    why = "noise of 0.03, edges from a contrast of 0.2: at three deviations either way, most of them"
    study.at_least(
        "noise: share of edges found with 16 rays", min(r[3] for r in rows if r[1] == 16), 0.55, why
    )
    why = "shows that there is noise to chase"
    study.at_least("noise: the same flat pixels without the variance", min(r[4] for r in rows), 0.3, why)


# ---------------------------------------------- Depth of field ---------------------------------------------


def depth_of_field(study: Study, extent: Extent) -> None:
    """Blur sharp renders with each filter, and hold both to renders through the fitted lens."""
    width, height, aa, spp = extent.lens
    options: dict[str, Any] = {"aa": aa, "aamode": "none", "lattice": "centered", "focaldist": 0}
    rows: list[dict[str, Any]] = []
    for number in (3, 4):
        scene, name = report_scene(number), f"scene {number}"
        sharp = mrt.render(scene, width=width, height=height, layers=["depth"], **options)
        depth = sharp.layers["depth.Z"]
        focus: dict[str, Any] = {"focal_distance": scene.focal_distance, "focal_range": scene.focal_range}
        pictures = {"sharp": sharp.image}
        pictures |= {mode: filters.gaussian_dof(sharp.image, depth, **focus, mode=mode) for mode in BLURS}
        lens = fit_lens(scene, depth)
        nodes = scene.to_dict(width=width, height=height)
        nodes["sensor"] |= lens
        one, other = (mrt.render(nodes, **options, spp=spp, seed=seed).image for seed in (1, 100_001))
        truth = (one + other) / 2
        errors = {mode: rmse(picture, truth) for mode, picture in pictures.items()}
        corrected, why = errors["corrected"], "a correction that is worse is none"
        study.at_most(f"{name}: RMSE of corrected / report", corrected / errors["report"], 1, why)
        study.at_most(f"{name}: RMSE of corrected / no blur at all", corrected / errors["sharp"], 1, why)
        why = "else the comparison would be one of noise"
        study.at_most(
            f"{name}: noise of the lens / RMSE of corrected", rmse(one, other) / 2 / corrected, 0.5, why
        )
        found = {key: value for key, value in lens.items() if key != "type"}
        rows.append({"scene": number, **{f"RMSE, {mode}": error for mode, error in errors.items()}, **found})
        sheet = np.concatenate([*pictures.values(), truth], axis=1)
        caption = f"Left to right: {', '.join(pictures)}, thinlens."
        study.picture(f"pictures-{number}", f"Scene {number}", sheet, caption)
    study.records("blur", "RMSE to a lens, and the lens", rows)


def fit_lens(scene: Scene, depth: np.ndarray) -> dict[str, Any]:
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


PARTS = (modes, noise, depth_of_field)
