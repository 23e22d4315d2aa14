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
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Depth of field: the filters against a lens"

SCENES = (3, 4)
MODES = ("report", "corrected")
REACH = filters.dof.MAX_AMOUNT  # pixels that a blurred one takes from in the report


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    size: tuple[int, int]
    aa: int
    spp: int  # rays through the lens for each sample


FULL = Extent((400, 300), 4, 32)
QUICK = Extent((128, 96), 3, 12)


@dataclass(frozen=True)
class Lens:
    """A thin lens: radius of the aperture and distance in focus, scene units."""

    radius: float
    focus: float

    def through(self, nodes: dict[str, Any]) -> dict[str, Any]:
        """Return a scene's dict with its camera behind the lens."""
        lens = {"type": "thinlens", "aperture_radius": self.radius, "focus_distance": self.focus}
        return {**nodes, "sensor": {**nodes["sensor"], **lens}}


@dataclass(frozen=True)
class Comparison:
    """Pictures [H, W, 3] of one scene by name: sharp, report, corrected, thinlens; and regions [H, W]."""

    pictures: dict[str, np.ndarray]
    regions: dict[str, np.ndarray]
    lens: Lens
    noise: float  # RMSE of the picture through the lens

    def error(self, name: str, region: str = "all") -> float:
        """Return the RMSE to the lens."""
        difference = self.pictures[name] - self.pictures["thinlens"]
        return float(np.sqrt(np.mean(np.square(difference[self.regions[region]]))))


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    rows = []
    for number in study.each("Depth of field", SCENES):
        found = compare(report_scene(number), extent)
        rows += _rows(number, found)
        _hold(study, number, found)
        _show(study, number, found)
    note = "Near depth steps: within 8 pixels of an outline. At the border: within 8 pixels of it."
    study.records("errors", "RMSE to a lens", rows, note)


def compare(scene: Scene, extent: Extent) -> Comparison:
    """Blur a sharp render with each filter, and render it through the fitted lens."""
    width, height = extent.size
    options: dict[str, Any] = {"aa": extent.aa, "aamode": "none", "lattice": "centered", "focaldist": 0}
    sharp = mrt.render(scene, width=width, height=height, layers=["depth", "normal"], **options)
    depth = sharp.layers["depth.Z"]
    focus: dict[str, Any] = {"focal_distance": scene.focal_distance, "focal_range": scene.focal_range}
    pictures = {"sharp": sharp.image}
    pictures |= {mode: filters.gaussian_dof(sharp.image, depth, **focus, mode=mode) for mode in MODES}
    lens = fit_lens(scene, depth)
    one, other = (_through(lens, scene, extent, seed) for seed in (1, 100_001))
    pictures["thinlens"] = (one + other) / 2
    noise = float(np.sqrt(np.mean(np.square(one - other)))) / 2
    return Comparison(pictures, _regions(sharp), lens, noise)


def fit_lens(scene: Scene, depth: np.ndarray) -> Lens:
    """Return the lens whose discs are nearest to the report's blur of these hit distances [H, W]."""
    amount = filters.blur_amount(depth, focal_distance=scene.focal_distance, focal_range=scene.focal_range)
    radius = disc_radius(np.asarray(amount, np.float64))
    hit = np.isfinite(depth)
    signed = np.where(depth < scene.focal_distance, -radius, radius)[hit]
    (a, b), *_ = np.linalg.lstsq(np.stack([np.ones(hit.sum()), -1 / depth[hit]], axis=1), signed, rcond=None)
    pixels = depth.shape[1] / (2 * math.tan(math.radians(scene.camera.hfov) / 2))
    return Lens(radius=float(b / pixels), focus=float(b / a))


def disc_radius(amount: np.ndarray) -> np.ndarray:
    """Return the radius of the disc as wide as the report's blur, pixels.

    The Pascal line of 2k entries has the variance (2k − 1)/4 on each axis, a disc of radius r one of r²/4.
    The whole amount k is continued to all numbers, and by a² below 1, where the report does not blur.
    """
    return np.where(amount < 1, amount, np.sqrt(np.maximum(2 * amount - 1, 0)))


def _through(lens: Lens, scene: Scene, extent: Extent, seed: int) -> np.ndarray:
    width, height = extent.size
    nodes = lens.through(scene.to_dict(width=width, height=height))
    options: dict[str, Any] = {"aa": extent.aa, "aamode": "none", "lattice": "centered"}
    return mrt.render(nodes, **options, spp=extent.spp, seed=seed).image


def _regions(sharp: Any) -> dict[str, np.ndarray]:
    depth = sharp.layers["depth.Z"]
    normal = np.stack([sharp.layers[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
    border = np.ones(depth.shape, bool)
    border[REACH:-REACH, REACH:-REACH] = False
    outlines = np.asarray(filters.geometry_edges(normal, depth, crease_angle=180).mask)
    steps = binary_dilation(outlines, iterations=REACH) & ~border
    return {
        "all": np.ones(depth.shape, bool),
        "near depth steps": steps,
        "at the border": border,
        "elsewhere": ~(steps | border),
    }


def _rows(number: int, found: Comparison) -> list[dict[str, Any]]:
    return [
        {
            "scene": number,
            "filter": name,
            "region": region,
            "pixels": int(mask.sum()),
            "RMSE": found.error(name, region),
            "RMSE / without": found.error(name, region) / found.error("sharp", region),
        }
        for name in ("sharp", *MODES)
        for region, mask in found.regions.items()
        if mask.any()
    ]


def _hold(study: Study, number: int, found: Comparison) -> None:
    name = f"scene {number}"
    corrected, why = found.error("corrected"), "a correction that is worse is none"
    study.at_most(f"{name}: RMSE of corrected / report", corrected / found.error("report"), 1, why)
    study.at_most(f"{name}: RMSE of corrected / no blur at all", corrected / found.error("sharp"), 1, why)
    why = "else the comparison would be one of noise"
    study.at_most(f"{name}: noise of the lens / RMSE of corrected", found.noise / corrected, 0.5, why)
    study.record(f"{name}: aperture radius", found.lens.radius)
    study.record(f"{name}: focus distance", found.lens.focus)
    by_region = {
        region: found.error("corrected", region) / found.error("report", region)
        for region, mask in found.regions.items()
        if mask.any()
    }
    best = min(by_region, key=by_region.__getitem__)
    study.text(
        f"Scene {number}: the lens nearest to the report's blur has an aperture of radius "
        f"{found.lens.radius:.3g} and is focused at {found.lens.focus:.3g}. The corrected filter has "
        f"{by_region['all']:.0%} of the report's error, and gains most {best} ({by_region[best]:.0%}). Both "
        "keep what no filter over one picture can know: what blurred things hide, and that the report's "
        "amounts do not follow a lens."
    )


def _show(study: Study, number: int, found: Comparison) -> None:
    order = ("sharp", *MODES, "thinlens")
    sheet = np.concatenate([found.pictures[name] for name in order], axis=1)
    study.picture(
        f"pictures-{number}", f"Scene {number}", sheet, f"Left to right: {', '.join(order)}.", exr=True
    )
    errors = np.concatenate([np.abs(found.pictures[m] - found.pictures["thinlens"]) for m in MODES], axis=1)
    title = f"Scene {number}: difference from the lens, five times"
    study.picture(f"errors-{number}", title, 5 * errors, f"Left to right: {', '.join(MODES)}.")
