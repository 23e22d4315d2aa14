"""Light paths that are long, bright, dark or start in odd places, against the float64 tracer.

Each case comes with a fault, a scene or setting almost like its own. The tracer draws that as well, and it
must exceed the bound of the case by a factor of two: so each states, by measurement, what it can detect.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.studies.stability.case import Case
from mrt_mitsuba.validation.study import Values

WIDTH = 64
HEIGHT = 48

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
# Onto the ball's highlight under a light behind the camera, five thousandths of the ball across
CLOSE = Camera(CAMERA.position, (0.033259, 0.5, 0.498893), hfov=0.1)


def _ball(**changes: Any) -> Scene:
    return replace(BASE, spheres=(replace(BALL, material=replace(GREY, **changes)),))


def _shiny(**changes: Any) -> Scene:
    """A material without a diffuse part, which would hide the lobe."""
    return replace(_ball(diffuse=(0, 0, 0), specular=(1, 1, 1), **changes), sky=(0, 0, 0))


def _highlight(alpha: float) -> Scene:
    behind = Light((0.4, 0.5, 6.0), (1e-4, 1e-4, 1e-4))  # dim: the highlight is bright
    return replace(_shiny(alpha=alpha), camera=CLOSE, lights=(behind,))


def _flat(alpha: float) -> Scene:
    return replace(_shiny(alpha=alpha), lights=(Light((2, 3, 4), (1e6,) * 3),))


def _lit(position: tuple[float, float, float], color: float = 1.0) -> Scene:
    return replace(BASE, lights=(Light(position, (color,) * 3),))


def _under(outwards: float) -> Scene:
    """A light on the lower side of the ball, or ``outwards`` radii off it, and the floor that it lights."""
    x, y, z = ((1 + outwards) * 0.5 * c for c in (0.26726124, -0.53452248, 0.80178373))
    return replace(_lit((x, 0.5 + y, z)), camera=Camera((1.5, 1.5, 3.0), (0.3, 0.0, 0.6)))


def _hall(specular: float, light: float = 1.0, ior: float = 1.5) -> Scene:
    """Two mirrors that face each other, with a ball and the camera between them."""
    material = replace(MIRROR, ior=ior, specular=(specular, 0.95 * specular, 0.9 * specular))
    walls = (Plane((0, 0, 1), 2.0, material), Plane((0, 0, -1), 2.0, material), Plane((0, 1, 0), 1.0, GREY))
    ball = Sphere((0.3, -0.2, -0.5), 0.4, GREY)
    lamp = Light((0.5, 1.5, 0.3), (light,) * 3)
    return Scene(Camera((0.0, 0.1, 1.0), (0.05, 0.0, -2.0)), (0.2, 0.3, 0.4), (lamp,), (ball,), walls)


FULL: Values = {"fresnel": "unity"}
OPEN = {"clamp": False}


@dataclass(frozen=True)
class Path:
    """A scene that is hard on a path tracer, and one, or settings, that must not pass for it."""

    name: str
    what: str
    scene: Scene
    fault: Scene | Values
    limit: float = PLAIN
    settings: Values = field(default_factory=dict)  #: of both tracers
    exact: Scene | None = None  #: the scene whose exact picture it is, if not this one

    @property
    def chosen(self) -> Values:
        """The settings of both tracers, with what they are by default."""
        return {"fresnel": "dielectric", "clamp": True, **self.settings}

    def truth(self, scene: Scene, **settings: Any) -> np.ndarray:
        """The picture [H, W, 3] of a scene by the float64 tracer, with other settings than its own."""
        return reference_render(scene, width=WIDTH, height=HEIGHT, **self.chosen | settings).image

    def rendered(self) -> np.ndarray:
        """Our picture [H, W, 3]."""
        nodes = self.scene.to_dict(width=WIDTH, height=HEIGHT, fresnel=self.chosen["fresnel"])
        clamp = self.chosen["clamp"]
        nodes["integrator"] = {"type": "mrt_whitted", "clamp": clamp, "min_contribution": 0.0}
        return render(nodes, aa=1, lattice="report").image


def mirrors() -> Iterator[Path]:
    """Yield paths between mirrors that face each other."""
    hall = _hall(0.95)
    bright = _hall(1.5)
    yield Path("facing mirrors", "Ks 0.95, ten bounces", hall, _hall(0.9499), 2e-5, FULL)
    yield Path("perfect facing mirrors", "Ks 1, ten bounces", _hall(1), {"max_depth": 9}, 2e-5, FULL)
    yield Path("facing mirrors, no clamp", "Ks 0.95", hall, _hall(0.95, 1.001), 2e-5, FULL | OPEN)
    yield Path("mirrors that add light", "Ks 1.5: 58 times", bright, _hall(1.501), 2e-5, FULL)
    costly = _hall(0.95, ior=0.57)
    yield Path(
        "bounce budget", "index 0.57: a bounce costs five of ten", costly, {"max_depth": 11}, 2e-5, FULL
    )


def lights() -> Iterator[Path]:
    """Yield lights that are bright, or in odd places."""
    bright = _lit((2, 3, 4), 1e4)
    yield Path("clamp on", "a light of 1e4", bright, OPEN)
    yield Path("clamp off", "a light of 1e4", bright, _lit((2, 3, 4), 10001), PLAIN, OPEN)
    yield Path("light inside a ball", "not lit from outside", _lit((0, 0.5, 0)), _lit((0, 0.8, 0.6)))
    yield Path("light on the floor", "at height 0", _lit((1.5, 0, 0.5)), _lit((1.5, 0.001, 0.5)), 5e-6)
    yield Path("light on the ball", "its top", _lit((0, 1, 0)), _lit((0, 1.01, 0)), 5e-6)
    yield Path("light under the ball", "on its lower side", _under(0), _under(1e-3), 5e-6, {}, _under(1e-6))
    yield Path("light at 1e6", "parallel light", _lit((4e5, 6e5, 7e5)), _lit((4.001e5, 6e5, 7e5)))
    yield Path("light at the camera", "no shadow", _lit(CAMERA.position), _lit((0.2, 0.501, 3)))
    dark = replace(BASE, lights=())
    yield Path("no lights", "mirrors of the sky", dark, replace(dark, sky=(0.2001, 0.3, 0.4)))
    around = replace(BASE, spheres=(Sphere((0, 0, 0), 9.0, GREY),))
    what = "camera and lights in it: its back is black"
    yield Path("inside a ball", what, around, replace(BASE, spheres=()))


def materials() -> Iterator[Path]:
    """Yield materials that are black, bright, smooth, rough or of odd indices."""
    black = _ball(specular=(0,) * 3, diffuse=(0,) * 3)
    yield Path("black", "Kd = Ks = 0", black, _ball(specular=(1e-3,) * 3), 3e-7)
    over = {"specular": (3,) * 3}
    fault = _ball(**over, diffuse=(5.001,) * 3)
    yield Path("over-bright", "Kd 5, Ks 3", _ball(**over, diffuse=(5,) * 3), fault, PLAIN, OPEN)
    yield Path("diffuse", "Kd 0.3, 0.2, 0.1", BASE, _ball(diffuse=(0.3001, 0.2, 0.1)))
    least = _highlight(1e-8)
    yield Path("roughness 0", "acts as 1e-8", _highlight(0.0), _highlight(1e-3), 1e-9, {}, least)
    near = "its highlight from near by"
    yield Path("roughness 1e-3", near, _highlight(1e-3), _highlight(1.001e-3), 3e-4, OPEN)
    yield Path("roughness 100", "a lobe of 1e-5", _flat(100.0), _flat(99.0), PLAIN, OPEN)
    yield Path("negative roughness", "alpha -0.4", _shiny(alpha=-0.4), _shiny(alpha=0.4), 5e-6, OPEN)
    yield Path("index just above 1", "1 + 1e-7", _shiny(ior=1.0000001), _shiny(ior=1.005), 3e-7)
    yield Path("index 1e6", "a metal", _shiny(ior=1e6), _shiny(ior=1e4), 1e-5)
    grazing = "total reflection at grazing angles"
    yield Path("index 0.95", grazing, _shiny(ior=0.95), _shiny(ior=0.9501), 5e-6)


NOTE = "Differences to the float64 tracer, relative to the value plus a thousandth, of 95 % of the pixels."


def cases(quick: bool) -> Iterator[Case]:
    """Yield every case, held to the float64 tracer, and its fault, which must exceed twice its limit."""
    for path in (*mirrors(), *lights(), *materials()):
        truth = path.truth(path.exact or path.scene)
        if isinstance(path.fault, Scene):
            wrong = path.truth(path.fault)
        else:
            wrong = path.truth(path.scene, **path.fault)
        yield Case(path.name, path.what, "roundings", difference(path.rendered(), truth), path.limit)
        what = "a scene or setting almost the same"
        seen = difference(wrong, truth)
        yield Case(f"{path.name}, its fault", what, "must be seen", seen, 2 * path.limit, False)


def difference(image: np.ndarray, truth: np.ndarray) -> float:
    """The largest difference in a channel that 95 % of the pixels stay below; inf for bad values."""
    if not (np.isfinite(image) & (image >= 0)).all():
        return np.inf
    return float(np.quantile((abs(image - truth) / (truth + SMALL)).max(axis=-1), SHARE))
