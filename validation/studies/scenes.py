"""Pictures in float32 against the float64 tracer, with the reason for each pixel that differs."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Pictures of the scenes, judged in float64"

STEP = 1 / 255  # of an 8-bit picture: invisible

# Float32 places a ray of such a picture to about 1e-5 of a pixel; a mirror ray off a small sphere diverges a
# hundred times as much. Where so small a move changes what is met, float32 may meet the other
DISPLACEMENT = 1e-3

REASONS = ("silhouette", "shadow edge", "steep shading", "unexplained")

# Half of all pixels hold a few roundings of 6e-8 (measured: up to 4.8e-8), so a fault of 1 in a million of
# the light is seen
MEDIAN = 1e-7
# What ``min_contribution`` may cost a pixel, as promised: a sixteenth of an 8-bit step
CUT = STEP / 16
SHARE = 5e-4

GREY = Material(1.5, 0.3, (0.4, 0.4, 0.4), (0.3, 0.4, 0.5))
SHINY = Material(1.5, 0.1, (0.9, 0.8, 0.7), (0.1, 0.1, 0.1))


def _crowded(lights: int) -> Scene:
    """Return a few hundred objects of all kinds, looked up in trees and in light buffers."""
    rng = np.random.default_rng(5)
    things: list[Any] = []
    for i in range(330):
        place, radius = rng.uniform(-2, 2, 3), float(rng.uniform(0.08, 0.2))
        first, end = (tuple(p.tolist()) for p in (place, place + 0.5 * rng.normal(size=3)))
        kind, ends = [(Sphere, [first]), (Cone, [first, end]), (Cylinder, [first, end])][i % 3]
        things.append(kind(*ends, radius, (GREY, SHINY)[i % 5 == 0]))
    places = 6 * rng.normal(size=(lights, 3)) + [0, 6, 6]
    lamps = tuple(Light(tuple(p.tolist()), (1.2 / lights, 1.2 / lights, 1.44 / lights)) for p in places)
    camera, sky = Camera((0, 1, 6), (0, 0, 0)), (0.2, 0.3, 0.4)
    spheres, cones, cylinders = (tuple(things[kind::3]) for kind in range(3))
    return Scene(camera, sky, lamps, spheres, cones=cones, cylinders=cylinders)


LARGE, SMALL = ((320, 240), (120, 90)), ((160, 120), (64, 48))
# Of each scene a bound for 99 of 100 pixels, three times what was measured: what is left there is rounding in
# mirrors and highlights, of alpha 1e-3 in scene 3, of balls in scene 4. Then sizes in full and quick, and the
# form of the Fresnel term
CASES = {
    "0": (report_scene(0), 5e-7, LARGE, "dielectric"),
    "1": (report_scene(1), 1e-5, LARGE, "dielectric"),
    "2": (report_scene(2), 1.5e-5, LARGE, "dielectric"),
    "3": (report_scene(3), 3e-6, LARGE, "dielectric"),
    "4": (report_scene(4), 3e-5, SMALL, "dielectric"),
    "5": (report_scene(5), 1e-6, SMALL, "dielectric"),
    "6": (report_scene(6), 6e-7, LARGE, "dielectric"),
    "7": (report_scene(7), 5e-7, ((160, 120), (48, 36)), "dielectric"),
    "8": (report_scene(8), 3e-7, LARGE, "dielectric"),
    "9": (report_scene(9), 9e-7, LARGE, "dielectric"),
    "crowded": (_crowded(12), 1e-5, SMALL, "schlick"),
    "crowded, unrolled": (_crowded(4), 7e-6, SMALL, "schlick"),
}


def judge(
    image: np.ndarray, scene: Scene, *, displacement: float = DISPLACEMENT, **settings: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Judge a linear picture [H, W, 3], one sample a pixel; ``settings``: those of ``reference_render``.

    Return the error [H, W], the largest difference in a channel; and the reason [H, W], an index in
    ``REASONS`` where the error exceeds a step of an 8-bit picture, else -1. Such a pixel is on a silhouette
    or a shadow's edge if a ray moved by ``displacement`` pixels meets other things or other lights, on steep
    shading if that changes its colour by as much, or unexplained.
    """
    settings |= {"height": image.shape[0], "width": image.shape[1]}
    truth = reference_render(scene, **settings)
    error = np.abs(image - truth.image).max(axis=-1)
    off = ~(error <= STEP)
    if not off.any():
        return error, np.full(off.shape, -1)
    steps = [(displacement, 0), (-displacement, 0), (0, displacement), (0, -displacement)]
    moved = [reference_render(scene, displacement=step, **settings) for step in steps]
    silhouette = np.any([other.path != truth.path for other in moved], axis=0)
    shadow = np.any([other.lights != truth.lights for other in moved], axis=0)
    spread = np.max([np.abs(other.image - truth.image).max(axis=-1) for other in moved], axis=0)
    return error, np.select([~off, silhouette, shadow, error <= spread], [-1, 0, 1, 2], 3)


