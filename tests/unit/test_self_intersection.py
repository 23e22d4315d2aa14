"""Surfaces are not in their own shadow, however far the camera."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba.render import render


@pytest.mark.parametrize("distance", [3.0, 300.0])
def test_a_lit_sphere_has_no_dark_spots(variant: str, distance: float) -> None:
    """Seen from where its light is, every point of a sphere is lit; along a ray of 300 radii, a hit is up to
    150 roundings of the radius off the sphere, more than the 32 by which shadow rays start above it."""
    to_world = mi.ScalarTransform4f().look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])
    size = 400
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": {
            "type": "perspective",
            "fov": np.degrees(2 * np.arctan(0.8 / distance)),
            "near_clip": 0.1,
            "far_clip": 1e4,
            "to_world": to_world,
            "film": film,
        },
        "light": {"type": "mrt_light", "position": [0, 0, distance]},
        "sphere": {"type": "sphere", "bsdf": {"type": "mrt_bsdf"}},
    }
    image = render(scene, aa=1).image
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    on_sphere = np.hypot(x, y) < 0.5 * size  # well inside of its outline, which is at 0.6
    assert (image[on_sphere] > 0.02).all()
    assert (image[~on_sphere] == 0).any()
