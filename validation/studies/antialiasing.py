"""Adaptive anti-aliasing against full supersampling: error and rays; and whether it chases noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.validation.tools.renders import load
from mrt_mitsuba.validation.tools.scenery import AT_CENTRES, camera
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Anti-aliasing: adaptive against full"

MODES = ("none", "luma", "sobel", "geometry")
# Luma contrast of a 3x3 neighbourhood in the converged picture: below, nothing is worth refining; above, it
# is an edge
FLAT, EDGE = 0.02, 0.2


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    scenes: Sequence[int]
    amounts: Sequence[int]
    reference_aa: int
    size: tuple[int, int]
    box: tuple[int, int, int]  # width, height and samples to compare Mitsuba's box filter by
    light_size: tuple[int, int]
    light_spp: int  # of the reference, for each of its samples
    noise_spp: Sequence[int]


FULL = Extent(range(5), (2, 4, 8), 32, (400, 300), (200, 150, 8192), (200, 150), 64, (2, 4, 8, 16, 32, 64))
QUICK = Extent((0, 3), (2, 4), 16, (120, 90), (96, 72, 1024), (80, 60), 16, (4, 16))


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    for part in (modes, box_filter, noise):
        part(study, quick=quick)


def modes(study: Study, *, quick: bool) -> None:
    """Compare every mode and amount in the report's scenes with full supersampling of the same lattice."""
    extent = QUICK if quick else FULL
    width, height = extent.size
    rows = []
    for number in study.each("Anti-aliasing", extent.scenes):
        scene = load(mrt.scene_dict(number, width=width, height=height))
        options: dict[str, Any] = {"lattice": "report"}
        reference = mrt.render(scene, aa=extent.reference_aa, aamode="none", **options).image
        found: dict[tuple[str, int], tuple[float, int, float]] = {}
        off = []
        for mode in MODES:
            for aa in extent.amounts:
                result = mrt.render(scene, aa=aa, aamode=mode, **options)
                rmse = float(np.sqrt(np.mean(np.square(result.image - reference, dtype=np.float64))))
                refined, rays = refined_pixels(result), result.rays["primary"]
                if mode != "none":
                    off.append(rays - refined.size - int(refined.sum()) * (aa**2 - 1))
                found[mode, aa] = rmse, rays, float(refined.mean())
        for (mode, aa), (rmse, rays, share) in found.items():
            full = found["none", aa]
            rows.append([number, mode, aa, rmse, rmse / full[0], rays, rays / full[1], share])
        title = f"scene {number}: camera rays other than one a pixel and aa² - 1 in refined ones"
        study.at_most(title, max(map(abs, off)), 0, "a count")
        most = max(extent.amounts)
        why = (
            "scene 4 leaves a fifth of its pixels alone and twice the error, scene 2 the outlines of its "
            "dark spheres; a detector that finds nothing has four times the error or more"
        )
        ratio = found["sobel", most][0] / found["none", most][0]
        study.at_most(f"scene {number}: error of sobel / full at aa={most}", ratio, 2.2, why)
    columns = ["scene", "mode", "aa", "RMSE", "error / full", "rays", "rays / full", "pixels refined"]
    title = f"Error to aa={extent.reference_aa} of the same lattice, {width}x{height}"
    study.table("modes", title, columns, rows)


def refined_pixels(result: Any) -> np.ndarray:
    """Return which pixels [H, W] have more than one sample."""
    every = np.full(result.image.shape[:2], np.inf)
    return np.asarray(result.layers.get("samples.Y", every) > 1)


def box_filter(study: Study, *, quick: bool) -> None:
    """Compare lattices with random samples that Mitsuba places and filters itself, on scene 3."""
    width, height, spp = (QUICK if quick else FULL).box
    scene = load(mrt.scene_dict(3, width=width, height=height, fresnel="dielectric"))
    whitted = {"type": "mrt_whitted", "min_contribution": 0.0}
    runs = [mi.render(scene, integrator=mi.load_dict(whitted), spp=spp // 4, seed=k) for k in range(4)]
    truth = np.mean(runs, axis=0)
    amounts, rows = (1, 2, 4, 8), []
    for lattice in ("centered", "report"):
        options: dict[str, Any] = {"integrator": whitted, "aamode": "none", "lattice": lattice}
        images = [mrt.render(scene, aa=aa, **options).image for aa in amounts]
        rows.append([lattice, *(float(np.sqrt(np.mean((image - truth) ** 2))) for image in images)])
    centered, report = (np.array(row[1:]) for row in rows)
    worst = float((centered[1:] / centered[:-1]).max())
    why = "an edge pixel is known to 1/aa: 0.5, and the noise of the reference"
    study.at_most("box filter: error of twice the aa over that of aa, centered lattice", worst, 0.75, why)
    why = "the report's lattice shifts the picture by almost half a pixel"
    study.at_most("box filter: error of aa=8, centered over report", centered[-1] / report[-1], 0.5, why)
    title = f"RMSE to Mitsuba's box filter with {spp} random samples a pixel"
    study.table("box-filter", title, ["lattice", *(f"aa={aa}" for aa in amounts)], rows)


def lit_by_a_sphere(width: int, height: int) -> dict[str, Any]:
    """Return scene 0 in Mitsuba's own plugins, lit by a small sphere instead of two points."""
    scene = mrt.scene_dict(0, width=width, height=height, flavor="stock")
    kept = {name: node for name, node in scene.items() if not name.startswith(("light", "sky", "integrator"))}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 30.0}}
    light = {"type": "sphere", "center": [1, 2, 0.5], "radius": 0.3, "emitter": emitter}
    sky = {"type": "constant", "radiance": 0.2}
    return {**kept, "light": light, "sky": sky, "integrator": {"type": "path", "max_depth": 4}}


