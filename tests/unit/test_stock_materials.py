"""Materials of Mitsuba's own under ``mrt_whitted``, without bounces and clamp: as ``direct`` has them."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

CHECKERS = {"type": "checkerboard", "color0": 0.1, "color1": 0.9}
SPHERE = {"type": "sphere"}
DIRECT = {"type": "direct"}
SQUARE = {"type": "rectangle"}


def difference(shape: dict[str, Any], material: dict[str, Any], **more: Any) -> tuple[float, float]:
    """The largest difference of the two integrators' pictures, and the contrast of the picture."""
    look = mi.ScalarTransform4f().look_at([0, 1, 6], [0, 0.2, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 48, "height": 32, "component_format": "float32"}
    film["rfilter"] = {"type": "box"}
    scene = mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "light": {"type": "point", "position": [2, 4, 5], "intensity": 10.0},
        "shape": {**shape, "bsdf": material}, **more,
    })  # fmt: skip
    ours = mi.load_dict({"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0})
    pictures = [np.array(mi.render(scene, integrator=i, spp=1)) for i in (ours, mi.load_dict(DIRECT))]
    return float(np.abs(pictures[0] - pictures[1]).max()), float(pictures[1].std())


@pytest.mark.parametrize("shape", [SPHERE, SQUARE])
@pytest.mark.parametrize(
    "material",
    [
        {"type": "diffuse", "reflectance": CHECKERS},
        {"type": "twosided", "inner": {"type": "diffuse", "reflectance": CHECKERS}},
        {"type": "roughplastic", "diffuse_reflectance": CHECKERS},
        {"type": "principled", "base_color": CHECKERS},
        {"type": "blendbsdf", "weight": CHECKERS, "a": {"type": "diffuse"}, "b": {"type": "plastic"}},
        {"type": "roughconductor", "alpha": CHECKERS},
    ],
    ids=lambda material: material["type"],
)
def test_textures_of_stock_materials(shape: dict[str, Any], material: dict[str, Any]) -> None:
    """Mitsuba's materials do not say by their flags that they vary over the surface."""
    largest, contrast = difference(shape, material)
    assert contrast > 5e-3
    assert largest < 1e-6  # roundings of values below 0.2
