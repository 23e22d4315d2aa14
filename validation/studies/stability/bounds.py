"""Stiff and extreme cases with limits: the reflectance, light paths, scenes that are scaled or moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.linalg import norm

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render, unit
from mrt_mitsuba.validation.studies.stability import axes
from mrt_mitsuba.validation.study import Study, Values

# ----------------------------------------------- Reflectance -----------------------------------------------


def reflectance(study: Study, *, quick: bool) -> None:
    """Hold F where total reflection begins."""
    # there F ends in a square root: errors are those of g = 0
    iors = np.repeat(np.array([0.5, 0.9, 0.99, 0.9999], np.float32), 81)
    critical = np.sqrt(1 - np.float64(iors) ** 2)
    cosines = np.float32(critical + np.tile(np.arange(-40, 41), 4) * np.spacing(np.float32(critical)))
    why = "√ of a rounding: 1 - F is 4 g / (η² cos θ) there, and g² is known to a rounding of cos²"
    error = axes.reflectances(cosines, iors)[axes.OURS].max() * axes.ROUNDING
    study.at_most("error of F within 40 float32 cosines of the critical angle", error, 16 * 2.0**-12, why)


# ---------------------------------------------- Light paths ----------------------------------------------

# Differences count relative to the value plus a thousandth, and the worst of 95 % of the pixels is held to a
# bound: the others may show outlines and the edges of shadows
SMALL = 1e-3
SHARE = 0.95
# For plain cases: some float32 roundings, three times what was measured
PLAIN = 3e-6

GREY = Material(1.3, 0.1, (0.5, 0.5, 0.5), (0.3, 0.2, 0.1))
MIRROR = Material(1.5, 0.3, (0.95, 0.9, 0.85), (0.2, 0.2, 0.2))
CAMERA = Camera((0.2, 0.5, 3.0), (0.0, 0.5, 0.0), hfov=20)  # the ball fills the picture
LIGHTS = (Light((2, 3, 4), (1.0, 0.9, 0.8)), Light((-3, 2, 2), (0.4, 0.5, 0.6)))
FLOOR = Plane((0, 1, 0), 0.0, GREY)
BALL = Sphere((0, 0.5, 0), 0.5, GREY)
BASE = Scene(CAMERA, (0.2, 0.3, 0.4), LIGHTS, (BALL,), (FLOOR,))


def _lit(position: tuple[float, float, float], color: float = 1.0) -> Scene:
    return replace(BASE, lights=(Light(position, (color,) * 3),))


def _hall(specular: float) -> Scene:
    """Two mirrors that face each other, with a ball and the camera between them."""
    material = replace(MIRROR, specular=(specular, 0.95 * specular, 0.9 * specular))
    walls = (Plane((0, 0, 1), 2.0, material), Plane((0, 0, -1), 2.0, material), Plane((0, 1, 0), 1.0, GREY))
    ball = Sphere((0.3, -0.2, -0.5), 0.4, GREY)
    lamp = Light((0.5, 1.5, 0.3), (1, 1, 1))
    return Scene(Camera((0.0, 0.1, 1.0), (0.05, 0.0, -2.0)), (0.2, 0.3, 0.4), (lamp,), (ball,), walls)


def light_paths(study: Study, *, quick: bool) -> None:
    """Hold scenes that are hard on a path tracer to the float64 tracer."""
    hall: Values = {"fresnel": "unity"}
    bright = _lit((2, 3, 4), 1e4)
    unclamped: Values = {"clamp": False}
    rows: list[tuple[str, Scene, float, Values]] = [
        ("facing mirrors of Ks 0.95, ten bounces", _hall(0.95), 2e-5, hall),
        ("facing mirrors of Ks 1, ten bounces", _hall(1), 2e-5, hall),
        ("a light of 1e4, clamped", bright, PLAIN, {}),
        ("a light of 1e4, without clamp", bright, PLAIN, unclamped),
        ("a light inside a ball, not lit from outside", _lit((0, 0.5, 0)), PLAIN, {}),
        ("a light at 1e6, parallel light", _lit((4e5, 6e5, 7e5)), PLAIN, {}),
    ]
    why = "roundings, relative to the value plus a thousandth, of 95 % of the pixels"
    for name, scene, limit, settings in study.each("Light paths", rows):
        study.at_most(f"path error: {name}", path_error(scene, **settings), limit, why)


def path_error(scene: Scene, *, fresnel: str = "dielectric", clamp: bool = True) -> float:
    """Return the largest difference in a channel that 95 % of the pixels stay below; inf for bad values."""
    size: Values = {"width": 64, "height": 48}
    truth = reference_render(scene, **size, fresnel=fresnel, clamp=clamp)
    nodes = scene.to_dict(**size, fresnel=fresnel)
    nodes["integrator"] = {"type": "mrt_whitted", "clamp": clamp, "min_contribution": 0.0}
    image = render(nodes, aa=1, lattice="report").image
    if not (np.isfinite(image) & (image >= 0)).all():
        return np.inf
    return float(np.quantile((abs(image - truth) / (truth + SMALL)).max(axis=-1), SHARE))


# ---------------------------------------- Scenes scaled and moved ----------------------------------------

# A pixel is another one if a channel differs by more than two steps of an 8-bit picture. After scaling by
# powers of ten, so many may be: those whose centre ray passes an outline or the edge of a shadow within the
# roundings of the scaled numbers, seen directly or through ten mirrors. After moving by n scene sizes, they
# move by n roundings, enlarged by every curved mirror
VISIBLE = 2 / 255
SHARE_SCALED = 0.001
SHARE_MOVED = 1e-4


def placements(study: Study, *, quick: bool) -> None:
    """Hold the share of pixels that change where the report's scenes are scaled, or moved by their sizes."""
    what = "share of pixels off by more than 2/255"
    # Scene 2 shows the horizon, which a far plane can cut off
    for number in study.each("Placements", (0, 2) if quick else range(5)):
        scene = replace(report_scene(number), focal_distance=None)
        for factor in (1e-6, 1e-3, 1e3, 1e6):
            off = changed(scene, factor, 0)
            study.at_most(f"{what}: scene {number} times {factor:g}", off, SHARE_SCALED, "the same picture")
        for sizes in (1.0, 10.0, 100.0):
            off = changed(scene, 1, sizes)
            most = max(SHARE_MOVED * sizes, SHARE_SCALED)
            why = "coordinates have steps of 2⁻²³ of that distance: normals and outlines move"
            study.at_most(f"{what}: scene {number} moved by {sizes:g} sizes", off, most, why)


