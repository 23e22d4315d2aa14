"""Light paths that are long, bright, dark or start in odd places, against the float64 tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.plugins.microfacet import microfacet_specular, tan2_theta
from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.studies.stability.cases import Cases
from mrt_mitsuba.validation.tools.study import Study

WIDTH, HEIGHT = 64, 48

# Relative to the value, and to 1 where it is smaller: directions are float32, so a highlight of alpha 1e-2
# is known to 2e-3 of its value at its flank, and each of ten mirrors adds its own roundings
TOLERANCE = 1e-2
# Pixels through which an outline or the edge of a shadow passes within the roundings, on average over many
# pictures
SHARE = 0.002
# Pixels where nothing is stiff agree far better; the median is free of edges
MEDIAN = 5e-6

GREY = Material(1.3, 0.1, (0.5, 0.5, 0.5), (0.3, 0.2, 0.1))
MIRROR = Material(1.5, 0.3, (0.95, 0.9, 0.85), (0.2, 0.2, 0.2))
CAMERA = Camera((0.2, 0.5, 3.0), (0.0, 0.4, 0.0))
LIGHTS = (Light((2, 3, 4), (1.0, 0.9, 0.8)), Light((-3, 2, 2), (0.4, 0.5, 0.6)))
FLOOR = Plane((0, 1, 0), 0.0, GREY)
BALL = Sphere((0, 0.5, 0), 0.5, GREY)
BASE = Scene(CAMERA, (0.2, 0.3, 0.4), LIGHTS, (BALL,), (FLOOR,))


@dataclass(frozen=True)
class Path:
    """A scene that is hard on a path tracer; ``settings`` go to both tracers."""

    name: str
    what: str
    scene: Scene
    settings: dict[str, Any] = field(default_factory=dict)
    truth: Scene | None = None  # where the exact picture is defined as that of another scene


def _with_material(**changes: Any) -> Scene:
    return replace(BASE, spheres=(replace(BALL, material=replace(GREY, **changes)),))


def _with_light(position: tuple[float, float, float], color: float = 1.0) -> Scene:
    return replace(BASE, lights=(Light(position, (color,) * 3),))


def _hall(material: Material) -> Scene:
    """Two mirrors face each other, a ball and the camera between them."""
    walls = (Plane((0, 0, 1), 2.0, material), Plane((0, 0, -1), 2.0, material), Plane((0, 1, 0), 1.0, GREY))
    ball = Sphere((0.3, -0.2, -0.5), 0.4, GREY)
    camera = Camera((0.0, 0.1, 1.0), (0.05, 0.0, -2.0))
    return Scene(camera, (0.2, 0.3, 0.4), (Light((0.5, 1.5, 0.3), (1, 1, 1)),), (ball,), walls)


FULL = {"fresnel": "unity"}

# One line for each case
PATHS: Sequence[Path] = (
    Path("facing mirrors", "Ks 0.95, ten bounces", _hall(MIRROR), FULL),
    Path("perfect facing mirrors", "Ks 1, ten bounces", _hall(replace(MIRROR, specular=(1, 1, 1))), FULL),
    Path("facing mirrors, no clamp", "Ks 0.95, clamp off", _hall(MIRROR), {**FULL, "clamp": False}),
    Path(
        "mirrors that add light",
        "Ks 1.5, ten bounces: 58 times",
        _hall(replace(MIRROR, specular=(1.5, 1.4, 1.3))),
        FULL,
    ),
    Path("clamp on", "a light of 1e4", _with_light((2, 3, 4), 1e4)),
    Path("clamp off", "a light of 1e4", _with_light((2, 3, 4), 1e4), {"clamp": False}),
    Path(
        "light inside a ball",
        "nothing of the floor is lit, the ball not from outside",
        _with_light((0, 0.5, 0)),
    ),
    Path("light on the floor", "at height 0", _with_light((1.5, 0.0, 0.5))),
    Path("light on the ball", "its top", _with_light((0.0, 1.0, 0.0))),
    Path("light at 1e6", "parallel light", _with_light((4e5, 6e5, 7e5))),
    Path("light at the camera", "no shadow is seen", _with_light(CAMERA.position)),
    Path("black", "Kd = Ks = 0", _with_material(specular=(0, 0, 0), diffuse=(0, 0, 0))),
    Path(
        "over-bright", "Kd 5, Ks 3", _with_material(specular=(3, 3, 3), diffuse=(5, 5, 5)), {"clamp": False}
    ),
    Path("roughness 0", "acts as 1e-8", _with_material(alpha=0.0), truth=_with_material(alpha=1e-8)),
    Path("roughness 1e-3", "a highlight smaller than a pixel", _with_material(alpha=1e-3)),
    Path("roughness 100", "no lobe left", _with_material(alpha=100.0)),
    Path(
        "negative roughness", "alpha -0.0432, as in scene 2", _with_material(alpha=-0.0432), {"clamp": False}
    ),
    Path("index just above 1", "1 + 1e-7: no reflection", _with_material(ior=1.0000001)),
    Path("index 1e6", "a metal", _with_material(ior=1e6)),
    Path("index 0.95", "total reflection at grazing angles", _with_material(ior=0.95)),
    Path("no lights", "mirrors of the sky", replace(BASE, lights=())),
    Path(
        "inside a ball",
        "camera and lights in it: its back is black",
        replace(BASE, spheres=(Sphere((0, 0, 0), 9.0, GREY),)),
    ),
)


def run(study: Study, *, quick: bool) -> None:
    """Every case against the float64 tracer, sums over bounces in closed form, whole renders."""
    cases = Cases(study, "transport", "Light transport")
    rows = [_case(cases, path) for path in PATHS]
    _bounces(cases, (1, 3, 10) if quick else range(1, 11))
    _scalar_variant(cases)
    _whole_renders(cases, quick=quick)
    cases.close(
        "Shares of pixels that differ from the float64 tracer by more than 1 % of the "
        "value (of 1, where it is less): "
        "outlines and edges of shadows within a rounding of the pixel's centre, and flanks of highlights."
    )
    columns = (
        "case",
        "what",
        "share beyond 1 %",
        "median difference",
        "largest value",
        "not finite",
        "negative",
    )
    study.table("paths", "Pictures of the cases, one ray per pixel", columns, rows)


def _case(cases: Cases, path: Path) -> tuple[Any, ...]:
    settings = {"fresnel": "dielectric", "clamp": True, **path.settings}
    image = _render(path.scene, **settings)
    scene = path.truth or path.scene
    truth = reference_render(scene, width=WIDTH, height=HEIGHT, **settings).image
    difference = np.abs(image - truth) / np.maximum(truth, 1)
    share = float((~(difference.max(axis=-1) <= TOLERANCE)).mean())
    median = float(np.median(difference))
    bad, negative = int((~np.isfinite(image)).sum()), int((image < 0).sum())
    cases.at_most(
        path.name,
        f"{path.what}: share of pixels that differ by more than 1 %",
        "the float64 picture",
        share,
        SHARE,
    )
    cases.at_most(f"{path.name}, median", "difference of all pixels", "a few roundings", median, MEDIAN)
    cases.at_most(f"{path.name}, bad", "values that are not finite, or negative", "none", bad + negative, 0)
    return path.name, path.what, share, median, float(image.max()), bad, negative


def _render(scene: Scene, *, fresnel: str, clamp: bool) -> np.ndarray:
    described = scene.to_dict(width=WIDTH, height=HEIGHT, fresnel=fresnel)
    described["integrator"] = {"type": "mrt_whitted", "clamp": clamp, "min_contribution": 0.0}
    return render(described, aa=1).image


# -------------------------------------------- Bounces in closed form ---------------------------------------


def _bounces(cases: Cases, depths: Sequence[int]) -> None:
    """A ray to and fro between two mirrors: the geometric sum of what both send back."""
    import mitsuba as mi

    for reflectance in (0.5, 0.999, 1.0, 1.5):
        scene = mi.load_dict(_corridor(reflectance))
        for clamp in (True, False):
            truth = np.cumsum(_direct(reflectance, clamp) * reflectance ** np.arange(10))
            found = [_to_and_fro(scene, clamp, depth) for depth in depths]
            cases.at_most(
                f"one to ten bounces, Ks {reflectance:g}, clamp {'on' if clamp else 'off'}",
                "relative error of the light that a ray between facing mirrors collects, "
                "for every number of bounces",
                "the geometric sum, ever growing",
                np.abs(np.array(found) / truth[np.array(depths) - 1] - 1).max(),
                2e-6,  # ten additions and products, and the reflectance itself
            )


def _corridor(reflectance: float) -> dict[str, Any]:
    material = {
        "type": "mrt_bsdf",
        "fresnel": "unity",
        "alpha": 0.5,
        "diffuse_reflectance": 0.25,
        "specular_reflectance": reflectance,
    }
    walls = {
        f"wall_{k}": {"type": "mrt_plane", "normal": [0, 0, k], "distance": 1.0, "bsdf": material}
        for k in (1, -1)
    }
    return {"type": "scene", **walls, "light": {"type": "mrt_light", "position": [1, 0, 0], "intensity": 3.0}}


def _to_and_fro(scene: Any, clamp: bool, depth: int) -> float:
    import mitsuba as mi

    integrator = mi.load_dict(
        {
            "type": "mrt_whitted",
            "clamp": clamp,
            "max_depth": depth,
            "bounce_budget": "plain",
            "min_contribution": 0.0,
        }
    )
    integrator.prepare(scene)
    radiance = integrator.trace(scene, None, mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(0, 0, -1))).radiance
    value = radiance[0]
    return float(value if isinstance(value, float) else value[0])


def _direct(reflectance: float, clamp: bool) -> float:
    """What one wall sends back along its normal, in float64: the light is seen at 45° from both."""
    half = np.sqrt(0.5)
    up, to_light = dr.scalar.Array3f64(0, 0, 1), dr.scalar.Array3f64(half, 0, half)
    lobe = microfacet_specular(up, to_light, tan2_theta(up + to_light), 0.5)
    value = 3.0 * (0.25 / np.pi * half + reflectance * lobe)
    return float(min(value, 1.0) if clamp else value)


def _scalar_variant(cases: Cases) -> None:
    import mitsuba as mi

    before = mi.variant()
    runtime.use(runtime.SLOW)
    try:
        truth = np.cumsum(_direct(0.999, True) * 0.999 ** np.arange(10))
        scene = mi.load_dict(_corridor(0.999))
        found = [_to_and_fro(scene, True, depth) for depth in (1, 2, 10)]
    finally:
        runtime.use(before)
    error = np.abs(np.array(found) / truth[[0, 1, 9]] - 1).max()
    cases.at_most(
        "one, two and ten bounces in scalar_rgb",
        "Ks 0.999, clamp on: relative error",
        "the geometric sum",
        error,
        2e-6,
    )


def _whole_renders(cases: Cases, *, quick: bool) -> None:
    for number in (2, 3) if quick else range(5):
        for fresnel in ("dielectric",) if quick else ("dielectric", "schlick"):
            for clamp in (False,) if quick else (True, False):
                image = _render(report_scene(number), fresnel=fresnel, clamp=clamp)
                bad = int((~(image >= 0) | np.isinf(image)).sum())
                name = f"scene {number}, {fresnel}, clamp {'on' if clamp else 'off'}"
                cases.at_most(name, "values that are not finite, or negative", "none", bad, 0)
