"""Light paths that are long, bright, dark or start in odd places, against the float64 tracer.

Each case comes with a fault, a scene or setting almost like its own. The tracer draws that as well, and it
must exceed the bound of the case by a factor of two: so each states, by measurement, what it can detect.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render, specular_lobe
from mrt_mitsuba.validation.studies.stability.cases import Cases, both_variants
from mrt_mitsuba.validation.tools.scenery import traced
from mrt_mitsuba.validation.tools.study import Study

WIDTH, HEIGHT = 64, 48

# Differences count relative to the value plus a thousandth, and the worst of 95 % of the pixels is held to a
# bound: the others may show outlines and the edges of shadows
SMALL, SHARE = 1e-3, 0.95
# For plain cases: some float32 roundings, three times what was measured
PLAIN = 3e-6
CUT_OFF = 1 / 16 / 255  # the default of ``min_contribution``

GREY = Material(1.3, 0.1, (0.5, 0.5, 0.5), (0.3, 0.2, 0.1))
MIRROR = Material(1.5, 0.3, (0.95, 0.9, 0.85), (0.2, 0.2, 0.2))
CAMERA = Camera((0.2, 0.5, 3.0), (0.0, 0.5, 0.0), hfov=20)  # the ball fills the picture
LIGHTS = (Light((2, 3, 4), (1.0, 0.9, 0.8)), Light((-3, 2, 2), (0.4, 0.5, 0.6)))
FLOOR = Plane((0, 1, 0), 0.0, GREY)
BALL = Sphere((0, 0.5, 0), 0.5, GREY)
BASE = Scene(CAMERA, (0.2, 0.3, 0.4), LIGHTS, (BALL,), (FLOOR,))
# Onto the ball's highlight under a light behind the camera, five thousandths of the ball across
CLOSE = Camera(CAMERA.position, (0.033259, 0.5, 0.498893), hfov=0.1)


@dataclass(frozen=True)
class Path:
    """A scene that is hard on a path tracer, and one that must not pass for it.

    ``settings`` go to both tracers; ``truth`` is given where the exact picture is defined as that of another
    scene.
    """

    name: str
    what: str
    scene: Scene
    fault: Scene | dict[str, Any]
    limit: float = PLAIN
    settings: dict[str, Any] = field(default_factory=dict)
    truth: Scene | None = None


def _ball(**changes: Any) -> Scene:
    return replace(BASE, spheres=(replace(BALL, material=replace(GREY, **changes)),))


def _shiny(**changes: Any) -> Scene:
    """Return a material without a diffuse part, which would hide the lobe."""
    return replace(_ball(diffuse=(0, 0, 0), specular=(1, 1, 1), **changes), sky=(0, 0, 0))


def _highlight(alpha: float) -> Scene:
    behind = Light((0.4, 0.5, 6.0), (1e-4, 1e-4, 1e-4))  # dim: the highlight is bright
    return replace(_shiny(alpha=alpha), camera=CLOSE, lights=(behind,))


def _flat(alpha: float) -> Scene:
    return replace(_shiny(alpha=alpha), lights=(Light((2, 3, 4), (1e6,) * 3),))


def _lit(position: tuple[float, float, float], color: float = 1.0) -> Scene:
    return replace(BASE, lights=(Light(position, (color,) * 3),))


def _under(outwards: float) -> Scene:
    """A light on the lower side of the ball, or so many radii outside, and the floor that it lights."""
    x, y, z = ((1 + outwards) * 0.5 * c for c in (0.26726124, -0.53452248, 0.80178373))
    return replace(_lit((x, 0.5 + y, z)), camera=Camera((1.5, 1.5, 3.0), (0.3, 0.0, 0.6)))


def _hall(specular: float, light: float = 1.0, ior: float = 1.5) -> Scene:
    """Return two mirrors that face each other, with a ball and the camera between them."""
    material = replace(MIRROR, ior=ior, specular=(specular, 0.95 * specular, 0.9 * specular))
    walls = (Plane((0, 0, 1), 2.0, material), Plane((0, 0, -1), 2.0, material), Plane((0, 1, 0), 1.0, GREY))
    ball, lamp = Sphere((0.3, -0.2, -0.5), 0.4, GREY), Light((0.5, 1.5, 0.3), (light,) * 3)
    return Scene(Camera((0.0, 0.1, 1.0), (0.05, 0.0, -2.0)), (0.2, 0.3, 0.4), (lamp,), (ball,), walls)


FORMS = ("dielectric", "schlick")
FULL, OPEN = {"fresnel": "unity"}, {"clamp": False}

# One line for each case
PATHS: Sequence[Path] = (
    Path("facing mirrors", "Ks 0.95, ten bounces", _hall(0.95), _hall(0.9499), 2e-5, FULL),
    Path("perfect facing mirrors", "Ks 1, ten bounces", _hall(1), {"max_depth": 9}, 2e-5, FULL),
    Path("facing mirrors, no clamp", "Ks 0.95", _hall(0.95), _hall(0.95, 1.001), 2e-5, {**FULL, **OPEN}),
    Path("mirrors that add light", "Ks 1.5: 58 times", _hall(1.5), _hall(1.501), 2e-5, FULL),
    Path("bounce budget", "index 0.57: a bounce costs five of ten", _hall(0.95, ior=0.57),
         {"max_depth": 11}, 2e-5, FULL),
    Path("clamp on", "a light of 1e4", _lit((2, 3, 4), 1e4), OPEN),
    Path("clamp off", "a light of 1e4", _lit((2, 3, 4), 1e4), _lit((2, 3, 4), 10001), PLAIN, OPEN),
    Path("light inside a ball", "not lit from outside", _lit((0, 0.5, 0)), _lit((0, 0.8, 0.6))),
    Path("light on the floor", "at height 0", _lit((1.5, 0, 0.5)), _lit((1.5, 0.001, 0.5)), 5e-6),
    Path("light on the ball", "its top", _lit((0, 1, 0)), _lit((0, 1.01, 0)), 5e-6),
    Path("light under the ball", "on its lower side", _under(0), _under(1e-3), 5e-6, truth=_under(1e-6)),
    Path("light at 1e6", "parallel light", _lit((4e5, 6e5, 7e5)), _lit((4.001e5, 6e5, 7e5))),
    Path("light at the camera", "no shadow", _lit(CAMERA.position), _lit((0.2, 0.501, 3))),
    Path("black", "Kd = Ks = 0", _ball(specular=(0,) * 3, diffuse=(0,) * 3),
         _ball(specular=(1e-3,) * 3), 3e-7),
    Path("over-bright", "Kd 5, Ks 3", _ball(specular=(3,) * 3, diffuse=(5,) * 3),
         _ball(specular=(3,) * 3, diffuse=(5.001,) * 3), PLAIN, OPEN),
    Path("diffuse", "Kd 0.3, 0.2, 0.1", BASE, _ball(diffuse=(0.3001, 0.2, 0.1))),
    Path("roughness 0", "acts as 1e-8", _highlight(0.0), _highlight(1e-3), 1e-9, truth=_highlight(1e-8)),
    Path("roughness 1e-3", "its highlight from near by", _highlight(1e-3), _highlight(1.001e-3), 3e-4, OPEN),
    Path("roughness 100", "a lobe of 1e-5", _flat(100.0), _flat(99.0), PLAIN, OPEN),
    Path("negative roughness", "alpha -0.4", _shiny(alpha=-0.4), _shiny(alpha=0.4), 5e-6, OPEN),
    Path("index just above 1", "1 + 1e-7", _shiny(ior=1.0000001), _shiny(ior=1.005), 3e-7),
    Path("index 1e6", "a metal", _shiny(ior=1e6), _shiny(ior=1e4), 1e-5),
    Path("index 0.95", "total reflection at grazing angles", _shiny(ior=0.95), _shiny(ior=0.9501), 5e-6),
    Path("no lights", "mirrors of the sky", replace(BASE, lights=()),
         replace(BASE, lights=(), sky=(0.2001, 0.3, 0.4))),
    Path("inside a ball", "camera and lights in it: its back is black",
         replace(BASE, spheres=(Sphere((0, 0, 0), 9.0, GREY),)), replace(BASE, spheres=())),
)  # fmt: skip


def run(study: Study, *, quick: bool) -> None:
    """Check every case against the float64 tracer, sums over bounces in closed form, whole renders."""
    cases = Cases(study, "transport", "Light transport")
    for path in PATHS:
        _path(cases, path)
    _cut_offs(cases)
    for suffix in both_variants():
        for reflectance, clamp in product((0.999,) if suffix else (0.5, 0.999, 1.0, 1.5), (True, False)):
            name = f"one to ten bounces, Ks {reflectance:g}, clamp {'on' if clamp else 'off'}{suffix}"
            what = "relative error of the light of a ray between facing mirrors, for every number of bounces"
            error = _to_and_fro(reflectance, clamp, (1, 3, 10) if quick else range(1, 11))
            # ten additions and products, and the reflectance itself
            cases.at_most(name, what, "the geometric sum, ever growing", error, 2e-6)
    every = (2, 3) if quick else range(5), FORMS[: 1 if quick else 2], (False,) if quick else (True, False)
    for number, fresnel, clamp in product(*every):
        bad = not_a_colour(_render(report_scene(number), fresnel=fresnel, clamp=clamp))
        name = f"scene {number}, {fresnel}, clamp {'on' if clamp else 'off'}"
        cases.at_most(name, "values that are not finite, or negative", "none", bad, 0)
    cases.close(
        "Differences to the float64 tracer, relative to the value plus a thousandth, of 95 % of the pixels."
    )


def _path(cases: Cases, path: Path) -> None:
    settings = {"fresnel": "dielectric", "clamp": True, **path.settings}
    image = _render(path.scene, **settings)
    right = path.truth or path.scene
    truth = reference_render(right, width=WIDTH, height=HEIGHT, **settings).image
    scene, changed = (path.scene, path.fault) if isinstance(path.fault, dict) else (path.fault, {})
    wrong = reference_render(scene, width=WIDTH, height=HEIGHT, **{**settings, **changed}).image
    if isinstance(path.fault, dict):
        alike = ", ".join(f"{name} = {value}" for name, value in path.fault.items())
    else:
        had, has = dict(_numbers(right)), dict(_numbers(scene))
        alike = "; ".join(
            f"{n} {has.get(n)} for {had.get(n)}" for n in {**had, **has} if had.get(n) != has.get(n)
        )
    what = f"{path.what}: difference of 95 % of the pixels"
    fault = (alike, _difference(wrong, truth))
    cases.at_most(path.name, what, "roundings", _difference(image, truth), path.limit, fault=fault)
    what = "values that are not finite, or negative"
    cases.at_most(f"{path.name}, bad", what, "none", not_a_colour(image), 0)


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the parts of a scene by their names, such as ``spheres[0].material.alpha``."""
    if is_dataclass(value):
        for f in fields(value):
            yield from _numbers(getattr(value, f.name), f"{name}.{f.name}".strip("."))
    elif isinstance(value, tuple) and value and is_dataclass(value[0]):
        for k, entry in enumerate(value):
            yield from _numbers(entry, f"{name}[{k}]")
    else:
        yield name, value


