"""Parts of the scenes that studies render: a camera, other materials, rays through the pixels' centres."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.scene.model import Material, Scene

# One ray at a time through the pixel's centre, as the report's lattice has it
AT_CENTRES: dict[str, Any] = {"aa": 1, "aamode": "none", "lattice": "report"}


def camera(
    origin: Sequence[float],
    target: Sequence[float],
    up: Sequence[float],
    width: int,
    height: int,
    **more: Any,
) -> dict[str, Any]:
    """Return a perspective camera whose film has a box filter, as a Mitsuba dict."""
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    look = mi.ScalarTransform4f().look_at(origin, target, up)
    return {"type": "perspective", "to_world": look, "film": film, **more}


def with_materials(scene: Scene, change: Callable[[Material], Material]) -> Scene:
    """Return a scene whose spheres and planes have other materials."""

    def changed(things: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(dataclasses.replace(t, material=change(t.material)) for t in things)

    return dataclasses.replace(scene, spheres=changed(scene.spheres), planes=changed(scene.planes))


def rays(o: np.ndarray, d: np.ndarray) -> Any:
    """Return rays from points [N, 3] in directions [N, 3]."""
    return mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T))


def traced(scene: Any, ray: Any, **parameters: Any) -> Any:
    """Return what ``mrt_whitted`` with these parameters finds along rays."""
    integrator = mi.load_dict({"type": "mrt_whitted", **parameters})
    integrator.prepare(scene)
    return integrator.trace(scene, None, ray)
