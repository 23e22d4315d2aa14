"""Random scenes, and random edits of them by every door; run as a program, pictures of scenes made anew.

A story is a scene and its edits, all drawn from one number. ``live`` tells it to one loaded scene, which is
rendered after each edit; ``anew`` makes a scene for each picture, edits it as often and renders it once.
"""

from __future__ import annotations

import random
import re
import sys
from collections.abc import Callable, Iterator
from inspect import CO_GENERATOR
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from nodes import group, mesh, rgb, sensor

import mrt_mitsuba as mrt  # before mitsuba: it chooses the LLVM library
from mrt_mitsuba.mitsuba_changes import rewriting_later

EDITS = 6  # of each scene
# Keys that shape the film, that hold an address of memory, or that edits may not take to any value
LEFT_ALONE = re.compile(
    "film|sampler|clip|shutter|principal|count|texcoords|sampling_weight|medium|object_|thread"
)

Edit = tuple[str, Any]


def _color(rng: random.Random) -> dict[str, Any]:
    return rgb(*(round(rng.uniform(0.1, 0.9), 2) for _ in range(3)))


def _picture() -> mi.Bitmap:
    return mi.Bitmap(np.linspace(0.1, 0.9, 12, dtype=np.float32).reshape(2, 2, 3))


def _material(rng: random.Random) -> dict[str, Any]:
    """Return a material of ours or of Mitsuba's; edits change its numbers."""
    if rng.random() < 0.6:
        textured = {"type": "mrt_texture", "bitmap": _picture()}
        return {
            "type": "mrt_bsdf",
            "int_ior": rng.choice([0.5, 1.3, 2.0]),
            "fresnel": rng.choice(["schlick", "dielectric", "unity"]),
            "diffuse_reflectance": rng.choice([_color(rng), textured]),
            "specular_reflectance": rng.choice([_color(rng), 0.0]),
        }
    matte = {"type": "diffuse"}
    texture = {"type": "bitmap", "bitmap": _picture(), "raw": True}
    stock = [{"type": name} for name in ("conductor", "dielectric", "roughconductor", "principled")]
    stock += [{"type": "diffuse", "reflectance": _color(rng)}, {"type": "roughplastic"}]
    stock += [{"type": "diffuse", "reflectance": texture}, {"type": "twosided", "in": {"type": "plastic"}}]
    stock += [{"type": "blendbsdf", "weight": 0.4, "a": matte, "b": {"type": "conductor"}}]
    stock += [{"type": "mask", "opacity": 0.6, "in": matte}]
    stock += [{"type": "bumpmap", "bump": texture, "in": matte}]
    stock += [{"type": "normalmap", "normalmap": texture, "in": matte}]
    return rng.choice(stock)


def _place(rng: random.Random) -> Any:
    at = [rng.uniform(-1.2, 1.2) for _ in range(3)]
    turned = mi.ScalarTransform4f().translate(at).rotate([0.6, 0, 0.8], rng.uniform(0, 360))
    return turned.scale(rng.uniform(0.3, 0.8))


CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (-1, 0, 1)]
CONES = [(0, 1, 0, 0, 0, 0, 0.5), (1, 1, 0, 1, 0, 1, 0.3), (-1, 0, 1, -1, 1, 0, 0.4)]


def _shape(rng: random.Random) -> dict[str, Any]:
    distance = np.linalg.norm(np.indices((6, 6, 6)) - 2.5, axis=0)[..., None] / 5 - 0.3
    shapes = [
        {"type": name} for name in ("sphere", "sphere", "sphere", "cube", "rectangle", "disk", "cylinder")
    ]
    shapes += [{"type": "sdfgrid", "grid": mi.TensorXf(distance.astype(np.float32))}]
    shapes += [{"type": "mrt_cone", "apex": [0, 1, 0], "base_center": [0, 0, 0], "radius": 0.5}]
    shapes += [{"type": "mrt_cylinder", "p0": [0, 1, 0], "p1": [0, 0, 0], "radius": 0.5}]
    shapes += [mesh(CORNERS, [(0, 1, 2), (3, 4, 5), (0, 2, 4)]), group(CONES, kind="cone")]
    return {**rng.choice(shapes), "to_world": _place(rng)}


def scene_of(rng: random.Random) -> dict[str, Any]:
    """Return a scene, and draw from ``rng`` what it is made of."""
    view = sensor([0, 1.5, 5], [0, 0, 0], (16, 12))
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted", "max_depth": rng.choice([1, 10]), "clamp": rng.random() < 0.5},
        "camera": view,
        "lamp": {"type": "mrt_light", "position": [2, 4, 3], "intensity": _color(rng)},
    }
    materials = [f"m{i}" for i in range(rng.randint(1, 3))]
    for name in materials:
        scene[name] = {**_material(rng), "id": name}
    for i in range(rng.randint(1, 5)):
        scene[f"s{i}"] = {**_shape(rng), "bsdf": {"type": "ref", "id": rng.choice(materials)}}
    if rng.random() < 0.7:
        plane = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0}
        scene["floor"] = {**plane, "bsdf": {"type": "ref", "id": rng.choice(materials)}}
    if rng.random() < 0.3:
        ball = {"type": "sphere", "radius": 0.4, "bsdf": _material(rng)}
        scene["family"] = {"type": "shapegroup", "ball": ball}
        scene["child"] = {"type": "instance", "to_world": _place(rng), "of": {"type": "ref", "id": "family"}}
    beam = {"to_world": view["to_world"]}
    lights: list[dict[str, Any]] = [{"type": "point", "position": [-2, 3, 2]}, {"type": "spot", **beam}]
    lights += [{"type": "directional", "direction": [0, -1, -0.3], "irradiance": _color(rng)}]
    lights += [{"type": "projector", "irradiance": {"type": "bitmap", "bitmap": _picture()}, **beam}]
    lights += [{"type": "sphere", "center": [0, 3, 0], "radius": 0.2, "emitter": {"type": "area"}}]
    lights += [rng.choice([{"type": "constant"}, {"type": "envmap", "bitmap": _picture()}])]
    return scene | {f"l{i}": light for i, light in enumerate(rng.sample(lights, rng.randint(0, 2)))}


