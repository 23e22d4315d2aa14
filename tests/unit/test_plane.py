"""``mrt_plane``: its equation, and its stand-in for stock integrators."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import sensor

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

VARIANTS = ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized", "scalar_rgb"]
in_variants = pytest.mark.parametrize("variant", VARIANTS, indirect=True)

PLANES = [((0, 1, 0), 0.2), ((3, 0, -3), 2.0), ((0.3, -0.2, 1), 4.0), ((0, 0, -1), -5.0), ((0, 2, 0), 0.0)]


def plane(normal: Any = (0, 1, 0), distance: float = 0.0, **parameters: Any) -> mi.Mesh:
    return mi.load_dict({"type": "mrt_plane", "normal": list(normal), "distance": distance, **parameters})


def unit(v: Any) -> np.ndarray:
    return np.asarray(v, dtype=float) / np.linalg.norm(v)


def ray(origin: np.ndarray, direction: np.ndarray) -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(*map(float, origin)), mi.Vector3f(*map(float, direction)))


def corners(mesh: mi.Mesh) -> np.ndarray:
    return np.array(mi.traverse(mesh)["vertex_positions"]).reshape(-1, 3)


@in_variants
def test_corners_are_a_square_on_the_plane(variant: str) -> None:
    """n · P + distance = 0 with the normal made one unit long and the distance as given."""
    for normal, distance in PLANES:
        mesh = plane(normal, distance, extent=10.0)
        points = corners(mesh)
        heights = points @ unit(normal) + distance
        np.testing.assert_allclose(heights, 0, atol=1e-5)  # float32 numbers of up to 10
        np.testing.assert_allclose(points.mean(axis=0), -distance * unit(normal), atol=1e-5)
        sides = np.roll(points, -1, axis=0) - points
        np.testing.assert_allclose(np.linalg.norm(sides, axis=-1), 10, rtol=1e-6)
        assert abs(sides[0] @ sides[1]) < 1e-4
        np.testing.assert_allclose(mesh.unit_normal, unit(normal), rtol=1e-15)
        assert mesh.distance == distance
        for axis in np.flatnonzero(np.abs(unit(normal)) == 1):  # planes across an axis stay so
            assert (points[:, axis] == np.float32(-distance * unit(normal)[axis])).all()


def test_texture_coordinates_are_lengths_from_the_foot() -> None:
    mesh = plane((0.3, -0.2, 1), 4.0)
    scene = mi.load_dict({"type": "scene", "plane": mesh})
    n = unit((0.3, -0.2, 1))
    s, t = mesh.tangents
    np.testing.assert_allclose([n @ s, n @ t, s @ t], 0, atol=1e-15)
    np.testing.assert_allclose(np.cross(s, t), n, atol=1e-15)
    for u, v in ((0, 0), (1.5, -2.5), (-30, 20)):
        point = -4 * n + u * s + v * t
        si = scene.ray_intersect(ray(point + n, -n))
        np.testing.assert_allclose(np.array(si.uv).ravel(), (u, v), atol=2e-5)


def test_a_light_just_behind_a_plane_is_hidden() -> None:
    scene = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": sensor([0, 0, 0.5], [0, 0, 0], (8, 6), up=[0, 1, 0]),
        "light": {"type": "mrt_light", "position": [0, 0, 1.0001]},
        "floor": {"type": "mrt_plane", "normal": [0, 0, 1]},
    }
    lit = mrt.render(scene, aa=1).image
    ceiling = {"type": "mrt_plane", "normal": [0, 0, 1], "distance": -1.0}
    assert lit.min() > 0 and mrt.render(scene | {"ceiling": ceiling}, aa=1).image.max() == 0
