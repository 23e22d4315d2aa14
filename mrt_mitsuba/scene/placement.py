"""Camera and lights for a model that has neither, by its size."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.model import BLUE_SKY, Camera, Color, Light, Scene, Vector, view_problem
from mrt_mitsuba.scene.obj import read_model


def obj_scene(
    path: str | os.PathLike[str],
    *,
    convention: str = "report",
    texturing: str | None = None,
    camera: Camera | None = None,
    lights: Sequence[Light] | None = None,
    sky: Color = BLUE_SKY,
) -> Scene:
    """Return a scene of an OBJ file; camera and lights that are not given are placed by the model's size.

    The camera stands in front, towards +z, a little above and to the right, and sees all of it; a light is up
    on each side, the right one brighter. ``texturing`` follows ``convention`` unless given. Raises as
    ``read_obj`` does.
    """
    meshes, files = read_model(path, convention=convention)
    low = np.min([m.vertices.min(axis=0) for m in meshes], axis=0).astype(float)
    high = np.max([m.vertices.max(axis=0) for m in meshes], axis=0).astype(float)
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 or 1.0

    def place(x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return a point in radii from the centre."""
        px, py, pz = (center + radius * np.array([x, y, z])).tolist()
        return px, py, pz

    # A ball of radius 1 fills a view of 45° height, that of 60° width in a 4:3 picture, from a distance of
    # 2.6
    return Scene(
        title=os.path.basename(path),
        camera=camera or Camera(place(1.0, 0.8, 2.4), place(0, 0, 0)),
        sky=sky,
        lights=tuple(lights)
        if lights is not None
        else (Light(place(4, 5, 4), (2.5, 2.5, 2.5)), Light(place(-4, 3, 5), (1.0, 1.0, 1.2))),
        meshes=meshes,
        texturing=texturing or convention,
        files=files,
    )


def model_scene(
    path: str | os.PathLike[str],
    *,
    convention: str = "report",
    texturing: str | None = None,
    camera: Vector | None = None,
    target: Vector | None = None,
    up: Vector | None = None,
    fov: float | None = None,
    light: Vector | None = None,
) -> Scene:
    """Return the scene of an OBJ file as the options show it; what is None stays as ``obj_scene`` places it.

    ``fov`` is horizontal, in degrees; ``light`` is the place of a white light. Raises ``UsageError`` for a
    camera that sees nothing, and what ``obj_scene`` raises.
    """
    lights = None if light is None else (Light(light, (2.5, 2.5, 2.5)),)
    scene = obj_scene(path, convention=convention, texturing=texturing, lights=lights)
    given: dict[str, Any] = {"position": camera, "target": target, "up": up, "hfov": fov}
    view = replace(scene.camera, **{name: value for name, value in given.items() if value is not None})
    problem = view_problem(view)
    if problem:
        raise UsageError(problem)
    return replace(scene, camera=view)
