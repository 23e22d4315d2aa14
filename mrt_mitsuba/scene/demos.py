"""Scenes 5 to 8, made in place of the original's, whose models are not free."""

from __future__ import annotations

import numpy as np

from mrt_mitsuba.scene import shapes as models
from mrt_mitsuba.scene.model import (
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

EVENING = (0.75, 0.45, 0.3)
DAY = (0.45, 0.65, 0.9)

NOTHING = (0.0, 0.0, 0.0)


def matte(r: float, g: float, b: float) -> Material:
    """Return a rough surface without mirror reflection: index of refraction 0, as in the report's files."""
    return Material(0.0, 0.6, NOTHING, (r, g, b))


def scene_5() -> Scene:
    """Return meshes with two glossy spheres."""
    floor = Material(1.3, 0.1, (0.25, 0.25, 0.25), (0.55, 0.52, 0.5))
    copper = Material(1.4, 0.15, (0.9, 0.55, 0.35), (0.65, 0.3, 0.15))
    return Scene(
        title="a ring, stones and two glossy spheres",
        camera=Camera((2.8, 1.5, 3.2), (0.1, 0.45, 0)),
        sky=(0.25, 0.35, 0.6),
        lights=(Light((4, 6, 3), (3.2, 3.2, 3.0)), Light((-3, 4, 5), (1.5, 1.5, 1.9))),
        spheres=(
            Sphere((-1.05, 0.45, 0.35), 0.45, Material(6.0, 0.02, (0.9, 0.9, 0.9), (0.02, 0.02, 0.02))),
            Sphere((1.25, 0.3, 0.75), 0.3, Material(2.0, 0.03, (0.9, 0.85, 0.6), (0.5, 0.06, 0.05))),
        ),
        planes=(Plane((0, 1, 0), 0, floor),),
        meshes=(
            models.torus((0.2, 0.75, -0.2), 0.55, 0.2, copper),
            models.rock((0.45, 0.12, 0.95), 0.22, matte(0.5, 0.5, 0.45), seed=3),
            models.rock((-0.25, 0.1, 1.15), 0.17, matte(0.35, 0.45, 0.3), seed=4),
            models.block((-0.7, 0.2, -1.2), (1.1, 0.4, 0.5), matte(0.2, 0.35, 0.6), turn=25),
        ),
    )


def scene_6() -> Scene:
    """Return a camp: tents between firs, and a fire of logs that gives light."""
    grass, canvas, green = matte(0.22, 0.36, 0.12), matte(0.8, 0.62, 0.3), matte(0.08, 0.3, 0.12)
    bark = matte(0.3, 0.18, 0.1)
    flame = Material(0.0, 0.5, NOTHING, (1.6, 0.7, 0.15))
    stones, logs = _fireplace(bark)
    seats = (
        Cylinder((-1.0, 0.1, 0.5), (-0.55, 0.1, 1.15), 0.1, bark),
        Cylinder((1.15, 0.1, 0.1), (0.9, 0.1, 0.85), 0.1, bark),
    )
    firs = [
        (float(3.0 * np.cos(a) - 0.4), 0.0, float(3.0 * np.sin(a) - 1.2))
        for a in np.radians([172, 196, 214, 233, 255, 276, 297, 318, 345])
    ]
    crowns, trunks = models.pines(firs, 2.0, green, bark)
    return Scene(
        title="a camp: tents, firs and a fire",
        camera=Camera((1.6, 1.5, 4.2), (-0.1, 0.5, -0.3)),
        sky=EVENING,
        lights=(Light((6, 5, 4), (3.4, 2.7, 2.1)), Light((0.0, 0.75, 0.0), (2.2, 1.1, 0.4))),
        planes=(Plane((0, 1, 0), 0, grass),),
        cones=(
            Cone((0, 0.62, 0), (0, 0.12, 0), 0.13, flame),
            Cone((0.07, 0.45, 0.06), (0.07, 0.12, 0.06), 0.09, flame),
        ),
        cylinders=(*logs, *seats),
        meshes=(
            models.tent((-1.45, 0, -0.7), 1.3, 1.0, 1.5, canvas, turn=35),
            models.tent((1.35, 0, -1.3), 1.2, 0.9, 1.4, matte(0.35, 0.5, 0.7), turn=-50),
            crowns,
            trunks,
            *stones,
        ),
    )


def _fireplace(bark: Material) -> tuple[list[Mesh], tuple[Cylinder, ...]]:
    """Return a ring of stones around the origin, and logs that lean against each other."""
    angles, stone = 2 * np.pi * np.arange(9) / 9, matte(0.45, 0.43, 0.42)
    stones = [
        models.rock((0.42 * np.cos(a), 0.03, 0.42 * np.sin(a)), 0.09, stone, seed=k)
        for k, a in enumerate(angles)
    ]
    logs = tuple(
        Cylinder(
            (0.28 * np.cos(a), 0.05, 0.28 * np.sin(a)), (0.03 * np.cos(a), 0.3, 0.03 * np.sin(a)), 0.045, bark
        )
        for a in angles[::2].tolist()
    )
    return stones, logs


def scene_7() -> Scene:
    """Return a lake between hills, larger than the report's landscape of 3080 triangles."""
    water = Material(1.33, 0.03, (0.7, 0.75, 0.8), (0.02, 0.08, 0.12))
    ground = ((0.08, matte(0.7, 0.62, 0.42)), (0.75, matte(0.2, 0.42, 0.12)), (1.25, matte(0.42, 0.38, 0.34)),
              (9.0, matte(0.95, 0.95, 1.0)))  # fmt: skip
    k = np.arange(400)  # places by a low-discrepancy sequence, Roberts' R₂
    x, z = (k * 0.7548776662) % 1 * 8 - 4, (k * 0.5698402910) % 1 * 8 - 5
    places = [place for place in zip(x, _hills(x, z), z, strict=True) if 0.12 < place[1] < 0.6][:60]
    crowns, trunks = models.pines(places, 0.45, matte(0.06, 0.26, 0.1), matte(0.3, 0.18, 0.1))
    boat = models.block((0.35, 0.03, 1.7), (0.5, 0.12, 0.18), matte(0.6, 0.15, 0.1), turn=30)
    return Scene(
        title="a lake between hills",
        camera=Camera((0.4, 0.9, 5.6), (0, 0.35, 0)),
        sky=DAY,
        lights=(Light((8, 9, 6), (2.6, 2.5, 2.2)), Light((-6, 7, 3), (0.7, 0.75, 0.9))),
        planes=(Plane((0, 1, 0), 0, water),),
        meshes=(*models.terrain(_hills, 6.0, 48, ground), crowns, trunks, boat),
    )


def _hills(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the height of the ground: a bowl, open towards the camera, with ridges on it."""
    bowl = 0.055 * (x**2 + 1.1 * np.maximum(-z - 0.5, 0) ** 2) - 0.35
    ridges = 0.22 * np.sin(1.7 * x + 0.6 * z) * np.cos(1.3 * z - 0.4 * x) + 0.1 * np.sin(4.1 * x - 2.3 * z)
    return (
        bowl + ridges * (0.35 + 0.12 * np.abs(x)) + 0.3 * np.exp(-((x + 2.4) ** 2 + (z + 4.2) ** 2) / 1.5) * 4
    )


def scene_8() -> Scene:
    """Return a textured block on a glossy plane."""
    board = Material(0.0, 0.5, (0.05, 0.05, 0.05), (0.7, 0.5, 0.3), str(models.BLOCK_PICTURE))
    return Scene(
        title="a textured block on a glossy plane",
        camera=Camera((1.6, 1.25, 2.2), (0, 0.42, 0)),
        sky=(0.2, 0.25, 0.35),
        lights=(Light((3, 4, 2), (3.2, 3.2, 3.0)), Light((-2, 3, 4), (2.4, 2.4, 2.6))),
        planes=(Plane((0, 1, 0), 0, Material(2.2, 0.05, (0.6, 0.6, 0.62), (0.12, 0.12, 0.13))),),
        meshes=(models.block((0, 0.5, 0), (1, 1, 1), board, turn=20),),
    )
