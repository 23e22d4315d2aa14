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


def _texture(rng: random.Random, kind: str) -> dict[str, Any]:
    texels = np.array([rng.uniform(0.1, 0.9) for _ in range(12)], np.float32).reshape(2, 2, 3)
    return {"type": kind, "bitmap": mi.Bitmap(texels), **({"raw": True} if kind == "bitmap" else {})}


def _material(rng: random.Random) -> dict[str, Any]:
    ours: dict[str, Any] = {"type": "mrt_bsdf", "alpha": rng.uniform(0.05, 0.5)}
    ours["int_ior"] = rng.choice([0.5, 1.3, 2.0])
    ours["fresnel"] = rng.choice(["schlick", "dielectric", "unity"])
    ours["diffuse_reflectance"] = rng.choice([_color(rng), _texture(rng, "mrt_texture")])
    ours["specular_reflectance"] = rng.choice([_color(rng), 0.0])
    matte = {"type": "diffuse"}
    metal = {"type": "conductor"}
    stock: list[dict[str, Any]] = []
    stock += [{"type": "diffuse", "reflectance": rng.choice([_color(rng), _texture(rng, "bitmap")])}]
    stock += [{"type": "roughconductor", "alpha": rng.uniform(0.1, 0.5)}]
    stock += [{"type": "twosided", "nested": {"type": "plastic", "diffuse_reflectance": _color(rng)}}]
    stock += [metal, {"type": "roughplastic", "alpha": rng.uniform(0.1, 0.5)}]
    stock += [{"type": "principled", "roughness": rng.uniform(0.2, 0.8), "metallic": rng.uniform(0, 1)}]
    stock += [{"type": "blendbsdf", "weight": rng.uniform(0, 1), "a": matte, "b": metal}]
    stock += [{"type": "mask", "opacity": rng.uniform(0, 1), "nested": matte}]
    stock += [{"type": "bumpmap", "bump": _texture(rng, "bitmap"), "nested": matte}]
    stock += [{"type": "normalmap", "normalmap": _texture(rng, "bitmap"), "nested": matte}]
    stock += [{"type": "dielectric"}]
    return ours if rng.random() < 0.6 else rng.choice(stock)


def _place(rng: random.Random) -> Any:
    at = [rng.uniform(-1.2, 1.2) for _ in range(3)]
    turned = mi.ScalarTransform4f().translate(at).rotate([0.6, 0, 0.8], rng.uniform(0, 360))
    return turned.scale(rng.uniform(0.3, 0.8))


SHAPES = ["cube", "rectangle", "disk", "cylinder", "sdfgrid", "mrt_cone", "mrt_cylinder", "mrt_mesh", "group"]


def _shape(rng: random.Random) -> dict[str, Any]:
    kind = rng.choice([*["sphere"] * 3, *SHAPES])
    if kind == "mrt_mesh":
        points = [[rng.uniform(-1, 1) for _ in range(3)] for _ in range(6)]
        return mesh(points, [(0, 1, 2), (3, 4, 5), (0, 2, 4)])
    if kind == "group":
        return group([[rng.uniform(0.1, 1) for _ in range(7)] for _ in range(3)], kind="cone")
    form: dict[str, Any] = {}
    if kind in ("mrt_cone", "mrt_cylinder"):
        ends = {"mrt_cone": ("apex", "base_center"), "mrt_cylinder": ("p0", "p1")}[kind]
        form = {ends[0]: [0, 1, 0], ends[1]: [0, 0, 0], "radius": 0.5, "segments": 16}
    if kind == "sdfgrid":
        distance = np.linalg.norm(np.indices((6, 6, 6)) - 2.5, axis=0)
        grid = distance[..., None] / 5 - rng.uniform(0.2, 0.4)
        form = {"grid": mi.TensorXf(grid.astype(np.float32))}
    return {"type": kind, **form, "to_world": _place(rng)}


def scene_of(rng: random.Random) -> dict[str, Any]:
    """Return a scene, and draw from ``rng`` what it is made of."""
    view = sensor([0, 1.5, 5], [0, 0, 0], (16, 12))
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted", "max_depth": rng.choice([1, 10]), "clamp": rng.random() < 0.5},
        "camera": view,
        "lamp": {"type": "mrt_light", "position": [2, 4, 3], "intensity": _color(rng)},
    }
    for i in range(rng.randint(1, 3)):
        scene[f"m{i}"] = {**_material(rng), "id": f"m{i}"}
    materials = [name for name in scene if name.startswith("m")]
    for i in range(rng.randint(1, 5)):
        scene[f"s{i}"] = {**_shape(rng), "bsdf": {"type": "ref", "id": rng.choice(materials)}}
    if rng.random() < 0.7:
        plane = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0}
        scene["floor"] = {**plane, "bsdf": {"type": "ref", "id": rng.choice(materials)}}
    if rng.random() < 0.3:
        ball = {"type": "sphere", "radius": 0.4, "bsdf": _material(rng)}
        scene["family"] = {"type": "shapegroup", "ball": ball}
        scene["child"] = {"type": "instance", "to_world": _place(rng), "of": {"type": "ref", "id": "family"}}
    sky = {"type": "constant", "radiance": _color(rng)}
    if rng.random() < 0.5:
        sky = {"type": "envmap", "bitmap": _texture(rng, "bitmap")["bitmap"]}
    more: list[dict[str, Any]] = []
    more += [{"type": "point", "position": [-2, 3, 2], "intensity": _color(rng)}]
    more += [{"type": "directional", "direction": [0, -1, -0.3], "irradiance": _color(rng)}]
    more += [{"type": "spot", "to_world": view["to_world"], "intensity": _color(rng)}]
    more += [{"type": "projector", "to_world": view["to_world"], "irradiance": _texture(rng, "bitmap")}, sky]
    glow = {"type": "area", "radiance": _color(rng)}
    more += [{"type": "sphere", "center": [0, 3, 0], "radius": 0.2, "emitter": glow}]
    scene |= {f"l{i}": light for i, light in enumerate(rng.sample(more, rng.randint(0, 2)))}
    return scene


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
    except KeyboardInterrupt:
        pass
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
