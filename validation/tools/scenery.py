"""Parts of the scenes that studies render: cameras, rays, other materials, a ball to compare these on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.scene.model import Material, Scene
from mrt_mitsuba.validation.tools.bsdf_probe import rgb

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
    return integrator.trace(scene, None, ray)


def ball_scene(bsdf: Mapping[str, Any], *, size: int = 96, studio: bool = False) -> Any:
    """Return a ball of the material on a floor under a sky and a point light, ``size`` × ¾ ``size`` pixels.

    In the ``studio`` it is alone under a sky of bright and dark fields: all noise is then that of its
    samples, and no light comes back from a floor in rare bright ones.
    """
    ground = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(4),
        "bsdf": {"type": "diffuse", "reflectance": rgb((0.5, 0.4, 0.3))},
    }
    around = {
        "sky": {"type": "constant", "radiance": rgb((0.3, 0.4, 0.6))},
        "lamp": {"type": "point", "position": [1.5, -2, 3], "intensity": rgb((12, 10, 8))},
        "floor": ground,
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5},
            "sensor": camera([0, -4, 1.6], [0, 0, 0.6], [0, 0, 1], size, size * 3 // 4, fov=32),
            "ball": {"type": "sphere", "center": [0, 0, 0.7], "radius": 0.7, "bsdf": dict(bsdf)},
            **({"sky": _fields()} if studio else around),
        }
    )


def _fields() -> dict[str, Any]:
    """Return a sky of 16 × 8 fields with random brightness, a decade from the median to the brighter ones."""
    fields = 10 ** np.random.default_rng(0).normal(-0.5, 0.5, (8, 16, 1)) * np.ones(3)
    return {"type": "envmap", "bitmap": mi.Bitmap(fields.astype(np.float32))}
