"""Objects and whole scenes at all sizes and distances."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies.stability.cases import Cases
from mrt_mitsuba.validation.studies.stability.grazing import grazing_cases
from mrt_mitsuba.validation.studies.stability.shapes import shape_cases, stand_in_cases, start_cases
from mrt_mitsuba.validation.tools.study import Study

SCALES = (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)
TRANSLATIONS = (1.0, 1e1, 1e2, 1e3, 1e4)
WIDTH, HEIGHT = 120, 90

# A pixel is another one if a channel differs by more than two steps of an 8-bit picture
VISIBLE = 2 / 255

# Share of pixels that may differ after scaling by powers of ten: those whose centre ray passes an outline
# or the edge of a shadow within the roundings of the scaled numbers, seen directly or through ten mirrors
SHARE_SCALED = 0.001
# After moving by n scene sizes, outlines and reflections move by n roundings, enlarged by every curved mirror
SHARE_MOVED = 1e-4  # for each of them, and no less than after scaling
HOLDS_TO = 100.0  # scene sizes


def run(study: Study, *, quick: bool) -> None:
    """Check single objects, then the report's scenes scaled and moved."""
    cases = Cases(study, "geometry", "Geometry")
    worst: list[tuple[str, str, float, str]] = []
    shape_cases(cases, worst, quick=quick)
    start_cases(cases, quick=quick)
    stand_in_cases(cases)
    grazing_cases(cases, quick=quick)
    _scenes(study, cases, quick=quick)
    cases.close("A rounding is 2⁻²⁴ = 6e-8. Truth: the same rays in float64.")
    title = "The rays with the largest errors"
    study.table("geometry-worst", title, ("object", "figure", "roundings", "inputs"), worst)


def _scenes(study: Study, cases: Cases, *, quick: bool) -> None:
    rows, what = [], "share of pixels that differ by more than 2/255"
    numbers = (0, 2, 3) if quick else range(5)  # scene 2 shows the horizon, which a far plane can cut off
    for number in numbers:
        scene = report_scene(number)
        base = picture(scene)
        for factor in SCALES[::5] if quick else SCALES:
            share = _differing(picture(placed(scene, factor)), base)
            cases.at_most(f"scene {number} times {factor:g}", what, "the same picture", share, SHARE_SCALED)
        shares = [_differing(picture(placed(scene, sizes=n)), base) for n in TRANSLATIONS]
        rows.append((str(number), size(scene), *shares))
        for n, share in zip(TRANSLATIONS, shares, strict=True):
            title = f"scene {number} moved by {n:g} sizes"
            if n <= HOLDS_TO:
                cases.at_most(title, what, "the same picture", share, max(SHARE_MOVED * n, SHARE_SCALED))
            else:
                step = f"{n * 2**-23:.0e} scene sizes"
                why = f"coordinates have steps of {step} there: normals, highlights and outlines move"
                cases.beyond_float32(title, what, share, why)
    heading = "Share of pixels that differ after the scene was moved by so many scene sizes"
    note = "float32 gives out gradually: a scene belongs within a few of its sizes around the origin."
    study.table("translation", heading, ("scene", "size", *(f"{n:g}" for n in TRANSLATIONS)), rows, note)


def placed(scene: Scene, factor: float = 1.0, sizes: float = 0.0) -> Scene:
    """Return the scene with all lengths multiplied, or shifted by a multiple of its size, along no axis."""
    way = np.array([0.48, -0.6, 0.64]) * sizes * size(scene)

    def by(p: Any) -> tuple[float, float, float]:
        x, y, z = (np.array(p) * factor + way).tolist()
        return (x, y, z)

    def distance(plane: Any) -> float:
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        return float(plane.distance * factor - normal @ way)

    camera = scene.camera
    return replace(
        scene,
        camera=Camera(by(camera.position), by(camera.target), camera.up, camera.hfov),
        lights=tuple(replace(light, position=by(light.position)) for light in scene.lights),
        spheres=tuple(replace(s, center=by(s.center), radius=s.radius * factor) for s in scene.spheres),
        planes=tuple(replace(p, distance=distance(p)) for p in scene.planes),
    )


def size(scene: Scene) -> float:
    """Return the distance from the camera to what it looks at."""
    return float(np.linalg.norm(np.subtract(scene.camera.position, scene.camera.target)))


def picture(scene: Scene) -> np.ndarray:
    """Render with one ray per pixel; [H, W, 3]."""
    return render(replace(scene, focal_distance=None), width=WIDTH, height=HEIGHT, aa=1, aamode="none").image


def _differing(image: np.ndarray, base: np.ndarray) -> float:
    return float((~(np.abs(image - base).max(axis=-1) <= VISIBLE)).mean())