def changed(scene: Scene, factor: float, sizes: float) -> float:
    """Return the share of pixels that change where a scene is placed elsewhere."""
    scenes = (scene, placed(scene, factor, sizes))
    before, after = (render(one, width=120, height=90, aa=1, aamode="none").image for one in scenes)
    return float(np.mean(~(abs(after - before).max(axis=-1) <= VISIBLE)))  # NaN is off


def placed(scene: Scene, factor: float, sizes: float) -> Scene:
    """Return the scene with all lengths multiplied, or shifted by a multiple of its size, along no axis.

    Its size: the distance from the camera to what it looks at.
    """
    camera = scene.camera
    size = norm(np.subtract(camera.position, camera.target))
    way = np.array([0.48, -0.6, 0.64]) * sizes * size

    def by(p: Sequence[float]) -> tuple[float, float, float]:
        x, y, z = (np.array(p) * factor + way).tolist()
        return (x, y, z)

    planes = [(p, float(p.distance * factor - unit(np.array(p.normal)) @ way)) for p in scene.planes]
    return replace(
        scene,
        camera=replace(camera, position=by(camera.position), target=by(camera.target)),
        lights=tuple(replace(light, position=by(light.position)) for light in scene.lights),
        spheres=tuple(replace(s, center=by(s.center), radius=s.radius * factor) for s in scene.spheres),
        planes=tuple(replace(plane, distance=distance) for plane, distance in planes),
    )
