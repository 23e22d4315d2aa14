"""Pictures in float32 against the float64 tracer, with the reason for each pixel that differs."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.study import Study, Values

TITLE = "Pictures of the scenes, judged in float64"

STEP = 1 / 255  # of an 8-bit picture: invisible

# Float32 places a ray of such a picture to about 1e-5 of a pixel; a mirror ray off a small sphere diverges a
# hundred times as much. Where so small a move changes what is met, float32 may meet the other
DISPLACEMENT = 1e-3

REASONS = ("silhouette", "shadow edge", "steep shading", "unexplained")

# Half of all pixels hold a few roundings of 6e-8 (measured: up to 4.8e-8)
MEDIAN = 1e-7
SHARE = 5e-4

GREY = Material(1.5, 0.3, (0.4, 0.4, 0.4), (0.3, 0.4, 0.5))
SHINY = Material(1.5, 0.1, (0.9, 0.8, 0.7), (0.1, 0.1, 0.1))


def _crowded(lights: int) -> Scene:
    """A few hundred objects of all kinds, looked up in trees and in light buffers."""
    rng = np.random.default_rng(5)
    start = rng.uniform(-2, 2, (330, 3))
    ends = start + 0.5 * rng.normal(size=(330, 3))
    radii = rng.uniform(0.08, 0.2, 330)
    things = []
    for number, (p, q, radius) in enumerate(zip(start.tolist(), ends.tolist(), radii.tolist(), strict=True)):
        things.append((tuple(p), tuple(q), radius, GREY if number % 5 else SHINY))
    places = (6 * rng.normal(size=(lights, 3)) + [0, 6, 6]).tolist()
    color = (1.2 / lights, 1.2 / lights, 1.44 / lights)
    lamps = tuple(Light(tuple(place), color) for place in places)
    return Scene(
        Camera((0, 1, 6), (0, 0, 0)),
        (0.2, 0.3, 0.4),
        lamps,
        spheres=tuple(Sphere(p, radius, material) for p, _, radius, material in things[::3]),
        cones=tuple(Cone(*thing) for thing in things[1::3]),
        cylinders=tuple(Cylinder(*thing) for thing in things[2::3]),
    )


# in full, and quick
LARGE = ((320, 240), (120, 90))
SMALL = ((160, 120), (64, 48))
SIZES = {4: SMALL, 5: SMALL, 7: ((160, 120), (48, 36))}
# Bounds for 99 of 100 pixels, three times what was measured: what is left there is rounding in mirrors and
# highlights, of alpha 1e-3 in scene 3, of balls in scene 4
MOST = (5e-7, 1e-5, 1.5e-5, 3e-6, 3e-5, 1e-6, 6e-7, 5e-7, 3e-7, 9e-7)


class Case(NamedTuple):
    """A scene, and how it is judged."""

    scene: Scene
    most: float  #: difference of 99 of 100 pixels
    sizes: tuple[tuple[int, int], tuple[int, int]] = SMALL  #: in full, and quick
    fresnel: str = "dielectric"


CASES = {str(i): Case(report_scene(i), most, SIZES.get(i, LARGE)) for i, most in enumerate(MOST)}
CASES["crowded"] = Case(_crowded(12), 1e-5, fresnel="schlick")
CASES["crowded, unrolled"] = Case(_crowded(4), 7e-6, fresnel="schlick")


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
    error = abs(image - truth.image).max(axis=-1)
    off = ~(error <= STEP)
    if not off.any():
        return error, np.full(off.shape, -1)
    steps = [(displacement, 0), (-displacement, 0), (0, displacement), (0, -displacement)]
    moved = [reference_render(scene, displacement=step, **settings) for step in steps]
    silhouette = np.any([other.path != truth.path for other in moved], axis=0)
    shadow = np.any([other.lights != truth.lights for other in moved], axis=0)
    spread = np.max([abs(other.image - truth.image).max(axis=-1) for other in moved], axis=0)
    return error, np.select([~off, silhouette, shadow, error <= spread], [-1, 0, 1, 2], 3)


def draw(
    scene: Scene | int, size: tuple[int, int], *, fresnel: str = "dielectric", **integrator: Any
) -> np.ndarray:
    """Our picture, one sample per pixel, with no path cut short."""
    settings = {"type": "mrt_whitted", "min_contribution": 0.0, **integrator}
    options: Values = {"width": size[0], "height": size[1], "aa": 1, "aamode": "none", "focaldist": 0}
    options = {**options, "fresnel": fresnel, "integrator": settings}
    return mrt.render(scene, **options).image


def hold(study: Study, name: str, error: np.ndarray, reason: np.ndarray) -> Values:
    """Hold a scene that was judged to its bounds; return the figures by name."""
    most = CASES[name].most
    left = np.sum(reason == REASONS.index("unexplained"))
    edges = "rounding sends single pixels to the other side of an edge: measured up to two in ten thousand"
    found = {
        "median difference": (np.median(error), MEDIAN, "least fault: half of the pixels off by 1e-7"),
        "difference of 99 %": (np.quantile(error, 0.99), most, f"least fault: 1 % off by {most:g}"),
        "share of pixels off by > 1/255": (np.mean(error > STEP), SHARE, edges),
        "pixels off without a reason": (left, 0, "reasons are found by rays that are moved"),
    }
    for what, bound in found.items():
        study.at_most(f"scene {name}: {what}", *bound)
    return {what: bound[0] for what, bound in found.items()}


def run(study: Study, *, quick: bool) -> None:
    """Judge our pictures of all scenes, and the places of samples."""
    rows = []
    for name, case in study.each("Scenes in float64", CASES.items()):
        size = case.sizes[quick]
        image = draw(case.scene, size, fresnel=case.fresnel)
        error, reason = judge(image, case.scene, fresnel=case.fresnel)
        found = hold(study, name, error, reason)
        counts = {word: int(np.sum(reason == i)) for i, word in enumerate(REASONS)}
        shown = "{}x{}".format(*size)
        rows.append({"scene": name, "size": shown, **found, "largest": error.max(), **counts})
    note = "One sample per pixel. Fresnel is exact, and Schlick's in the crowds. By reason: pixels off."
    study.records("scenes", "Our pictures against the float64 tracer", rows, note)
    lattices(study)


def lattices(study: Study) -> None:
    """Hold four samples a pixel to those of the tracer, at the places that each lattice says."""
    scene = report_scene(0)
    size: Values = {"width": 80, "height": 60}
    for lattice, places in {"report": (0.0, 0.5), "centered": (-0.25, 0.25)}.items():
        samples = [reference_render(scene, displacement=place, **size) for place in product(places, repeat=2)]
        truth = np.mean([sample.image for sample in samples], axis=0)
        options: Values = {"aa": 2, "aamode": "none", "focaldist": 0, "fresnel": "dielectric"}
        image = mrt.render(scene, **{**options, "lattice": lattice}, **size).image
        error = np.quantile(abs(image - truth).max(axis=-1), 0.99)
        why = "four times what was measured; least fault: samples in other places leave 0.07"
        study.at_most(f"four samples, lattice={lattice}: difference of 99 %", error, 5e-6, why)
