"""Adaptive anti-aliasing against full supersampling: error, rays and time; and whether it chases noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.scenery import AT_CENTRES, camera
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import Warm, measure

TITLE = "Anti-aliasing: adaptive against full"

MODES = ("none", "luma", "sobel", "geometry")
# An error counts as that of full supersampling up to here; a twentieth is less than doubling aa changes by a
# factor of 2
SAME_ERROR = 1.05
THIRD = 1 / 3

# Luma contrast of a 3x3 neighbourhood in the converged picture: below, nothing is worth refining; above, it
# is an edge
FLAT, EDGE = 0.02, 0.2


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    scenes: Sequence[int]
    lattices: Sequence[str]
    amounts: Sequence[int]
    reference_aa: int
    size: tuple[int, int]
    repeats: int
    light_size: tuple[int, int]
    light_spp: int  # of the reference, for each of its samples
    noise_spp: Sequence[int]


FULL = Extent(
    range(5), ("report", "centered"), (2, 4, 8), 32, (400, 300), 3, (200, 150), 64, (2, 4, 8, 16, 32, 64)
)
QUICK = Extent((0, 3), ("report",), (2, 4), 16, (120, 90), 1, (80, 60), 16, (4, 16))


@dataclass(frozen=True)
class Row:
    """One setting, compared with full supersampling at the same aa."""

    mode: str
    aa: int
    warm: Warm
    error: float  # RMSE
    unrefined_share: float  # of the squared error, in pixels with one sample

    @property
    def rays(self) -> int:
        return self.warm.result.rays["primary"]

    @property
    def refined(self) -> float:
        """Share of pixels with more than one sample."""
        return float(np.mean(_samples(self.warm.result) > 1))


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    _compare_modes(study, extent)
    _compare_with_mitsuba(study, quick=quick)
    _compare_modes_over_path(study, extent)
    _chase_noise(study, extent)
    for lattice in ("report", "film"):
        error = variance_error("sobel", spp=2, lattice=lattice)
        why = "of 2 rays: a variance by n in place of n - 1 is half as large, and changes nearly all"
        study.at_most(f"noise: share of pixels of another variance, lattice={lattice}", error, 0.02, why)


# ----------------------------------------- The report's scenes ------------------------------------------


def _compare_modes(study: Study, extent: Extent) -> None:
    width, height = extent.size
    table, reached = [], 0
    for number, lattice in study.each("Anti-aliasing", [*product(extent.scenes, extent.lattices)]):
        scene = load(mrt.scene_dict(number, width=width, height=height))
        rows = _rows(scene, extent, lattice=lattice)
        table += _cells(str(number), lattice, rows)
        if lattice == "report":
            reached += _read(study, number, rows)
            _hold(study, f"scene {number}", rows)
            _show_contours(study, number, rows)
    title = f"Error to aa={extent.reference_aa} of the same lattice, {width}x{height}"
    study.records("modes", title, table, "Seconds are medians of warm runs, each setting in turn.")
    study.record("scenes where sobel or geometry reach the error of full in a third of its time", reached)


def _rows(
    scene: Any, extent: Extent, *, reference_aa: int = 0, reference_spp: int = 1, **options: Any
) -> list[Row]:
    """Return the figures of every mode and amount on a scene; the options are those of ``mrt.render``."""
    shared = {"integrator": options.pop("integrator", None), "lattice": options.pop("lattice")}
    reference = mrt.render(
        scene, aa=reference_aa or extent.reference_aa, aamode="none", spp=reference_spp, seed=77, **shared
    ).image.astype(np.float64)
    runs = {
        (mode, aa): partial(mrt.render, scene, aa=aa, aamode=mode, **shared, **options)
        for mode in MODES
        for aa in extent.amounts
    }
    rows = []
    for (mode, aa), warm in measure(runs, repeats=extent.repeats).items():
        squared = np.square(warm.result.image - reference).mean(axis=-1)
        alone = squared[_samples(warm.result) == 1].sum() / max(squared.sum(), 1e-300)
        rows.append(Row(mode, aa, warm, float(np.sqrt(squared.mean())), float(alone)))
    return rows


def _samples(result: Any) -> np.ndarray:
    full = np.full(result.image.shape[:2], result.plan.lattice.count, np.float32)
    return result.layers.get("samples.Y", full)


def _full(rows: Sequence[Row]) -> dict[int, Row]:
    """Return full supersampling by aa."""
    return {row.aa: row for row in rows if row.mode == "none"}


def _cells(scene: str, lattice: str, rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [
        {
            "scene": scene,
            "lattice": lattice,
            "mode": row.mode,
            "aa": row.aa,
            "RMSE": row.error,
            "error / full": row.error / full.error,
            "rays": row.rays,
            "rays / full": row.rays / full.rays,
            "seconds": row.warm.seconds,
            "time / full": row.warm.seconds / full.warm.seconds,
            "spread": row.warm.spread,
            "pixels refined": row.refined,
            "error in the others": row.unrefined_share,
        }
        for row in rows
        for full in [_full(rows)[row.aa]]
    ]


def _hold(study: Study, name: str, rows: Sequence[Row]) -> None:
    """Bound what holds on any machine: rays and errors."""
    full = _full(rows)
    off = [row.rays - _expected_rays(row) for row in rows if row.mode != "none"]
    title = f"{name}: camera rays other than one a pixel and aa² - 1 in refined ones"
    study.at_most(title, max(map(abs, off)), 0, "a count")
    least = max(full)
    sobel = next(row for row in rows if (row.mode, row.aa) == ("sobel", least))
    why = (
        "scene 4 leaves a fifth of its pixels alone and twice the error, scene 2 the outlines of its dark "
        "spheres; a detector that finds nothing has four times the error or more"
    )
    study.at_most(f"{name}: error of sobel / full at aa={least}", sobel.error / full[least].error, 2.2, why)


def _expected_rays(row: Row) -> int:
    samples = _samples(row.warm.result)
    return samples.size + int((samples > 1).sum()) * (row.aa**2 - 1)


def _read(study: Study, number: int, rows: Sequence[Row]) -> bool:
    """Say what it takes to reach the error of full supersampling, or why it is not to be had for a third."""
    target = max(_full(rows).values(), key=lambda row: row.aa)
    sparing = [row for row in rows if row.mode in ("sobel", "geometry")]
    good = [row for row in sparing if row.error <= SAME_ERROR * target.error]
    best = min(good, key=lambda row: row.warm.seconds, default=None)
    name = f"Scene {number}, full supersampling at aa={target.aa}"
    if best is not None:
        share = best.warm.seconds / target.warm.seconds
        study.record(f"scene {number}: time of the cheapest equal error / full", share)
        text = (
            f"{name}: {best.mode} at aa={best.aa} reaches its error ({best.error:.2g} to {target.error:.2g}) "
            f"with {best.rays / target.rays:.0%} of the rays, in {share:.0%} of the time."
        )
        if share > THIRD:
            text += (
                f" Not in a third: the detector refines {best.refined:.0%} of all pixels, "
                f"and looking for them costs a pass."
            )
        study.text(text)
        return share <= THIRD
    near = min(sparing, key=lambda row: row.error)
    study.text(
        f"{name}: neither sobel nor geometry reaches its error of {target.error:.2g}. The nearest is "
        f"{near.mode} at aa={near.aa} with {near.error:.2g}, and {near.unrefined_share:.0%} of its squared "
        "error lies in pixels that it left alone: faint or unseen by it."
    )
    return False


def _show_contours(study: Study, number: int, rows: Sequence[Row]) -> None:
    """Show what each detector would refine, as the report does."""
    aa = min(row.aa for row in rows)
    masks = [_samples(row.warm.result) > 1 for row in rows if row.aa == aa and row.mode != "none"]
    found = [filters.EdgeMap(mask=mask, value=mask.astype(np.float32)) for mask in masks]
    caption = "Left to right: luma, sobel, geometry."
    study.picture(f"contours-{number}", f"Scene {number}: refined pixels", filters.contours(*found), caption)


def _compare_with_mitsuba(study: Study, *, quick: bool) -> None:
    """Compare lattices with random samples that Mitsuba places and filters itself, on scene 3."""
    width, height, spp = (96, 72, 1024) if quick else (200, 150, 8192)
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
    columns = ["lattice", *(f"aa={aa}" for aa in amounts)]
    study.table(
        "box-filter", f"RMSE to Mitsuba's box filter with {spp} random samples a pixel", columns, rows
    )


# --------------------------------------------- Monte Carlo ----------------------------------------------


def lit_by_a_sphere(width: int, height: int) -> dict[str, Any]:
    """Return scene 0 in Mitsuba's own plugins, lit by a small sphere instead of two points."""
    scene = mrt.scene_dict(0, width=width, height=height, flavor="stock")
    kept = {name: node for name, node in scene.items() if not name.startswith(("light", "sky", "integrator"))}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 30.0}}
    light = {"type": "sphere", "center": [1, 2, 0.5], "radius": 0.3, "emitter": emitter}
    sky = {"type": "constant", "radiance": 0.2}
    return {**kept, "light": light, "sky": sky, "integrator": {"type": "path", "max_depth": 4}}


