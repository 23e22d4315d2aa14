"""The way from the report's picture of a scene to its stock flavour, one approximation at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import MrtError
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.scene.model import Material, Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.tools.gallery import gallery
from mrt_mitsuba.validation.tools.image_tests import Comparison, Estimate, compare, estimate, flip
from mrt_mitsuba.validation.tools.scenery import AT_CENTRES, with_materials
from mrt_mitsuba.validation.tools.study import Study

PATH = {"type": "path", "max_depth": 4}
# Narrower lobes make fireflies: no mean of some hundred samples of them is normal, as the tests need it
ALPHA_FOR_TESTS = 0.1
RENDERS = 8
LEVEL = (
    1e-3  # probability that a comparison calls equal pictures different; seeds are fixed, so it stays passed
)


# Seeds are fixed, so what such a bound can fail for is a change; by as much as this, it does
POWER = "least fault: the mistakes of the table of mutations, 2 % of the light and 5 % of alpha among them"


def without_approximations(number: int, *, width: int, height: int, spp: int) -> dict[str, np.ndarray]:
    """Return the report's picture and those with ever fewer approximations, by what is new in each."""
    size: dict[str, Any] = {"width": width, "height": height}
    scene = report_scene(number)
    plain = physical(scene)
    stock = mrt.scene_dict(scene, flavor="stock", **size)
    exact: dict[str, Any] = {"fresnel": "dielectric", **size}
    lamps, squares = (
        {name: node for name, node in stock.items() if name.startswith(kind)} for kind in ("light_", "plane_")
    )
    ours, ours_plain = mrt.scene_dict(scene, **exact), mrt.scene_dict(plain, **exact)
    unclamped = {"type": "mrt_whitted", "clamp": False}
    scenes: list[tuple[str, dict[str, Any], dict[str, Any], int]] = [
        ("the report's picture", ours, {"type": "mrt_whitted"}, 1),
        ("clamp off", ours, unclamped, 1),
        ("lights with falloff", {**ours, **lamps}, unclamped, 1),
        ("colours up to 1, roughness positive", {**ours_plain, **lamps}, unclamped, 1),
        ("finite planes", {**ours_plain, **lamps, **squares}, unclamped, 1),
        ("gloss and indirect light, by path", {**ours_plain, **lamps, **squares}, PATH, spp),
        ("diffuse light refracted: stock flavour", stock, PATH, spp),
    ]
    return {
        what: mrt.render(mi.load_dict(nodes), integrator=integrator, spp=count, **AT_CENTRES).image
        for what, nodes, integrator, count in scenes
    }


def physical(scene: Scene, *, least_alpha: float = 1e-4, diffuse: bool = True) -> Scene:
    """Return a scene that Mitsuba's plugins take: colours up to 1, positive roughness; Kd if ``diffuse``."""

    def material(m: Material) -> Material:
        clipped: dict[str, Any] = {
            name: tuple(min(c, 1.0) for c in getattr(m, name)) for name in ("specular", "diffuse")
        }
        if not diffuse:
            clipped["diffuse"] = (0.0, 0.0, 0.0)
        return dataclasses.replace(m, alpha=max(abs(m.alpha), least_alpha), **clipped)

    return with_materials(scene, material)


def path_estimate(nodes: dict[str, Any], *, spp: int, seed: int = 0, integrator: Any = PATH) -> Estimate:
    """Return the mean of RENDERS independent renders through the pixels' centres."""
    scene = mi.load_dict(nodes)
    return estimate(
        [
            mrt.render(scene, integrator=integrator, spp=spp, **AT_CENTRES, seed=seed + i).image
            for i in range(RENDERS)
        ]
    )


def finite(nodes: dict[str, Any], stock: dict[str, Any]) -> dict[str, Any]:
    """Return our scene with the lights and the finite planes of the stock flavour."""
    return {**nodes, **{name: node for name, node in stock.items() if name.startswith(("light_", "plane_"))}}


