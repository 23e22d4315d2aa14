"""The numbered scenes as data: 0 to 4 and 9 are the report's.

Scenes 5 to 8 stand in for the original's, whose models are not free; theirs are OBJ files in ``assets``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import count, product
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.model import BLUE_SKY, Camera, Cone, Cylinder, Light, Material, Plane, Scene, Sphere


def _material(ior: float, alpha: float, *colors: float) -> Material:
    """Return a material of numbers in a row, the specular colour before the diffuse one."""
    return Material(ior, alpha, colors[:3], colors[3:])  # type: ignore[arg-type]


def _lights(*rows: Any) -> tuple[Light, ...]:
    """Return a light for each row of a position and a colour."""
    return tuple(Light(row[:3], row[3:]) for row in rows)


def _objects(kind: Any, *rows: Any) -> tuple[Any, ...]:
    """Return an object for each row: centre and radius, or normal and distance; then its material."""
    return tuple(kind(row[:3], row[3], _material(*row[4:])) for row in rows)


_spheres, _planes = partial(_objects, Sphere), partial(_objects, Plane)

# The ten materials that scene 4 draws from, in the order of its random numbers
SCENE_4_MATERIALS = (
    _material(2.4449, 0.0681, 1.0, 0.882, 0.786, 0.014, 0.012, 0.012),
    _material(1.0720, 0.0588, 1.0, 0.824, 0.945, 0.002, 0.002, 0.003),
    _material(1.1051, 0.0568, 0.005, 0.013, 0.032, 1.0, 0.748, 0.718),
    _material(1.1051, 0.0567, 0.006, 0.026, 0.022, 1.0, 0.739, 0.721),
    _material(1.1022, 0.0579, 0.286, 0.235, 0.128, 1.0, 0.766, 0.762),
    _material(1.0893, 0.0604, 0.202, 0.035, 0.033, 1.0, 0.857, 0.866),
    _material(1.1382, 0.0886, 0.301, 0.034, 0.039, 1.0, 0.992, 0.98),
    _material(1.0771, 0.0589, 0.26, 0.036, 0.014, 1.0, 0.852, 1.172),
    _material(1.1481, 0.0625, 0.016, 0.073, 0.04, 1.0, 1.056, 1.146),
    _material(1.1153, 0.0680, 0.012, 0.036, 0.106, 1.0, 0.965, 1.07),
)

_ROW = [round(-1.5 + i / 3, 9) for i in range(10)]  # places of spheres, to nine digits as in the original
# Parts of materials: index and roughness, specular and diffuse colour, or some of these
_GLOSSY = (1.3, 0.1, 0.5, 0.5, 0.5)
_RED, _BLUE = (1, 0.992, 0.98, 0.301, 0.034, 0.039), (1, 0.965, 1.07, 0.012, 0.036, 0.106)
_PINK = (1, 0.748, 0.718, 0.005, 0.013, 0.032)
_WOOD = _material(1.0771, 0.0589, 0.26, 0.036, 0.014, 1, 0.852, 1.172)
# Surfaces of index 0, as in the report's files, have no mirror reflection
_GRASS = (0.0, 0.6, 0.0, 0.0, 0.0, 0.22, 0.36, 0.12)
_BARK = _material(0.0, 0.6, 0.0, 0.0, 0.0, 0.3, 0.18, 0.1)
_FLAME = _material(0.0, 0.5, 0.0, 0.0, 0.0, 1.6, 0.7, 0.15)
_DIM = (0.3764705882352941, 0.11176470588235295, 0.08431372549019608)  # colour of a light

_SCENES = (
    Scene(  # 0
        title="four spheres on a plane",
        camera=Camera((3, 1, 0), (0, 0.3, 0)),
        sky=(0.1, 0.3, 0.5),
        lights=_lights((10, 10, 10, 1, 1, 1), (4, 10, -2, 1, 1, 1)),
        spheres=_spheres(
            (0, 0, 0, 0.25, *_GLOSSY, 0.5, 0.5, 0.5),
            (1, 0, 0, 0.25, *_GLOSSY, 0.5, 0, 0),
            (0, 1, 0, 0.25, *_GLOSSY, 0, 0.5, 0.5),
            (0, 0, 1, 0.25, *_GLOSSY, 0, 0, 0.5),
        ),
        planes=_planes((0, 1, 0, 0, *_GLOSSY, 0.6, 0.6, 0.6)),
    ),
    Scene(  # 1
        title="roughness along two rows of spheres, before a large mirror",
        camera=Camera((3, 0, 0), (0, 0.3, 0)),
        sky=BLUE_SKY,
        lights=_lights((10, 10, 10, 10, 10, 10), (4, 10, -2, 5, 3, 10)),
        spheres=(
            *_spheres(*((0, 0, _ROW[i], 0.15, 1.1382, (10 - i) / 90, *_RED) for i in range(10))),
            *_spheres(*((0, 1, _ROW[i], 0.15, 1.1153, (i + 1) / 10, *_BLUE) for i in range(10))),
            Sphere((-3, 1, 0), 2, SCENE_4_MATERIALS[0]),
        ),
        planes=_planes((0, 1, 0, 1, 1.1481, 0.0625, 1, 1.056, 1.146, 0.016, 0.073, 0.04)),
    ),
    Scene(  # 2
        title="roughness against index of refraction",
        camera=Camera((0.5, 3, 1), (0, 0, 0.6), (0, 0, 1)),
        sky=BLUE_SKY,
        lights=_lights((-20, 5, 10, 30, 30, 30), (10, 10, 10, 30, 30, 30), (50, -100, 10, 1, 0.7, 2)),
        spheres=_spheres(  # the two leftmost columns have a negative roughness, as in the original
            *(
                (_ROW[i], 0, 0.4 * (j + 1), 0.15, 1.0051 + 0.4 * j / 3, -0.0432 + 0.1 * i / 3, *_PINK)
                for j, i in product(range(4), range(10))
            )
        ),
        planes=_planes((0, 0, 1, 0, 1.1022, 0.0579, 0.95, 0.95, 0.95, 0.05, 0.05, 0.05)),
    ),
    Scene(  # 3
        title="six spheres in the corner of three planes",
        camera=Camera((4.5, 0.8, 4.5), (0, 0.3, 0)),
        sky=BLUE_SKY,
        lights=_lights((0, 1.7, 1, 1.5, 1.5, 1.5), (3, 2, 3, 2, 2, 2), (4, 3, -1, 2.5, 2.5, 2.5)),
        spheres=_spheres(
            (0, 0.1, 0, 0.3, 6, 0.0181, 0.7, 0.882, 0.786, 0.014, 0.012, 0.012),
            (1, -0.05, 0, 0.15, 1.3771, 0.01589, 1, 0.852, 1.172, 0.26, 0.036, 0.014),
            (3, 0.05, 2, 0.25, 3, 0.00181, 0.7, 0.882, 0.786, 0.014, 0.012, 0.012),
            (1.3, 0, 2.6, 0.215, 1.5771, 0.01589, 0.8, 0.852, 0.8172, 0.46, 0.136, 0.114),
            (1.9, 0.05, 2.2, 0.25, 1.3051, 0.567, 0.7, 0.739, 0.721, 0.06, 0.26, 0.22),
            (0, 0, 1, 0.2, 1.1153, 0.18, 1, 0.965, 1.07, 0.012, 0.036, 0.406),
        ),
        planes=_planes(
            (0, 1, 0, 0.2, 1.382, 0.05886, 0.2, 0.2, 0.2, 0.2, 0.4, 0.3),
            (1, 0, -1, 2, 1.8382, 0.886, 0.2, 0.2, 0.1, 0.5, 0.09, 0.07),
            (0.3, -0.2, 1, 4, 1.9382, 0.0886, 0.5, 0.5, 0.5, 0.1, 0.3, 0.05),
        ),
        focal_distance=2.0,
    ),
    Scene(  # 4, to which ``report_scene`` adds the spheres
        title="600 spheres in the corner of three planes",
        camera=Camera((6, 4, 6), (0, 1, 0), hfov=90),
        sky=BLUE_SKY,
        lights=_lights((10, 10.7, 1, 1.5, 1.5, 1.5), (8, 20, 3, 2, 2, 2), (4, 30, -1, 2.5, 2.5, 2.5)),
        planes=_planes(
            (0, 1, 0, 0.2, 2.382, 0.005886, 0.2, 0.2, 0.2, 0.2, 0.4, 0.3),
            (1, 0, 0, 2, 2.8382, 0.00886, 0.2, 0.2, 0.1, 0.5, 0.09, 0.07),
            (0, 0, 1, 4, 2.9382, 0.00886, 0.5, 0.5, 0.5, 0.1, 0.3, 0.05),
        ),
        focal_distance=0.1,
        focal_range=3.0,
    ),
    # 5 to 8, to which it adds the meshes
    Scene(  # 5
        title="a ring, stones and two glossy spheres",
        camera=Camera((2.8, 1.5, 3.2), (0.1, 0.45, 0)),
        sky=(0.25, 0.35, 0.6),
        lights=_lights((4, 6, 3, 3.2, 3.2, 3.0), (-3, 4, 5, 1.5, 1.5, 1.9)),
        spheres=_spheres(
            (-1.05, 0.45, 0.35, 0.45, 6.0, 0.02, 0.9, 0.9, 0.9, 0.02, 0.02, 0.02),
            (1.25, 0.3, 0.75, 0.3, 2.0, 0.03, 0.9, 0.85, 0.6, 0.5, 0.06, 0.05),
        ),
        planes=_planes((0, 1, 0, 0, 1.3, 0.1, 0.25, 0.25, 0.25, 0.55, 0.52, 0.5)),
    ),
    Scene(  # 6
        title="a camp: tents, firs and a fire",
        camera=Camera((1.6, 1.5, 4.2), (-0.1, 0.5, -0.3)),
        sky=(0.75, 0.45, 0.3),
        lights=_lights((6, 5, 4, 3.4, 2.7, 2.1), (0.0, 0.75, 0.0, 2.2, 1.1, 0.4)),
        planes=_planes((0, 1, 0, 0, *_GRASS)),
        cones=(
            Cone((0, 0.62, 0), (0, 0.12, 0), 0.13, _FLAME),
            Cone((0.07, 0.45, 0.06), (0.07, 0.12, 0.06), 0.09, _FLAME),
        ),
        cylinders=(
            *(  # logs that lean against each other
                Cylinder((0.28 * x, 0.05, 0.28 * z), (0.03 * x, 0.3, 0.03 * z), 0.045, _BARK)
                for x, z in (
                    (math.cos(a), math.sin(a)) for a in (2 * math.pi * k / 9 for k in range(0, 9, 2))
                )
            ),
            Cylinder((-1.0, 0.1, 0.5), (-0.55, 0.1, 1.15), 0.1, _BARK),
            Cylinder((1.15, 0.1, 0.1), (0.9, 0.1, 0.85), 0.1, _BARK),
        ),
    ),
    Scene(  # 7
        title="a lake between hills",
        camera=Camera((0.4, 0.9, 5.6), (0, 0.35, 0)),
        sky=(0.45, 0.65, 0.9),
        lights=_lights((8, 9, 6, 2.6, 2.5, 2.2), (-6, 7, 3, 0.7, 0.75, 0.9)),
        planes=_planes((0, 1, 0, 0, 1.33, 0.03, 0.7, 0.75, 0.8, 0.02, 0.08, 0.12)),
    ),
    Scene(  # 8
        title="a textured block on a glossy plane",
        camera=Camera((1.6, 1.25, 2.2), (0, 0.42, 0)),
        sky=(0.2, 0.25, 0.35),
        lights=_lights((3, 4, 2, 3.2, 3.2, 3.0), (-2, 3, 4, 2.4, 2.4, 2.6)),
        planes=_planes((0, 1, 0, 0, 2.2, 0.05, 0.6, 0.6, 0.62, 0.12, 0.12, 0.13)),
    ),
    Scene(  # 9
        title="a cone above a plane",
        camera=Camera((3, 3, 0), (0, 0, 0)),
        sky=BLUE_SKY,
        lights=_lights((2.8, -28.34, 4.33, *_DIM), (3, 3, 3, 2.5, 2.5, 2.5)),
        planes=(Plane((0, 1, 0), 0, _WOOD),),
        cones=(Cone((0, 1.5, 0), (0, 0.5, 0), 0.648361, _WOOD),),
    ),
)
_MODELS = {5: "ring.obj", 6: "camp.obj", 7: "lake.obj", 8: "block.obj"}  # in ``assets``
NUMBERS = tuple(range(len(_SCENES)))


def report_scene(number: int) -> Scene:
    """Return a scene by its number. Raises ``UsageError`` for one that there is not."""
    if number not in NUMBERS:
        raise UsageError(f"there is no scene {number!r}: choose one of {', '.join(map(str, NUMBERS))}")
    return _complete(number)


@cache
def _complete(number: int) -> Scene:
    """Return a scene with what takes time to read or to draw."""
    scene, model = _SCENES[number], _MODELS.get(number)
    if model:
        from mrt_mitsuba.scene.obj import read_obj  # with numpy, which the other scenes do without

        return replace(scene, meshes=read_obj(Path(__file__).parent / "assets" / model)[0])
    if number != 4:
        return scene
    numbers, spheres = c_rand(), []
    for _ in range(600):
        material = SCENE_4_MATERIALS[next(numbers) % 10]
        radius = 0.05 + next(numbers) % 200 / 1000
        z, y, x = 1 + next(numbers) % 650 / 100, next(numbers) % 650 / 100, 1 + next(numbers) % 650 / 100
        spheres.append(Sphere((x, y, z), radius, material))
    return replace(scene, spheres=tuple(spheres))


def c_rand(seed: int = 1) -> Iterator[int]:
    """Yield the numbers of the GNU C library's ``rand()``: an additive feedback generator over 31 words.

    Source: the polynomial x³¹ + x³ + 1 of its manual page, started by a Lehmer generator (multiplier 16807),
    without the first 310 numbers.
    """
    words = [seed]
    for _ in range(30):
        words.append(16807 * words[-1] % 0x7FFFFFFF)
    words += words[:3]
    for i in count(34):
        words.append((words[i - 31] + words[i - 3]) & 0xFFFFFFFF)
        if i >= 344:
            yield words[-1] >> 1
