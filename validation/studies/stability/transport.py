"""Light paths that are long, bright, dark or start in odd places, against the float64 tracer.

Each case comes with a fault, a scene or setting almost like its own. The tracer draws that as well, and it
must exceed the bound of the case by a factor of two: so each states, by measurement, what it can detect.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.validation.oracles.reference import reference_render

WIDTH, HEIGHT = 64, 48

# Differences count relative to the value plus a thousandth, and the worst of 95 % of the pixels is held to a
# bound: the others may show outlines and the edges of shadows
SMALL, SHARE = 1e-3, 0.95
# For plain cases: some float32 roundings, three times what was measured
PLAIN = 3e-6

GREY = Material(1.3, 0.1, (0.5, 0.5, 0.5), (0.3, 0.2, 0.1))
MIRROR = Material(1.5, 0.3, (0.95, 0.9, 0.85), (0.2, 0.2, 0.2))
CAMERA = Camera((0.2, 0.5, 3.0), (0.0, 0.5, 0.0), hfov=20)  # the ball fills the picture
LIGHTS = (Light((2, 3, 4), (1.0, 0.9, 0.8)), Light((-3, 2, 2), (0.4, 0.5, 0.6)))
FLOOR = Plane((0, 1, 0), 0.0, GREY)
BALL = Sphere((0, 0.5, 0), 0.5, GREY)
BASE = Scene(CAMERA, (0.2, 0.3, 0.4), LIGHTS, (BALL,), (FLOOR,))
# Onto the ball's highlight under a light behind the camera, five thousandths of the ball across
CLOSE = Camera(CAMERA.position, (0.033259, 0.5, 0.498893), hfov=0.1)


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


FULL, OPEN = {"fresnel": "unity"}, {"clamp": False}

# Of each case its name, what it is, a scene that is hard on a path tracer, and one, or settings, that must
# not pass for it; the limit, settings of both tracers, and the scene whose exact picture it is
PATHS: Sequence[tuple[Any, ...]] = (
    ("facing mirrors", "Ks 0.95, ten bounces", _hall(0.95), _hall(0.9499), 2e-5, FULL),
    ("perfect facing mirrors", "Ks 1, ten bounces", _hall(1), {"max_depth": 9}, 2e-5, FULL),
    ("facing mirrors, no clamp", "Ks 0.95", _hall(0.95), _hall(0.95, 1.001), 2e-5, {**FULL, **OPEN}),
    ("mirrors that add light", "Ks 1.5: 58 times", _hall(1.5), _hall(1.501), 2e-5, FULL),
    ("bounce budget", "index 0.57: a bounce costs five of ten", _hall(0.95, ior=0.57),
         {"max_depth": 11}, 2e-5, FULL),
    ("clamp on", "a light of 1e4", _lit((2, 3, 4), 1e4), OPEN),
    ("clamp off", "a light of 1e4", _lit((2, 3, 4), 1e4), _lit((2, 3, 4), 10001), PLAIN, OPEN),
    ("light inside a ball", "not lit from outside", _lit((0, 0.5, 0)), _lit((0, 0.8, 0.6))),
    ("light on the floor", "at height 0", _lit((1.5, 0, 0.5)), _lit((1.5, 0.001, 0.5)), 5e-6),
    ("light on the ball", "its top", _lit((0, 1, 0)), _lit((0, 1.01, 0)), 5e-6),
    ("light under the ball", "on its lower side", _under(0), _under(1e-3), 5e-6, {}, _under(1e-6)),
    ("light at 1e6", "parallel light", _lit((4e5, 6e5, 7e5)), _lit((4.001e5, 6e5, 7e5))),
    ("light at the camera", "no shadow", _lit(CAMERA.position), _lit((0.2, 0.501, 3))),
    ("black", "Kd = Ks = 0", _ball(specular=(0,) * 3, diffuse=(0,) * 3),
         _ball(specular=(1e-3,) * 3), 3e-7),
    ("over-bright", "Kd 5, Ks 3", _ball(specular=(3,) * 3, diffuse=(5,) * 3),
         _ball(specular=(3,) * 3, diffuse=(5.001,) * 3), PLAIN, OPEN),
    ("diffuse", "Kd 0.3, 0.2, 0.1", BASE, _ball(diffuse=(0.3001, 0.2, 0.1))),
    ("roughness 0", "acts as 1e-8", _highlight(0.0), _highlight(1e-3), 1e-9, {}, _highlight(1e-8)),
    ("roughness 1e-3", "its highlight from near by", _highlight(1e-3), _highlight(1.001e-3), 3e-4, OPEN),
    ("roughness 100", "a lobe of 1e-5", _flat(100.0), _flat(99.0), PLAIN, OPEN),
    ("negative roughness", "alpha -0.4", _shiny(alpha=-0.4), _shiny(alpha=0.4), 5e-6, OPEN),
    ("index just above 1", "1 + 1e-7", _shiny(ior=1.0000001), _shiny(ior=1.005), 3e-7),
    ("index 1e6", "a metal", _shiny(ior=1e6), _shiny(ior=1e4), 1e-5),
    ("index 0.95", "total reflection at grazing angles", _shiny(ior=0.95), _shiny(ior=0.9501), 5e-6),
    ("no lights", "mirrors of the sky", replace(BASE, lights=()),
         replace(BASE, lights=(), sky=(0.2001, 0.3, 0.4))),
    ("inside a ball", "camera and lights in it: its back is black",
         replace(BASE, spheres=(Sphere((0, 0, 0), 9.0, GREY),)), replace(BASE, spheres=())),
)  # fmt: skip


NOTE = "Differences to the float64 tracer, relative to the value plus a thousandth, of 95 % of the pixels."


def cases(quick: bool) -> Iterator[tuple[Any, ...]]:
    """Yield every case, held to the float64 tracer, and its fault, which must exceed twice its limit."""
    for name, what, scene, fault, *more in PATHS:
        others: list[Any] = [PLAIN, {}, scene]
        limit, own, other = more + others[len(more) :]
        settings: dict[str, Any] = {"fresnel": "dielectric", "clamp": True, **own}
        described = scene.to_dict(width=WIDTH, height=HEIGHT, fresnel=settings["fresnel"])
        described["integrator"] = {"type": "mrt_whitted", "clamp": settings["clamp"], "min_contribution": 0.0}
        image = render(described, aa=1, lattice="report").image
        changed, setting = (scene, fault) if isinstance(fault, dict) else (fault, {})
        truth, wrong = (
            reference_render(drawn, width=WIDTH, height=HEIGHT, **options).image
            for drawn, options in ((other, settings), (changed, settings | setting))
        )
        yield name, what, "roundings", difference(image, truth), limit
        what = "a scene or setting almost the same"
        yield f"{name}, its fault", what, "must be seen", difference(wrong, truth), 2 * limit, False


def difference(image: np.ndarray, truth: np.ndarray) -> float:
    """Return the largest difference in a channel that 95 % of the pixels stay below; inf for bad values."""
    if not (np.isfinite(image) & (image >= 0)).all():
        return np.inf
    return float(np.quantile((np.abs(image - truth) / (truth + SMALL)).max(axis=-1), SHARE))
