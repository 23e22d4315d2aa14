"""The numbered scenes as data: 0 to 4 and 9 are the report's.

Scenes 5 to 8 stand in for the original's, whose models are not free; theirs are OBJ files in ``assets``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.model import (
    BLUE_SKY,
    Camera,
    Cone,
    Cylinder,
    Light,
    Material,
    Mesh,
    Plane,
    Scene,
    Sphere,
)

# The ten materials that scene 4 draws from, in the order of its random numbers
SCENE_4_MATERIALS = (
    Material(ior=2.4449, alpha=0.0681, specular=(1.0, 0.882, 0.786), diffuse=(0.014, 0.012, 0.012)),
    Material(ior=1.0720, alpha=0.0588, specular=(1.0, 0.824, 0.945), diffuse=(0.002, 0.002, 0.003)),
    Material(ior=1.1051, alpha=0.0568, specular=(0.005, 0.013, 0.032), diffuse=(1.0, 0.748, 0.718)),
    Material(ior=1.1051, alpha=0.0567, specular=(0.006, 0.026, 0.022), diffuse=(1.0, 0.739, 0.721)),
    Material(ior=1.1022, alpha=0.0579, specular=(0.286, 0.235, 0.128), diffuse=(1.0, 0.766, 0.762)),
    Material(ior=1.0893, alpha=0.0604, specular=(0.202, 0.035, 0.033), diffuse=(1.0, 0.857, 0.866)),
    Material(ior=1.1382, alpha=0.0886, specular=(0.301, 0.034, 0.039), diffuse=(1.0, 0.992, 0.98)),
    Material(ior=1.0771, alpha=0.0589, specular=(0.26, 0.036, 0.014), diffuse=(1.0, 0.852, 1.172)),
    Material(ior=1.1481, alpha=0.0625, specular=(0.016, 0.073, 0.04), diffuse=(1.0, 1.056, 1.146)),
    Material(ior=1.1153, alpha=0.0680, specular=(0.012, 0.036, 0.106), diffuse=(1.0, 0.965, 1.07)),
)

_ROW = [round(-1.5 + i / 3, 9) for i in range(10)]  # places of spheres, to nine digits as in the original
_BLACK = (0.0, 0.0, 0.0)


_SCENES: list[Callable[[], Scene]] = []  # by number


def _numbered(make: Callable[[], Scene]) -> Callable[[], Scene]:
    """Give the scene that a function makes the next number. It is made once."""
    _SCENES.append(cache(make))
    return make


@_numbered
def scene_0() -> Scene:
    def glossy(red: float, green: float, blue: float) -> Material:
        return Material(ior=1.3, alpha=0.1, specular=(0.5, 0.5, 0.5), diffuse=(red, green, blue))

    grey = Sphere((0, 0, 0), 0.25, glossy(0.5, 0.5, 0.5))
    red = Sphere((1, 0, 0), 0.25, glossy(0.5, 0, 0))
    green = Sphere((0, 1, 0), 0.25, glossy(0, 0.5, 0.5))
    blue = Sphere((0, 0, 1), 0.25, glossy(0, 0, 0.5))
    return Scene(
        title="four spheres on a plane",
        camera=Camera((3, 1, 0), (0, 0.3, 0)),
        sky=(0.1, 0.3, 0.5),
        lights=(Light((10, 10, 10), (1, 1, 1)), Light((4, 10, -2), (1, 1, 1))),
        spheres=(grey, red, green, blue),
        planes=(Plane((0, 1, 0), 0, glossy(0.6, 0.6, 0.6)),),
    )


@_numbered
def scene_1() -> Scene:
    red = Material(ior=1.1382, alpha=0, specular=(1, 0.992, 0.98), diffuse=(0.301, 0.034, 0.039))
    blue = Material(ior=1.1153, alpha=0, specular=(1, 0.965, 1.07), diffuse=(0.012, 0.036, 0.106))
    floor = Material(ior=1.1481, alpha=0.0625, specular=(1, 1.056, 1.146), diffuse=(0.016, 0.073, 0.04))
    spheres = [Sphere((0, 0, z), 0.15, replace(red, alpha=(10 - i) / 90)) for i, z in enumerate(_ROW)]
    spheres += [Sphere((0, 1, z), 0.15, replace(blue, alpha=(i + 1) / 10)) for i, z in enumerate(_ROW)]
    spheres.append(Sphere((-3, 1, 0), 2, SCENE_4_MATERIALS[0]))
    return Scene(
        title="roughness along two rows of spheres, before a large mirror",
        camera=Camera((3, 0, 0), (0, 0.3, 0)),
        sky=BLUE_SKY,
        lights=(Light((10, 10, 10), (10, 10, 10)), Light((4, 10, -2), (5, 3, 10))),
        spheres=tuple(spheres),
        planes=(Plane((0, 1, 0), 1, floor),),
    )


@_numbered
def scene_2() -> Scene:
    pink = Material(ior=0, alpha=0, specular=(1, 0.748, 0.718), diffuse=(0.005, 0.013, 0.032))
    floor = Material(ior=1.1022, alpha=0.0579, specular=(0.95, 0.95, 0.95), diffuse=(0.05, 0.05, 0.05))
    spheres = []
    for j in range(4):
        ior = 1.0051 + 0.4 * j / 3
        for i, x in enumerate(_ROW):
            alpha = -0.0432 + 0.1 * i / 3  # negative in the two leftmost columns, as in the original
            spheres.append(Sphere((x, 0, 0.4 * (j + 1)), 0.15, replace(pink, ior=ior, alpha=alpha)))
    white = Light((-20, 5, 10), (30, 30, 30))
    behind = Light((50, -100, 10), (1, 0.7, 2))
    return Scene(
        title="roughness against index of refraction",
        camera=Camera((0.5, 3, 1), (0, 0, 0.6), (0, 0, 1)),
        sky=BLUE_SKY,
        lights=(white, Light((10, 10, 10), (30, 30, 30)), behind),
        spheres=tuple(spheres),
        planes=(Plane((0, 0, 1), 0, floor),),
    )


@_numbered
def scene_3() -> Scene:
    gold = Material(ior=6, alpha=0.0181, specular=(0.7, 0.882, 0.786), diffuse=(0.014, 0.012, 0.012))
    red = Material(ior=1.3771, alpha=0.01589, specular=(1, 0.852, 1.172), diffuse=(0.26, 0.036, 0.014))
    ochre = Material(ior=1.5771, alpha=0.01589, specular=(0.8, 0.852, 0.8172), diffuse=(0.46, 0.136, 0.114))
    rough = Material(ior=1.3051, alpha=0.567, specular=(0.7, 0.739, 0.721), diffuse=(0.06, 0.26, 0.22))
    blue = Material(ior=1.1153, alpha=0.18, specular=(1, 0.965, 1.07), diffuse=(0.012, 0.036, 0.406))
    floor = Material(ior=1.382, alpha=0.05886, specular=(0.2, 0.2, 0.2), diffuse=(0.2, 0.4, 0.3))
    left = Material(ior=1.8382, alpha=0.886, specular=(0.2, 0.2, 0.1), diffuse=(0.5, 0.09, 0.07))
    right = Material(ior=1.9382, alpha=0.0886, specular=(0.5, 0.5, 0.5), diffuse=(0.1, 0.3, 0.05))
    spheres = (
        Sphere((0, 0.1, 0), 0.3, gold),
        Sphere((1, -0.05, 0), 0.15, red),
        Sphere((3, 0.05, 2), 0.25, replace(gold, ior=3, alpha=0.00181)),
        Sphere((1.3, 0, 2.6), 0.215, ochre),
        Sphere((1.9, 0.05, 2.2), 0.25, rough),
        Sphere((0, 0, 1), 0.2, blue),
    )
    lights = (
        Light((0, 1.7, 1), (1.5, 1.5, 1.5)),
        Light((3, 2, 3), (2, 2, 2)),
        Light((4, 3, -1), (2.5, 2.5, 2.5)),
    )
    return Scene(
        title="six spheres in the corner of three planes",
        camera=Camera((4.5, 0.8, 4.5), (0, 0.3, 0)),
        sky=BLUE_SKY,
        lights=lights,
        spheres=spheres,
        planes=(Plane((0, 1, 0), 0.2, floor), Plane((1, 0, -1), 2, left), Plane((0.3, -0.2, 1), 4, right)),
        focal_distance=2.0,
    )


@_numbered
def scene_4() -> Scene:
    floor = Material(ior=2.382, alpha=0.005886, specular=(0.2, 0.2, 0.2), diffuse=(0.2, 0.4, 0.3))
    left = Material(ior=2.8382, alpha=0.00886, specular=(0.2, 0.2, 0.1), diffuse=(0.5, 0.09, 0.07))
    right = Material(ior=2.9382, alpha=0.00886, specular=(0.5, 0.5, 0.5), diffuse=(0.1, 0.3, 0.05))
    lights = (
        Light((10, 10.7, 1), (1.5, 1.5, 1.5)),
        Light((8, 20, 3), (2, 2, 2)),
        Light((4, 30, -1), (2.5, 2.5, 2.5)),
    )
    spheres = []
    numbers = c_rand()  # drawn in the original's order
    for _ in range(600):
        material = SCENE_4_MATERIALS[next(numbers) % 10]
        radius = 0.05 + next(numbers) % 200 / 1000
        z = 1 + next(numbers) % 650 / 100
        y = next(numbers) % 650 / 100
        x = 1 + next(numbers) % 650 / 100
        spheres.append(Sphere((x, y, z), radius, material))
    return Scene(
        title="600 spheres in the corner of three planes",
        camera=Camera((6, 4, 6), (0, 1, 0), hfov=90),
        sky=BLUE_SKY,
        lights=lights,
        spheres=tuple(spheres),
        planes=(Plane((0, 1, 0), 0.2, floor), Plane((1, 0, 0), 2, left), Plane((0, 0, 1), 4, right)),
        focal_distance=0.1,
        focal_range=3.0,
    )


@_numbered
def scene_5() -> Scene:
    mirror = Material(ior=6.0, alpha=0.02, specular=(0.9, 0.9, 0.9), diffuse=(0.02, 0.02, 0.02))
    copper = Material(ior=2.0, alpha=0.03, specular=(0.9, 0.85, 0.6), diffuse=(0.5, 0.06, 0.05))
    floor = Material(ior=1.3, alpha=0.1, specular=(0.25, 0.25, 0.25), diffuse=(0.55, 0.52, 0.5))
    return Scene(
        title="a ring, stones and two glossy spheres",
        camera=Camera((2.8, 1.5, 3.2), (0.1, 0.45, 0)),
        sky=(0.25, 0.35, 0.6),
        lights=(Light((4, 6, 3), (3.2, 3.2, 3.0)), Light((-3, 4, 5), (1.5, 1.5, 1.9))),
        spheres=(Sphere((-1.05, 0.45, 0.35), 0.45, mirror), Sphere((1.25, 0.3, 0.75), 0.3, copper)),
        planes=(Plane((0, 1, 0), 0, floor),),
        meshes=_meshes("ring.obj"),
    )


@_numbered
def scene_6() -> Scene:
    # surfaces of index 0, as in the report's files, have no mirror reflection
    grass = Material(ior=0.0, alpha=0.6, specular=_BLACK, diffuse=(0.22, 0.36, 0.12))
    bark = Material(ior=0.0, alpha=0.6, specular=_BLACK, diffuse=(0.3, 0.18, 0.1))
    flame = Material(ior=0.0, alpha=0.5, specular=_BLACK, diffuse=(1.6, 0.7, 0.15))
    logs = []
    for k in range(0, 9, 2):  # they lean against each other
        angle = 2 * math.pi * k / 9
        x = math.cos(angle)
        z = math.sin(angle)
        logs.append(Cylinder((0.28 * x, 0.05, 0.28 * z), (0.03 * x, 0.3, 0.03 * z), 0.045, bark))
    logs.append(Cylinder((-1.0, 0.1, 0.5), (-0.55, 0.1, 1.15), 0.1, bark))
    logs.append(Cylinder((1.15, 0.1, 0.1), (0.9, 0.1, 0.85), 0.1, bark))
    large = Cone((0, 0.62, 0), (0, 0.12, 0), 0.13, flame)
    small = Cone((0.07, 0.45, 0.06), (0.07, 0.12, 0.06), 0.09, flame)
    return Scene(
        title="a camp: tents, firs and a fire",
        camera=Camera((1.6, 1.5, 4.2), (-0.1, 0.5, -0.3)),
        sky=(0.75, 0.45, 0.3),
        lights=(Light((6, 5, 4), (3.4, 2.7, 2.1)), Light((0.0, 0.75, 0.0), (2.2, 1.1, 0.4))),
        planes=(Plane((0, 1, 0), 0, grass),),
        cones=(large, small),
        cylinders=tuple(logs),
        meshes=_meshes("camp.obj"),
    )


@_numbered
def scene_7() -> Scene:
    water = Material(ior=1.33, alpha=0.03, specular=(0.7, 0.75, 0.8), diffuse=(0.02, 0.08, 0.12))
    return Scene(
        title="a lake between hills",
        camera=Camera((0.4, 0.9, 5.6), (0, 0.35, 0)),
        sky=(0.45, 0.65, 0.9),
        lights=(Light((8, 9, 6), (2.6, 2.5, 2.2)), Light((-6, 7, 3), (0.7, 0.75, 0.9))),
        planes=(Plane((0, 1, 0), 0, water),),
        meshes=_meshes("lake.obj"),
    )


@_numbered
def scene_8() -> Scene:
    floor = Material(ior=2.2, alpha=0.05, specular=(0.6, 0.6, 0.62), diffuse=(0.12, 0.12, 0.13))
    return Scene(
        title="a textured block on a glossy plane",
        camera=Camera((1.6, 1.25, 2.2), (0, 0.42, 0)),
        sky=(0.2, 0.25, 0.35),
        lights=(Light((3, 4, 2), (3.2, 3.2, 3.0)), Light((-2, 3, 4), (2.4, 2.4, 2.6))),
        planes=(Plane((0, 1, 0), 0, floor),),
        meshes=_meshes("block.obj"),
    )


@_numbered
def scene_9() -> Scene:
    wood = Material(ior=1.0771, alpha=0.0589, specular=(0.26, 0.036, 0.014), diffuse=(1, 0.852, 1.172))
    dim = Light((2.8, -28.34, 4.33), (0.3764705882352941, 0.11176470588235295, 0.08431372549019608))
    return Scene(
        title="a cone above a plane",
        camera=Camera((3, 3, 0), (0, 0, 0)),
        sky=BLUE_SKY,
        lights=(dim, Light((3, 3, 3), (2.5, 2.5, 2.5))),
        planes=(Plane((0, 1, 0), 0, wood),),
        cones=(Cone((0, 1.5, 0), (0, 0.5, 0), 0.648361, wood),),
    )


NUMBERS = tuple(range(len(_SCENES)))


def report_scene(number: int) -> Scene:
    """The scene of a number. Raises ``UsageError`` for any other."""
    if number not in NUMBERS:
        raise UsageError(f"there is no scene {number!r}: choose one of {', '.join(map(str, NUMBERS))}")
    return _SCENES[number]()


def _meshes(model: str) -> tuple[Mesh, ...]:
    from mrt_mitsuba.scene.obj import read_obj  # with numpy, which the other scenes do without

    meshes, _ = read_obj(Path(__file__).parent / "assets" / model)
    return meshes


def c_rand() -> Iterator[int]:
    """Yield the numbers of the GNU C library's ``rand()`` from the seed 1: an additive feedback generator.

    Source: the polynomial x³¹ + x³ + 1 of its manual page, started by a Lehmer generator (multiplier 16807),
    without the first 310 numbers.
    """
    words = [1]
    for _ in range(30):
        words.append(16807 * words[-1] % 0x7FFFFFFF)
    words += words[:3]
    for i in count(34):
        words.append((words[i - 31] + words[i - 3]) & 0xFFFFFFFF)
        if i >= 344:
            yield words[-1] >> 1