def variance_error(detector: str, *, spp: int, lattice: str) -> float:
    """Return the share of pixels whose edges are not those by the unbiased variance of their rays.

    Behind a veil that stops half of the rays: of n zeros and ones with mean m, it is m (1 - m) / (n - 1).
    """
    black = {"type": "diffuse", "reflectance": 0.0}
    scene = {
        "type": "scene",
        "sensor": camera([0, 0, 0], [0, 0, 1], [0, 1, 0], 40, 30),
        "integrator": {"type": "path", "rr_depth": 100},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        "veil": {"type": "sphere", "radius": 2, "bsdf": {"type": "mask", "opacity": 0.5, "nested": black}},
    }
    options: dict[str, Any] = {"aa": 1, "aamode": detector, "layers": ["edges"], "lattice": lattice}
    found = mrt.render(mi.load_dict(scene), spp=spp, **options)
    mean = found.image
    expected = getattr(filters, f"{detector}_edges")(mean, variance=mean * (1 - mean) / (spp - 1)).value
    # whole numbers, or roundings of a mean of squares; a value next to none may be none
    off = np.abs(found.layers["edges.Y"] - expected) > (1.0 if detector == "sobel" else 1e-5)
    return float(off.mean()) if np.max(expected) > 0 else 1.0


def noise(study: Study, *, quick: bool) -> None:
    """Count refined pixels where the converged picture is flat, and where it has an edge."""
    extent = QUICK if quick else FULL
    for lattice in ("report", "film"):
        error = variance_error("sobel", spp=2, lattice=lattice)
        why = "of 2 rays: a variance by n in place of n - 1 is half as large, and changes nearly all"
        study.at_most(f"noise: share of pixels of another variance, lattice={lattice}", error, 0.02, why)
    scene = load(lit_by_a_sphere(*extent.light_size))
    # where the detectors look
    truth = mrt.render(scene, **AT_CENTRES, spp=16 * extent.light_spp, seed=78).image
    luma = np.sqrt(truth @ np.array(filters.edges.LUMA_WEIGHTS, np.float32))
    windows = np.lib.stride_tricks.sliding_window_view(luma, (3, 3))
    contrast = windows.max(axis=(2, 3)) - windows.min(axis=(2, 3))
    flat, edge = contrast < FLAT, contrast > EDGE
    rows = []
    for detector, find in (("luma", filters.luma_edges), ("sobel", filters.sobel_edges)):
        for spp in extent.noise_spp:
            seen = refined_pixels(mrt.render(scene, aa=2, aamode=detector, lattice="report", spp=spp))
            blind = np.asarray(find(mrt.render(scene, **AT_CENTRES, spp=spp).image).mask)[1:-1, 1:-1]
            seen = seen[1:-1, 1:-1]
            rows.append((detector, spp, seen[flat].mean(), seen[edge].mean(), blind[flat].mean()))
    columns = ("detector", "rays a pixel", "flat", "edges", "flat, without the variance")
    note = f"Flat: luma contrast below {FLAT} in the converged picture; edges: above {EDGE}."
    study.table("noise", "Does a detector chase noise? Share of pixels refined", columns, rows, note)
    what = "noise: share of flat pixels refined, 4 rays a pixel or more"
    why = "three deviations: 0.3 % for one normal value; estimated from 4 samples, tails are longer"
    study.at_most(what, max(r[2] for r in rows if r[1] >= 4), 0.03, why)
    what = "noise: share of edges found with 16 rays a pixel"
    why = "noise of 0.03, edges from a contrast of 0.2: at three deviations either way, most of them"
    study.at_least(what, min(r[3] for r in rows if r[1] == 16), 0.55, why)
    what = "noise: the same flat pixels without the variance"
    study.at_least(what, min(r[4] for r in rows), 0.3, "shows that there is noise to chase")