def draw(scene: Any, size: Any, *, fresnel: str = "dielectric", cut: bool = False, **more: Any) -> np.ndarray:
    """Return our picture, one sample per pixel; ``cut``: with dim paths cut short."""
    settings = {"type": "mrt_whitted", **({} if cut else {"min_contribution": 0.0}), **more}
    options: dict[str, Any] = {"width": size[0], "height": size[1], "aa": 1, "aamode": "none", "focaldist": 0}
    return mrt.render(scene, **options, fresnel=fresnel, integrator=settings).image


def hold(study: Study, name: str, error: np.ndarray, reason: np.ndarray) -> None:
    """Hold a scene that was judged to its bounds."""
    most = CASES[name][1]
    why = f"least fault: 1 % of the pixels off by {most:g}, or half of them by 1e-7"
    study.at_most(f"scene {name}: median difference", np.median(error), MEDIAN, why)
    study.at_most(f"scene {name}: difference of 99 %", np.quantile(error, 0.99), most, why)
    why = "rounding sends single pixels to the other side of an edge: measured up to two in ten thousand"
    study.at_most(f"scene {name}: share of pixels off by > 1/255", float(np.mean(error > STEP)), SHARE, why)
    why = "silhouettes, edges of shadows and steep shading are reasons, found by moved rays"
    left = np.sum(reason == REASONS.index("unexplained"))
    study.at_most(f"scene {name}: pixels off without a reason", left, 0, why)


def run(study: Study, *, quick: bool) -> None:
    """Judge our pictures of all scenes, and the places of samples."""
    pictures(study, quick=quick)
    lattices(study)


def pictures(study: Study, *, quick: bool) -> None:
    """Judge our pictures of all scenes."""
    rows: list[dict[str, Any]] = []
    for name, (scene, _, sizes, fresnel) in study.each("Scenes in float64", CASES.items()):
        size = sizes[quick]
        image = draw(scene, size, fresnel=fresnel)
        error, reason = judge(image, scene, fresnel=fresnel)
        hold(study, name, error, reason)
        cut = float(np.abs(draw(scene, size, fresnel=fresnel, cut=True) - image).max())
        study.at_most(f"scene {name}: change by cutting dim paths", cut, CUT, "the promise, of every pixel")
        shown = {"median": np.median(error), "99 %": np.quantile(error, 0.99), "largest": error.max()}
        counts = {word: int(np.sum(reason == i)) for i, word in enumerate(REASONS)}
        rows.append({"scene": name, "size": "{}x{}".format(*size), **shown, "cut-off": cut, **counts})
    note = (
        "One sample per pixel, no path cut; then how much cutting dim paths changes. Fresnel is exact, and "
        "Schlick's in the crowds. Pixels off by more than 1/255 are counted by reason."
    )
    study.records("scenes", "Our pictures against the float64 tracer", rows, note)


def lattices(study: Study) -> None:
    """Hold four samples a pixel to those of the tracer, at the places that each lattice says."""
    scene = report_scene(0)
    size: dict[str, Any] = {"width": 80, "height": 60}
    for lattice, places in {"report": (0.0, 0.5), "centered": (-0.25, 0.25)}.items():
        samples = [reference_render(scene, displacement=place, **size) for place in product(places, repeat=2)]
        truth = np.mean([sample.image for sample in samples], axis=0)
        options: dict[str, Any] = {"aa": 2, "aamode": "none", "focaldist": 0, "fresnel": "dielectric"}
        image = mrt.render(scene, lattice=lattice, **options, **size).image
        error = np.quantile(np.abs(image - truth).max(axis=-1), 0.99)
        why = "four times what was measured; least fault: samples in other places leave 0.07"
        study.at_most(f"four samples, lattice={lattice}: difference of 99 %", error, 5e-6, why)
