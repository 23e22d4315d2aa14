"""Seconds of renders, printed as JSON: ``python renders.py CASE ...``.

A script that uses only public names, so that it can measure earlier versions of the project, too: the bench
runs it with the Python of either version, in turns.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import mrt_mitsuba as mrt

# isort: split
import mitsuba as mi  # after ours, which finds LLVM for it

Nodes = dict[str, Any]

SMALL: Nodes = {"width": 64, "height": 48}
ONE_RAY: Nodes = {"aamode": "none", "aa": 1, "lattice": "report", "focaldist": 0}
SUPERSAMPLED: Nodes = ONE_RAY | {"aa": 4}

Render = Callable[..., Any]


# ----------------------------------------- Scenes of many objects -----------------------------------------


def load(nodes: Nodes) -> mi.Scene:
    """A Mitsuba scene of a dict with our plugins."""
    mrt.register()
    return mi.load_dict(nodes)


def with_lights(number: int, **size: Any) -> Nodes:
    """Scene 4 with its light from points above, each of its own brightness."""
    nodes = mrt.scene_dict(4, **size)
    places = np.outer(np.arange(number), (0.754877666, 0.569840296, 0.362378)) % 1  # evenly in the room
    for i, (a, b, c) in enumerate(places.tolist()):  # also in the places of its own three
        light = {"type": "mrt_light", "position": [10 * a, 4 + 16 * b, 10 * c]}
        nodes[f"light_{i}"] = light | {"intensity": {"type": "rgb", "value": 6 / number * (0.5 + a)}}
    return nodes


def with_triangles(number: int, **size: Any) -> Nodes:
    """Hills under the camera and the lights of scene 0."""
    cells = max(1, round((number / 2) ** 0.5))
    z, x = np.mgrid[-3 : 3 : (cells + 1) * 1j, -3 : 3 : (cells + 1) * 1j]
    positions = np.stack([x, 0.2 * np.sin(5 * x) * np.cos(7 * z), z], axis=-1).reshape(1, -1, 3)
    row = cells + 1  # vertices of a row
    corners = (np.arange(cells)[:, None] * row + np.arange(cells)).reshape(-1, 1, 1)
    faces = np.add(corners, [[0, row, 1], [1, row, row + 1]]).reshape(1, -1, 3)
    nodes = mrt.scene_dict(0, **size)
    nodes["plane_0"] = {
        "type": "mrt_mesh",
        "positions": mi.Bitmap(np.ascontiguousarray(positions, np.float32)),
        "faces": mi.Bitmap(faces.astype(np.uint32)),
        "bsdf": {"type": "ref", "id": "material_4"},
    }
    return nodes


def crowd(number: int, kind: str, **size: Any) -> Nodes:
    """The room of scene 4 with this many spheres, or cones of the same sizes in random directions.

    With the kind "group", the spheres are a single shape.
    """
    nodes = {name: node for name, node in mrt.scene_dict(4, **size).items() if not name.startswith("sphere")}
    bsdf = {"type": "ref", "id": "material_0"}
    rng = np.random.default_rng(5)
    centers = rng.uniform((1, 0, 1), (7.5, 6.5, 7.5), (number, 3))
    radii = rng.uniform(0.05, 0.25, number)
    if kind == "group":
        numbers = mi.Bitmap(np.column_stack([centers, radii]).astype(np.float32))
        return nodes | {"crowd": {"type": "mrt_group", "kind": "sphere", "numbers": numbers, "bsdf": bsdf}}
    half = rng.normal(size=(number, 3))
    half *= (radii / np.linalg.norm(half, axis=1))[:, None]
    for i, (center, radius, up) in enumerate(zip(centers, radii.tolist(), half, strict=True)):
        ball = {"type": "sphere", "center": center.tolist()}
        cone = {"type": "mrt_cone", "apex": (center + up).tolist(), "base_center": (center - up).tolist()}
        nodes[f"{kind}_{i}"] = {**(cone if kind == "cone" else ball), "radius": radius, "bsdf": bsdf}
    return nodes


# ------------------------------------------------- Cases -------------------------------------------------


def of_scene(nodes: Callable[..., Nodes], size: tuple[int, int], options: Nodes) -> Render:
    """A render of a scene that is loaded once."""
    return partial(mrt.render, load(nodes(width=size[0], height=size[1])), **options)


def _small() -> mi.Scene:
    return load(mrt.scene_dict(3, **SMALL))


def _with_update() -> Render:
    """A render of a loaded scene that changes a colour first."""
    scene = _small()
    parameters = mi.traverse(scene)
    key = next(name for name in list(parameters.keys()) if name.endswith("diffuse_reflectance.value"))

    def render() -> Any:
        parameters[key] = mi.Color3f(time.perf_counter() % 1, 0.2, 0.1)  # another each time
        parameters.update()
        return mrt.render(scene, **ONE_RAY)

    return render


def _prepared() -> Render:
    return mrt.prepare(_small(), **ONE_RAY)


def by_mitsuba(nodes: Nodes, spp: int, integrator: Nodes | None = None) -> Render:
    """Mitsuba's own way to a picture, by the scene's integrator or another one."""
    scene = load(nodes)
    chosen = mi.load_dict(integrator) if integrator else scene.integrator()

    def render() -> np.ndarray:
        return np.array(mi.render(scene, integrator=chosen, spp=spp))

    return render


def _box(width: int, height: int) -> Nodes:
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": width, "height": height, "rfilter": {"type": "box"}}
    return box


PATH: Nodes = {"integrator": "path"}
NOISE: Nodes = {"aamode": "noise", "spp": 64}
BLURRED: Nodes = {"lattice": "report", "focaldist": 2.0}
Make = Callable[[], Render]
CASES: dict[str, tuple[int, Make]] = {}  # how many renders to average, what makes them


def _report(number: int, size: tuple[int, int], options: Nodes) -> Make:
    return partial(of_scene, partial(mrt.scene_dict, number), size, options)


for number in range(5):
    CASES[f"scene {number}"] = (1, _report(number, (800, 600), SUPERSAMPLED))

TRIANGLES = partial(with_triangles, 10**6)
CASES["a million triangles"] = (2, partial(of_scene, TRIANGLES, (400, 300), SUPERSAMPLED))
CASES["200 lights"] = (2, partial(of_scene, partial(with_lights, 200), (160, 120), ONE_RAY))
CONES = partial(crowd, 1000, "cone")
CASES["a thousand cones"] = (2, partial(of_scene, CONES, (400, 300), SUPERSAMPLED))
CASES["to an error"] = (1, partial(of_scene, _box, (96, 96), PATH | {"target": 0.02}))
CASES["aamode=noise"] = (1, partial(of_scene, _box, (96, 96), PATH | NOISE))
CASES["small, prepared"] = (100, _prepared)
CASES["small, loaded"] = (100, _report(3, (64, 48), ONE_RAY))
CASES["small, with an update"] = (100, _with_update)
CASES["small, from its number"] = (100, lambda: partial(mrt.render, 3, **SMALL, **ONE_RAY))
CASES["small, film"] = (100, _report(3, (64, 48), {"aamode": "none", "aa": 1}))
CASES["small, filters"] = (50, _report(3, (64, 48), BLURRED))
CASES["small, mi.render"] = (100, lambda: by_mitsuba(mrt.scene_dict(3, **SMALL), 1))


def seconds(name: str) -> float:
    """The mean seconds of warm renders of a case."""
    number, make = CASES[name]
    render = make()
    for _ in range(1 if number < 10 else 3):
        render()
    start = time.perf_counter()
    for _ in range(number):
        render()
    return (time.perf_counter() - start) / number


if __name__ == "__main__":
    mrt.register()
    print(json.dumps({name: seconds(name) for name in sys.argv[1:] or CASES}))
