"""Parts of the scenes that studies render: cameras, other materials; nine whole scenes; kinds of noise.

The whole ones use Mitsuba's own lights, lenses, materials, filters and samplers, as users' scenes do.
"""

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
SPP = 64  # of the samplers of ``SCENES``


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
    up: Sequence[float] = (0, 1, 0),
    film: Node | None = None,
    **more: Any,
) -> Node:
    """Return a camera with a film and a sampler."""
    common = {"type": "hdrfilm", "rfilter": {"type": rfilter}, "component_format": "float32"}
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": _to().look_at(origin, target, up),
        "film": common | (film or {}),
        "sampler": {"type": sampler, "sample_count": SPP},
        **more,
    }


def ball_scene(bsdf: Node, *, size: int) -> mi.Scene:
    """Return a ball of the material on a floor under a sky and a point light, ``size`` × ¾ ``size``."""
    film = {"width": size, "height": size * 3 // 4, "pixel_format": "rgb"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5},
            "sensor": sensor([0, -4, 1.6], [0, 0, 0.6], "box", up=[0, 0, 1], fov=32, film=film),
            "ball": _ball([0, 0, 0.7], 0.7, dict(bsdf)),
            "sky": _sky((0.3, 0.4, 0.6)),
            "lamp": {"type": "point", "position": [1.5, -2, 3], "intensity": rgb((12, 10, 8))},
            "floor": _rectangle(_to().scale(4), bsdf=_diffuse((0.5, 0.4, 0.3))),
        }
    )


# ----------------------------------------------- Whole scenes -----------------------------------------------


