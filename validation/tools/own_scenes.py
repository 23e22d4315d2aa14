"""Ten scenes of Mitsuba's own making, such as people bring: lights, lenses, materials, filters, samplers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

Node = dict[str, Any]
SPP = 64  # of their samplers
# Where most of the noise is in a part of the picture
LOCAL = ("thin_lens", "gloss", "texture_and_sky", "rough_glass")


def load(name: str, width: int, height: int, *, film: Node | None = None, **more: Any) -> Any:
    """Return a scene by name, at a size; ``film`` and further nodes replace its own."""
    nodes = SCENES[name]()
    size: Node = {"width": width, "height": height}
    if name == "crop":
        window = {"crop_offset_x": width // 4, "crop_offset_y": height // 4}
        size = {"width": 3 * width // 2, "height": 3 * height // 2, "crop_width": width} | window
        size["crop_height"] = height
    nodes["sensor"] |= {"film": size | nodes["sensor"]["film"] | (film or {})}
    path = {"type": "path", "max_depth": 4}
    return mi.load_dict({"type": "scene", "integrator": path, **nodes} | more)


def sensor(origin: list[float], target: list[float], rfilter: str = "gaussian", **more: Any) -> Node:
    """Return a camera with a film."""
    film = {"type": "hdrfilm", "rfilter": {"type": rfilter}, "component_format": "float32"}
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
        "film": film | more.pop("film", {}),
        "sampler": {"type": more.pop("sampler", "independent"), "sample_count": SPP},
    } | more


def _to() -> Any:
    return mi.ScalarTransform4f()


def _rgb(*values: float) -> Node:
    return {"type": "rgb", "value": list(values) if len(values) == 3 else values[0]}


def _checks(count: int) -> Node:
    colors = {"color0": _rgb(0.1), "color1": _rgb(0.9)}
    return {"type": "checkerboard", "to_uv": _to().scale([count, count, 1]), **colors}


def _diffuse(reflectance: Any) -> Node:
    return {"type": "diffuse", "reflectance": reflectance}


def _rectangle(place: Any, **more: Node) -> Node:
    return {"type": "rectangle", "to_world": place, **more}


def _floor(bsdf: Node) -> Node:
    return _rectangle(_to().rotate([1, 0, 0], -90).scale(10), bsdf=bsdf)


def _ball(center: list[float], radius: float, bsdf: Node) -> Node:
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def _box() -> Node:
    return {"type": "cube", "to_world": _to().translate([0, 0.5, 0]).rotate([0, 1, 0], 30).scale(0.5)}


def _lamp(center: list[float], radius: float, radiance: float) -> Node:
    emitter = {"type": "area", "radiance": _rgb(radiance)}
    return {"type": "sphere", "center": center, "radius": radius, "emitter": emitter}


def _sky(*color: float) -> Node:
    return {"type": "constant", "radiance": _rgb(*color)}


def _sun() -> np.ndarray:
    """Return an environment with a bright place."""
    pixels = np.full((16, 32, 3), 0.4, np.float32)
    pixels[3:5, 10:12] = 30
    return pixels


MEMBER = {"type": "instance", "g": {"type": "ref", "id": "group"}}

SCENES: dict[str, Callable[[], Node]] = {
    "envmap": lambda: {
        "sensor": sensor([0, 2, 6], [0, 0.5, 0]),
        "around": {"type": "envmap", "bitmap": mi.Bitmap(_sun())},
        "floor": _floor(_diffuse(_rgb(0.6))),
        "ball": _ball([0, 1, 0], 1, {"type": "roughconductor", "alpha": 0.2}),
    },
    "instances": lambda: {
        "sensor": sensor([0, 3, 6], [0, 0.5, 0], "box"),
        "group": {"type": "shapegroup", "a": _ball([0, 0, 0], 0.4, _diffuse(_rgb(0.7)))},
        **{f"at{i}": MEMBER | {"to_world": _to().translate([i % 3 - 1, 0.4, i // 3 - 1])} for i in range(9)},
        "floor": _floor(_diffuse(_checks(8))),
        "sky": _sky(0.3, 0.4, 0.5),
        "lamp": _lamp([3, 5, 3], 0.7, 20),
    },
    "thin_lens": lambda: {
        "sensor": sensor([0, 1.5, 6], [0, 0.6, 0], type="thinlens", aperture_radius=0.2, focus_distance=6.0),
        "floor": _floor(_diffuse(_checks(20))),
        "near": _ball([-1, 0.5, 3], 0.5, _diffuse(_rgb(0.7, 0.2, 0.2))),
        "far": _ball([1, 0.5, -2], 0.5, _diffuse(_rgb(0.2, 0.2, 0.7))),
        "sky": _sky(0.6, 0.7, 0.9),
    },
    "gloss": lambda: {
        "sensor": sensor([0, 1.5, 5], [0, 0.7, 0], "box"),
        "floor": _floor({"type": "roughconductor", "alpha": 0.1}),
        "ball": _ball([0, 0.7, 0], 0.7, {"type": "roughplastic", "alpha": 0.1}),
        "sky": _sky(0.2),
        "lamp": _lamp([1.2, 3, -1], 0.1, 200),
    },
    "rough_glass": lambda: {
        "sensor": sensor([0, 1.2, 5], [0, 0.8, 0]),
        "floor": _floor(_diffuse(_checks(8))),
        "ball": _ball([0, 0.9, 0], 0.8, {"type": "roughdielectric", "alpha": 0.3}),
        "lamp": _lamp([0, 4, 0], 1.0, 6),
        "sky": _sky(0.2),
    },
    "area_light": lambda: {
        "sensor": sensor([0, 1.5, 6], [0, 1, 0], "mitchell"),
        "floor": _floor(_diffuse(_rgb(0.8, 0.4, 0.3))),
        "wall": _rectangle(_to().translate([0, 2, -2]).scale(4), bsdf=_diffuse(_rgb(0.5))),
        "box": _box(),
        "light": _rectangle(
            _to().translate([0, 4, 0]).rotate([1, 0, 0], 90), emitter={"type": "area", "radiance": _rgb(6)}
        ),
    },
    "spot": lambda: {
        "sensor": sensor([0, 3, 6], [0, 0.5, 0], "tent"),
        "floor": _floor(_diffuse(_rgb(0.7))),
        "box": {"type": "cube", "to_world": _to().translate([0, 0.5, 0]).scale(0.5)},
        "light": {
            "type": "spot",
            "intensity": _rgb(40, 36, 30),
            "cutoff_angle": 25,
            "to_world": _to().look_at([2, 4, 2], [0, 0, 0], [0, 1, 0]),
        },
    },
    "crop": lambda: {
        "sensor": sensor([0, 2, 6], [0, 0.5, 0], film={"sample_border": True}),
        "floor": _floor(_diffuse(_checks(8))),
        "ball": _ball([0, 1, 0], 1, {"type": "plastic"}),
        "lamp": _lamp([2, 4, 2], 0.5, 15),
    },
    "texture_and_sky": lambda: {
        "sensor": sensor([0, 1.5, 6], [0, 2.5, 0], fov=60),
        "floor": _floor(_diffuse(_checks(30))),
        "ball": _ball([-1, 0.6, 1], 0.6, _diffuse(_checks(12))),
        "sky": _sky(0.5, 0.7, 1.0),
    },
    "stratified": lambda: {
        "sensor": sensor([0, 2, 6], [0, 0.5, 0], "box", sampler="stratified"),
        "floor": _floor(_diffuse(_checks(8))),
        "box": _box(),
        "lamp": _lamp([0, 4, 1], 1.0, 5),
    },
}
