"""Surfaces are not in their own shadow, however far the camera."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba.rendering.api import render


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


def test_moving_a_sphere_has_the_right_derivative(variant: str) -> None:
    """Of the light that comes back along fixed rays, against central differences."""
    integrator = mi.load_dict(
        {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
    )
    rng = np.random.default_rng(1)
    o = np.tile([0.0, 0.0, 4.0], (200, 1))
    d = rng.uniform(-0.5, 0.5, (200, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)

    def light(x: mi.Float) -> tuple[mi.Float, mi.Scene]:
        scene = mi.load_dict(
            {
                "type": "scene",
                "sphere": {"type": "sphere", "bsdf": {"type": "mrt_bsdf", "alpha": 0.3}},
                "light": {"type": "mrt_light", "position": [2, 3, 4]},
            }
        )
        parameters = mi.traverse(scene)
        parameters["sphere.to_world"] = mi.Transform4f().translate(mi.Point3f(x, 0.5 * x, 0))
        parameters.update()
        found = integrator.trace(scene, None, mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T))).direct[0]
        dr.eval(found)
        return found, scene  # which must outlive derivatives

    x, step = mi.Float(0), 1e-2
    dr.enable_grad(x)
    found, scene = light(x)
    dr.forward(x)
    derivative = np.array(dr.grad(found))
    del scene
    after, before = (np.array(light(mi.Float(shift))[0]) for shift in (step, -step))
    differences = (after - before) / (2 * step)
    assert np.abs(differences).max() > 0.1
    # step² times a third derivative of about 10; with the hit held on the sphere as it was, 1e-2 are missing
    np.testing.assert_allclose(derivative, differences, atol=1e-3)
