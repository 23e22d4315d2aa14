"""The scene in which materials are compared: a ball on a floor, or alone in a studio."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.tools.bsdf_probe import Array, rgb
from mrt_mitsuba.validation.tools.scenery import camera


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


def side_by_side(one: Array, other: Array, *, gain: float) -> Array:
    """Return two pictures [H, W, 3] and their absolute difference, enlarged, in a row."""
    return np.concatenate([one, other, gain * np.abs(one - other)], axis=1)