def _compare_modes_over_path(study: Study, extent: Extent) -> None:
    scene = load(lit_by_a_sphere(*extent.light_size))
    rows = _rows(scene, extent, reference_aa=8, reference_spp=extent.light_spp, lattice="report", spp=8)
    width, height = extent.light_size
    title = f"Mitsuba's path under an area light, 8 rays for each sample, {width}x{height}"
    note = (
        f"Error to aa=8 with {extent.light_spp} rays for each sample. Most of it is noise, which falls with "
        "every ray, wherever it goes; so the error follows the number of rays, and adaptive sampling only "
        "spares those that sharp edges do not need."
    )
    study.records("path", title, _cells("0, area light", "report", rows), note)


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


def _chase_noise(study: Study, extent: Extent) -> None:
    """Count refined pixels where the converged picture is flat, and where it has an edge."""
    scene = load(lit_by_a_sphere(*extent.light_size))
    # where the detectors look
    truth = mrt.render(scene, **AT_CENTRES, spp=16 * extent.light_spp, seed=78).image
    contrast = _contrast(truth)
    flat, edge = contrast < FLAT, contrast > EDGE
    rows = []
    for detector, find in (("luma", filters.luma_edges), ("sobel", filters.sobel_edges)):
        for spp in extent.noise_spp:
            seen = _samples(mrt.render(scene, aa=2, aamode=detector, lattice="report", spp=spp)) > 1
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


def _contrast(image: np.ndarray) -> np.ndarray:
    """Return the largest less smallest luma of the 3x3 neighbourhood, the border left out, [H - 2, W - 2]."""
    luma = np.sqrt(image @ np.array(filters.edges.LUMA_WEIGHTS, np.float32))
    windows = np.lib.stride_tricks.sliding_window_view(luma, (3, 3))
    return windows.max(axis=(2, 3)) - windows.min(axis=(2, 3))