def load(
    name: str, width: int, height: int, *, film: Node | None = None, sampler: str = "", **more: Any
) -> mi.Scene:
    """Return a scene by name, at a size; ``film``, ``sampler`` and further nodes replace its own."""
    nodes = SCENES[name]()
    if sampler:
        nodes["sensor"]["sampler"]["type"] = sampler
    size = {"width": width, "height": height}
    if name == "crop":
        window = {"crop_offset_x": width // 4, "crop_offset_y": height // 4}
        window |= {f"crop_{side}": pixels for side, pixels in size.items()}
        size = {side: 3 * pixels // 2 for side, pixels in size.items()} | window
    nodes["sensor"] |= {"film": size | nodes["sensor"]["film"] | (film or {})}
    path = {"type": "path", "max_depth": 4}
    return mi.load_dict({"type": "scene", "integrator": path, **nodes} | more)


def _to() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def _checks(count: int) -> Node:
    """Return a diffuse chessboard."""
    squares = _to().scale([count, count, 1])
    board = {"type": "checkerboard", "to_uv": squares, "color0": rgb(0.1), "color1": rgb(0.9)}
    return {"type": "diffuse", "reflectance": board}


def _diffuse(color: Color) -> Node:
    return {"type": "diffuse", "reflectance": rgb(color)}


def _rectangle(place: mi.ScalarTransform4f, **more: Node) -> Node:
    return {"type": "rectangle", "to_world": place, **more}


def _floor(bsdf: Node) -> Node:
    return _rectangle(_to().rotate([1, 0, 0], -90).scale(10), bsdf=bsdf)


def _chessboard(count: int) -> Node:
    return _floor(_checks(count))


def _ball(center: Point, radius: float, bsdf: Node) -> Node:
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def _box() -> Node:
    return {"type": "cube", "to_world": _to().translate([0, 0.5, 0]).rotate([0, 1, 0], 30).scale(0.5)}


def _lamp(center: Point, radius: float, radiance: float) -> Node:
    emitter = {"type": "area", "radiance": rgb(radiance)}
    return {"type": "sphere", "center": center, "radius": radius, "emitter": emitter}


def _spot(intensity: Color) -> Node:
    place = _to().look_at([2, 4, 2], [0, 0, 0], [0, 1, 0])
    return {"type": "spot", "intensity": rgb(intensity), "cutoff_angle": 25, "to_world": place}


def _sky(color: Color) -> Node:
    return {"type": "constant", "radiance": rgb(color)}


SCENES: dict[str, Callable[[], Node]] = {}  # by the name of the function: the sensor and what it sees


def scene(nodes: Callable[[], Node]) -> Callable[[], Node]:
    """Add a function to ``SCENES``."""
    SCENES[nodes.__name__] = nodes
    return nodes


@scene
def thin_lens() -> Node:
    lens: Node = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 6.0}
    return dict(
        sensor=sensor([0, 1.5, 6], [0, 0.6, 0], **lens),
        floor=_chessboard(20),
        near=_ball([-1, 0.5, 3], 0.5, _diffuse((0.7, 0.2, 0.2))),
        far=_ball([1, 0.5, -2], 0.5, _diffuse((0.2, 0.2, 0.7))),
        sky=_sky((0.6, 0.7, 0.9)),
    )


@scene
def gloss() -> Node:
    return dict(
        sensor=sensor([0, 1.5, 5], [0, 0.7, 0], "box"),
        floor=_floor({"type": "roughconductor", "alpha": 0.1}),
        ball=_ball([0, 0.7, 0], 0.7, {"type": "roughplastic", "alpha": 0.1}),
        sky=_sky(0.2),
        lamp=_lamp([1.2, 3, -1], 0.1, 200),
    )


@scene
def area_light() -> Node:
    above = _to().translate([0, 4, 0]).rotate([1, 0, 0], 90)
    behind = _to().translate([0, 2, -2]).scale(4)
    return dict(
        sensor=sensor([0, 1.5, 6], [0, 1, 0], "mitchell"),
        floor=_floor(_diffuse((0.8, 0.4, 0.3))),
        wall=_rectangle(behind, bsdf=_diffuse(0.5)),
        box=_box(),
        light=_rectangle(above, emitter={"type": "area", "radiance": rgb(6)}),
    )


@scene
def spot() -> Node:
    return dict(
        sensor=sensor([0, 3, 6], [0, 0.5, 0], "tent"),
        floor=_floor(_diffuse(0.7)),
        box={"type": "cube", "to_world": _to().translate([0, 0.5, 0]).scale(0.5)},
        light=_spot((40, 36, 30)),
    )


@scene
def crop() -> Node:
    return dict(
        sensor=sensor([0, 2, 6], [0, 0.5, 0], film={"sample_border": True}),
        floor=_chessboard(8),
        ball=_ball([0, 1, 0], 1, {"type": "plastic"}),
        lamp=_lamp([2, 4, 2], 0.5, 15),
    )


@scene
def texture_and_sky() -> Node:
    return dict(
        sensor=sensor([0, 1.5, 6], [0, 2.5, 0], fov=60),
        floor=_chessboard(30),
        ball=_ball([-1, 0.6, 1], 0.6, _checks(12)),
        sky=_sky((0.5, 0.7, 1.0)),
    )


@scene
def stratified() -> Node:
    return dict(
        sensor=sensor([0, 2, 6], [0, 0.5, 0], "box", sampler="stratified"),
        floor=_chessboard(8),
        box=_box(),
        lamp=_lamp([0, 4, 1], 1.0, 5),
    )


# --------------------------------------------- Kinds of noise ----------------------------------------------


KINDS = ("calm", "texture", "lights", "gloss", "glass", "spot", "fog", "crop")


def load_room(
    size: int,
    *,
    sampler: str = "independent",
    rfilter: str = "box",
    bsdf: Node | None = None,
    radius: float = 0.8,
    **others: Node,
) -> mi.Scene:
    """Return a ball on a floor under a lamp and a faint sky; ``others`` add nodes or replace these.

    ``bsdf``: of the ball, matte by default; ``radius``: of the lamp, whose power does not depend on it.
    """
    view: Node = {"film": {"width": size, "height": size}}
    if "medium" in others:
        view["medium"] = others.pop("medium")
    nodes = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": sensor([0, 2, 5], [0, 0.6, 0], rfilter, sampler, **view),
        "floor": _floor(_diffuse(0.5)),
        "ball": _ball([0, 0.9, 0], 0.8, bsdf or _diffuse(0.5)),
        "lamp": _lamp([1.5, 4, 1], radius, 4 / radius**2),
        "sky": _sky(0.05),
    }
    return mi.load_dict(nodes | others)


def load_kind(kind: str, size: int, sampler: str = "multijitter", rfilter: str = "box") -> mi.Scene:
    """Return a room with one of the ``KINDS`` of noise; "crop" is the scene, with a filter of its own."""
    if kind == "crop":
        return load(kind, size, size, sampler=sampler)
    places = np.random.default_rng(1).uniform([-3, 1, -3], [3, 3, 3], (30, 3)).tolist()
    inside = {"type": "ref", "id": "fog"}
    kinds: dict[str, Node] = {
        "calm": {},
        "texture": {"floor": _chessboard(100)},
        "lights": {f"lamp{k}": _lamp(place, 0.05, 40) for k, place in enumerate(places)},
        "gloss": {
            "floor": _floor({"type": "roughconductor", "alpha": 0.1}),
            "bsdf": {"type": "roughplastic", "alpha": 0.1},
        },
        "glass": {"bsdf": {"type": "dielectric"}},
        "spot": {"lamp": _spot(40)},
        "fog": {
            "integrator": {"type": "volpath", "max_depth": 5},
            "fog": {"type": "homogeneous", "id": "fog", "sigma_t": 0.15, "albedo": 0.8},
            "around": {"type": "sphere", "radius": 30, "bsdf": {"type": "null"}, "interior": inside},
            "medium": inside,
        },
    }
    path: Node = {"integrator": {"type": "path", "max_depth": 5}}
    return load_room(size, sampler=sampler, rfilter=rfilter, **path | kinds[kind])