def path_estimates(scenes: Sequence[dict[str, Any]], seeds: Sequence[int], *, spp: int) -> list[Estimate]:
    """Return ``path_estimate`` of each scene with its seed, by as many processes as there are cores."""
    rows = [(nodes, seed + i) for nodes, seed in zip(scenes, seeds, strict=True) for i in range(RENDERS)]
    grid = {"scene": [nodes for nodes, _ in rows], "seed": [seed for _, seed in rows]}
    options: dict[str, Any] = {"integrator": PATH, "spp": spp, "aa": 1, "aamode": "none"}
    with TemporaryDirectory() as folder:
        table = mrt.sweep(None, folder, grid=grid, zipped=True, progress=Progress(), **options)
        if table.failed:
            raise MrtError(table.failed[0]["error"])
        images = [read_exr(Path(folder, row["file"])).image for row in table.rows]
    return [estimate(images[first : first + RENDERS]) for first in range(0, len(images), RENDERS)]


def compare_rest(numbers: Sequence[int], *, width: int, height: int, spp: int) -> list[Comparison]:
    """Compare without diffuse parts: there ``mrt_bsdf`` and ``roughplastic`` are equal but for noise."""
    size: dict[str, Any] = {"width": width, "height": height}
    scenes = []
    for number in numbers:
        scene = physical(report_scene(number), least_alpha=ALPHA_FOR_TESTS, diffuse=False)
        stock = mrt.scene_dict(scene, flavor="stock", **size)
        scenes += [finite(mrt.scene_dict(scene, fresnel="dielectric", **size), stock), stock]
    found = path_estimates(scenes, [0, 1000] * len(numbers), spp=spp)
    return [compare(*pair, level=LEVEL) for pair in zip(found[::2], found[1::2], strict=True)]


def run(study: Study, *, quick: bool) -> None:
    """Show where the report's pictures and those of the stock flavour differ, and by what."""
    numbers = (0, 1, 3) if quick else (0, 1, 2, 3, 4)
    size: dict[str, Any] = {"width": 64, "height": 48} if quick else {"width": 160, "height": 120}
    spp = 64 if quick else 256
    rows, rest = [], []
    comparisons = compare_rest(numbers, spp=spp // 4, **size)
    for number, found in study.each("Approximations", [*zip(numbers, comparisons, strict=True)]):
        pictures = without_approximations(number, spp=spp, **size)
        title = f"Scene {number}, one approximation less at a time"
        study.plot(f"approximations_{number}", title, gallery(pictures))
        rows += _rows(number, pictures)
        name = f"scene {number}: p that black mrt_bsdf and roughplastic make the same picture"
        study.at_least(name, found.p, LEVEL, POWER)
        rest.append([number, *(v.p for v in (found.pixel, found.tile, found.image)), found.rel_rmse])
    title = "What each of the report's approximations changes"
    note = f"Path pictures have {spp} samples a pixel; what is left to the stock flavour holds their noise."
    study.records("approximations", title, rows, note)
    title = "With those switched off, and nothing diffuse: p values of equality"
    note = (
        f"path, {RENDERS} renders each, roughness at least {ALPHA_FOR_TESTS:g}. The same scenes with "
        "mistakes in them are rejected: see the table of mutations."
    )
    study.table("rest", title, ["scene", "pixel", "tile", "image", "relRMSE"], rest, note)


def _rows(number: int, pictures: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    *_, last = pictures.values()
    before, stock = pictures["the report's picture"], np.maximum(last, 0)
    exposures, rows = None, []
    for what, image in pictures.items():
        change = np.abs(image - before)
        perceived = flip(stock, np.maximum(image, 0), exposures=exposures)
        before, exposures = image, perceived.exposures
        figures = {
            "mean difference": float(change.mean()),
            "% of pixels > 1/255": 100 * float(np.mean(change.max(axis=-1) > 1 / 255)),
            "mean left to the stock flavour": float(np.abs(image - stock).mean()),
            "FLIP left": perceived.mean,
        }
        rows.append({"scene": number, "changed, too": what, **figures})
    return rows
