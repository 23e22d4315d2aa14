"""Scenes that studies render, with the lights, materials, filters and samplers that users have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.scene.model import Material, Scene
from mrt_mitsuba.validation.bsdf_probe import rgb

Node = dict[str, Any]
Point = list[float]
Color = float | tuple[float, float, float]

# One ray at a time through the pixel's centre, as the report's lattice has it
AT_CENTRES: Node = {"aa": 1, "aamode": "none", "lattice": "report"}
SPP = 64  # of the samplers


def with_materials(scene: Scene, change: Callable[[Material], Material]) -> Scene:
    """Return a scene whose spheres and planes have other materials."""

    def changed(things: Sequence[Any]) -> Any:
        return tuple(replace(thing, material=change(thing.material)) for thing in things)

    return replace(scene, spheres=changed(scene.spheres), planes=changed(scene.planes))


def sensor(
    origin: Point,
    target: Point,
    rfilter: str = "gaussian",
    sampler: str = "independent",
    *,
    film: Node | None = None,
    **more: Any,
) -> Node:
    """Return a camera with a film and a sampler."""
    common = {"type": "hdrfilm", "rfilter": {"type": rfilter}, "component_format": "float32"}
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": _to().look_at(origin, target, [0, 1, 0]),
        "film": common | (film or {}),
        "sampler": {"type": sampler, "sample_count": SPP},
        **more,
    }


def _to() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def _diffuse(color: Color) -> Node:
    return {"type": "diffuse", "reflectance": rgb(color)}


def _floor(bsdf: Node) -> Node:
    return {"type": "rectangle", "to_world": _to().rotate([1, 0, 0], -90).scale(10), "bsdf": bsdf}


def _chessboard(count: int) -> Node:
    squares = _to().scale([count, count, 1])
    board = {"type": "checkerboard", "to_uv": squares, "color0": rgb(0.1), "color1": rgb(0.9)}
    return _floor({"type": "diffuse", "reflectance": board})


def _lamp(center: Point, radius: float, radiance: float) -> Node:
    emitter = {"type": "area", "radiance": rgb(radiance)}
    return {"type": "sphere", "center": center, "radius": radius, "emitter": emitter}


KINDS = ("calm", "texture", "lights", "gloss", "glass", "spot", "fog", "crop")


def load_room(
    width: int,
    height: int = 0,
    *,
    sampler: str = "independent",
    rfilter: str = "box",
    film: Node | None = None,
    bsdf: Node | None = None,
    radius: float = 0.8,
    view: Node | None = None,
    **others: Node,
) -> mi.Scene:
    """Return a ball on a floor under a lamp and a faint sky; ``others`` add nodes or replace these.

    ``bsdf``: of the ball, matte by default; ``radius``: of the lamp, whose power does not depend on it;
    ``film`` and ``view``: more parameters of the film and the camera.
    """
    size = {"width": width, "height": height or width}
    nodes = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": sensor([0, 2, 5], [0, 0.6, 0], rfilter, sampler, film=size | (film or {}), **view or {}),
        "floor": _floor(_diffuse(0.5)),
        "ball": {"type": "sphere", "center": [0, 0.9, 0], "radius": 0.8, "bsdf": bsdf or _diffuse(0.5)},
        "lamp": _lamp([1.5, 4, 1], radius, 4 / radius**2),
        "sky": {"type": "constant", "radiance": rgb(0.05)},
    }
    return mi.load_dict(nodes | others)


def load_kind(
    kind: str, width: int, sampler: str = "multijitter", rfilter: str = "box", *, height: int = 0, **more: Any
) -> mi.Scene:
    """Return a room with one of the ``KINDS`` of noise; ``more`` as for ``load_room``.

    "crop" shows the middle of a film whose filter reaches beyond it.
    """
    height = height or width
    places = np.random.default_rng(1).uniform([-3, 1, -3], [3, 3, 3], (30, 3)).tolist()
    inside = {"type": "ref", "id": "fog"}
    above = _to().look_at([2, 4, 2], [0, 0, 0], [0, 1, 0])
    window: Node = {"crop_offset_x": width // 4, "crop_offset_y": height // 4}
    window |= {"crop_width": width, "crop_height": height, "sample_border": True}
    window |= {"width": 3 * width // 2, "height": 3 * height // 2, "rfilter": {"type": "gaussian"}}
    kinds: dict[str, Node] = {
        "calm": {},
        "texture": {"floor": _chessboard(100)},
        "lights": {f"lamp{k}": _lamp(place, 0.05, 40) for k, place in enumerate(places)},
        "gloss": {
            "floor": _floor({"type": "roughconductor", "alpha": 0.1}),
            "bsdf": {"type": "roughplastic", "alpha": 0.1},
        },
        "glass": {"bsdf": {"type": "dielectric"}},
        "spot": {"lamp": {"type": "spot", "intensity": rgb(40), "cutoff_angle": 25, "to_world": above}},
        "fog": {
            "integrator": {"type": "volpath", "max_depth": 5},
            "fog": {"type": "homogeneous", "id": "fog", "sigma_t": 0.15, "albedo": 0.8},
            "around": {"type": "sphere", "radius": 30, "bsdf": {"type": "null"}, "interior": inside},
            "view": {"medium": inside},
        },
        "crop": {"floor": _chessboard(8), "bsdf": {"type": "plastic"}, "film": window},
    }
    path: Node = {"integrator": {"type": "path", "max_depth": 5}}
    return load_room(width, height, sampler=sampler, rfilter=rfilter, **path | kinds[kind] | more)