def _difference(image: np.ndarray, truth: np.ndarray) -> float:
    """Return the largest difference in a channel that 95 % of the pixels stay below."""
    relative = (np.abs(image - truth) / (truth + SMALL)).max(axis=-1)
    return float(np.quantile(np.nan_to_num(relative, nan=np.inf), SHARE))


def not_a_colour(image: np.ndarray) -> int:
    """Return how many values are not finite, or negative."""
    return int((~(image >= 0) | np.isinf(image)).sum())


def _render(scene: Scene, *, fresnel: str, clamp: bool, least: float = 0.0) -> np.ndarray:
    described = scene.to_dict(width=WIDTH, height=HEIGHT, fresnel=fresnel)
    described["integrator"] = {"type": "mrt_whitted", "clamp": clamp, "min_contribution": least}
    return render(described, aa=1, lattice="report").image


def _cut_offs(cases: Cases) -> None:
    """What cutting dim paths changes where something very bright may end them."""
    glass = Material(1.5, 0.1, (0.2, 0.2, 0.2), (0.1, 0.1, 0.1))
    pair = Sphere((-0.51, 0.5, 0), 0.5, glass), Sphere((0.51, 0.5, 0), 0.5, glass)
    balls = replace(BASE, camera=Camera((0.2, 1.0, 4.0), (0.0, 0.5, 0.0)), spheres=pair, planes=())
    bright = (
        ("a sky of 1000", replace(balls, sky=(1000, 1000, 1000)), True),
        ("a light of 1e4", replace(balls, lights=(Light((2, 3, 4), (1e4, 1e4, 1e4)),)), False),
    )
    for name, scene, clamp in bright:
        whole, cut, more = (
            _render(scene, fresnel="dielectric", clamp=clamp, least=least)
            for least in (0.0, CUT_OFF, 1e3 * CUT_OFF)
        )
        what = f"largest change by it{'' if clamp else ', without clamp'}"
        expected, change = "a sixteenth of an 8-bit step, as promised", np.abs(cut - whole).max()
        fault = ("paths cut at 1000 times as much", np.abs(more - whole).max())
        cases.at_most(f"cut-off under {name}", what, expected, change, CUT_OFF, fault=fault)


