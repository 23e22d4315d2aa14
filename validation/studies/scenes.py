"""Pictures of the report's scenes in float32 against the float64 tracer, with a reason for each pixel off."""

from __future__ import annotations

from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.study import Study, Values

TITLE = "Pictures of the scenes, judged in float64"

STEP = 1 / 255  # of an 8-bit picture: invisible
# Pixels. Float32 places a ray to about 1e-5 of a pixel, and mirrors of small spheres enlarge that a hundred
# times; where so small a move changes what a ray meets, float32 may meet the other
DISPLACEMENT = 1e-3
# Bounds for 99 of 100 pixels of scenes 0 to 9, three times what was measured: what is left there is rounding
# in mirrors and highlights, of alpha 1e-3 in scene 3, of balls in scene 4
MOST = (5e-7, 1e-5, 1.5e-5, 3e-6, 3e-5, 1e-6, 6e-7, 5e-7, 3e-7, 9e-7)


def judge(image: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Judge a linear picture [H, W, 3] with one sample a pixel and the exact Fresnel factor.

    Return the error [H, W], the largest difference in a channel; and where nothing explains it [H, W]: it
    exceeds a step of an 8-bit picture, and a ray moved by ``DISPLACEMENT`` pixels, across the edge of a
    silhouette or a shadow or along steep shading, changes the colour by less than half of it.
    """
    size = {"height": image.shape[0], "width": image.shape[1]}
    truth = reference_render(scene, **size)
    error = abs(image - truth).max(axis=-1)
    off = ~(error <= STEP)
    steps = DISPLACEMENT * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    moved = [reference_render(scene, displacement=step, **size) for step in steps if off.any()]
    spread = np.max([abs(other - truth).max(axis=-1) for other in moved], axis=0, initial=0)
    return error, off & ~(error <= 2 * spread)


def draw(scene: Scene | int, size: tuple[int, int], **integrator: Any) -> np.ndarray:
    """Return our picture, one sample a pixel, with no path cut short."""
    settings = {"type": "mrt_whitted", "min_contribution": 0.0, **integrator}
    options: Values = {"width": size[0], "height": size[1], "aa": 1, "aamode": "none", "focaldist": 0}
    return mrt.render(scene, **{**options, "fresnel": "dielectric", "integrator": settings}).image


def hold(study: Study, number: int, error: np.ndarray, unexplained: np.ndarray) -> None:
    """Hold a scene that was judged to its bounds."""
    edges = "rounding sends single pixels to the other side of an edge: measured up to two in ten thousand"
    least = f"least fault: 1 % off by {MOST[number]:g}"
    found = {
        "median difference": (np.median(error), 1e-7, "least fault: half of the pixels off by 1e-7"),
        "difference of 99 %": (np.quantile(error, 0.99), MOST[number], least),
        "share of pixels off by > 1/255": (np.mean(error > STEP), 5e-4, edges),
        "pixels off without a reason": (unexplained.sum(), 0, "a ray moved a little explains all others"),
    }
    for what, bound in found.items():
        study.at_most(f"scene {number}: {what}", *bound)


def run(study: Study, *, quick: bool) -> None:
    """Judge our pictures of all scenes."""
    size = (48, 36) if quick else (160, 120)
    for number in study.each("Scenes in float64", range(len(MOST))):
        scene = report_scene(number)
        hold(study, number, *judge(draw(scene, size), scene))