def _changed(value: Any, rng: random.Random) -> Any:
    """Return another value of a parameter."""
    if isinstance(value, float):
        return value * rng.uniform(0.6, 1.4)
    if hasattr(value, "translate"):
        axes = 2 if "3f" in type(value).__name__ else 3
        return value @ type(value)().translate([rng.uniform(-0.3, 0.3) for _ in range(axes)])
    numbers = np.array(value)
    if numbers.dtype == np.uint32:  # faces: other corners, the other way round
        return type(value)(np.roll(numbers.reshape(-1, 3), 1, axis=0)[:, ::-1].ravel())
    factors = np.reshape([rng.uniform(0.6, 1.4) for _ in range(numbers.size)], numbers.shape)
    return type(value)(np.ascontiguousarray(numbers * factors.astype(np.float32), np.float32))


KINDS = ["update", "update", "update", "twice", "share", "interrupt", "switch", "other"]


def edit(scene: mi.Scene, kind: str, number: float) -> None:
    """Change a scene by one of its parameters, or give a shape the material of another."""
    rng = random.Random(number)
    shapes = sorted((s for s in scene.shapes() if s.bsdf() is not None), key=lambda s: s.id())
    if kind == "share" and len(shapes) > 1:
        one, other = rng.sample(shapes, 2)
        one.set_bsdf(other.bsdf())
        return
    params = mi.traverse(scene)
    keys = sorted(k for k in params.keys() if not LEFT_ALONE.search(k))  # noqa: SIM118

    def movable(value: Any) -> bool:
        array = dr.is_array_v(value) and dr.width(value)
        return isinstance(value, float) or bool(array) or hasattr(value, "translate")

    key = rng.choice([k for k in keys if movable(params[k])])
    for _ in range(2 if kind == "twice" else 1):
        params[key] = _changed(params[key], rng)
        params.update()


def stories(first: int, count: int) -> Iterator[tuple[int, dict[str, Any], list[Edit]]]:
    """Yield numbers, scenes and edits: a kind, and a number from which the rest is drawn."""
    for number in range(first, first + count):
        rng = random.Random(number)
        yield number, scene_of(rng), [(rng.choice(KINDS), rng.random()) for _ in range(EDITS)]


def drawn(scene: Any, integrator: Any = None) -> np.ndarray:
    """Return the picture of a scene."""
    return np.array(mrt.render(scene, aa=1, aamode="none", integrator=integrator).image)


def _interrupted(run: Callable[[], object], calls: int) -> None:
    """Run something, and interrupt it as Ctrl-C does, after so many calls of Python functions."""
    left = calls

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal left
        # Python ignores what is raised while it closes a generator
        ours = "mrt_mitsuba" in frame.f_globals.get("__name__", "")
        left -= event == "call" and ours and not frame.f_code.co_flags & CO_GENERATOR
        if left == 0:
            sys.setprofile(None)
            raise KeyboardInterrupt

    sys.setprofile(count)
    try:
        run()
    except (KeyboardInterrupt, RuntimeError) as error:  # which Mitsuba's loader makes of it
        if "KeyboardInterrupt" not in repr(error):
            raise
    finally:
        sys.setprofile(None)


def live(content: dict[str, Any], edits: list[Edit]) -> Iterator[np.ndarray]:
    """Yield pictures of one scene after each edit; another scene of its objects is rendered in between."""
    scene = mi.load_dict(content)
    yield drawn(scene)
    for kind, number in edits:
        edit(scene, kind, number)
        if kind == "interrupt":
            _interrupted(lambda: drawn(scene), int(1 + number * 300))
        if kind == "switch":
            mi.set_variant("scalar_rgb")
            with rewriting_later():
                mi.set_variant("llvm_ad_rgb")
        if kind == "other":  # a scene of the same objects, under the same integrator
            things = [scene.integrator(), *scene.sensors(), *scene.shapes()[:-1]]
            few = [t for t in things if t.class_name() != "Instance" and not getattr(t, "is_emitter", bool)()]
            drawn(mi.load_dict({"type": "scene", **{t.id(): t for t in few}}))
        yield drawn(scene)


def anew(content: dict[str, Any], edits: list[Edit]) -> Iterator[np.ndarray]:
    """Yield the same pictures, each of a scene made for it."""
    for done in range(len(edits) + 1):
        scene = mi.load_dict(content)
        for kind, number in edits[:done]:
            edit(scene, kind, number)
        yield drawn(scene)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    mrt.register()
    first = int(sys.argv[1])
    count = int(sys.argv[2])
    path = sys.argv[3]
    np.savez(path, **{str(n): list(anew(content, edits)) for n, content, edits in stories(first, count)})