def _to_and_fro(reflectance: float, clamp: bool, depths: Sequence[int]) -> float:
    """Return the error of a ray between two mirrors, at some depths, to the sum of what both send back."""
    form = {"type": "mrt_bsdf", "fresnel": "unity", "alpha": 0.5, "diffuse_reflectance": 0.25}
    wall = {"type": "mrt_plane", "distance": 1.0, "bsdf": {**form, "specular_reflectance": reflectance}}
    walls = {f"wall_{k}": {**wall, "normal": [0, 0, k]} for k in (1, -1)}
    light = {"type": "mrt_light", "position": [1, 0, 0], "intensity": 3.0}
    scene = mi.load_dict({"type": "scene", **walls, "light": light})
    # what one wall sends back along its normal: the light is seen at 45° from both
    half = np.sqrt(0.5)
    with np.errstate(divide="ignore"):
        up, to_light = np.array([[0, 0, 1.0]]), np.array([[half, 0, half]])
        lobe = specular_lobe(up, to_light, up, np.array([0.5]))[0]
    direct = 3.0 * half * (0.25 / np.pi + reflectance * lobe)
    truth = np.cumsum((min(direct, 1.0) if clamp else direct) * reflectance ** np.arange(10))
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(0, 0, -1))
    settings: dict[str, Any] = {"clamp": clamp, "bounce_budget": "plain", "min_contribution": 0.0}
    errors = []
    for depth in depths:
        value = traced(scene, ray, max_depth=depth, **settings).radiance[0]
        errors.append(abs(float(np.ravel(value)[0]) / float(truth[depth - 1]) - 1))
    return max(errors)
