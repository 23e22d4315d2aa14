"""``mrt_plane``: its equation, and its stand-in for stock integrators."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytestmark = pytest.mark.usefixtures("variant")

PLANES = [((0, 1, 0), 0.2), ((3, 0, -3), 2.0), ((0.3, -0.2, 1), 4.0), ((0, 0, -1), -5.0), ((0, 2, 0), 0.0)]


def plane(normal: Any, distance: float, **parameters: Any) -> mi.Mesh:
    return mi.load_dict({"type": "mrt_plane", "normal": list(normal), "distance": distance, **parameters})


def unit(v: Any) -> np.ndarray:
    return np.asarray(v, dtype=float) / np.linalg.norm(v)


@pytest.mark.parametrize(
    "variant", ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized", "scalar_rgb"], indirect=True
)
def test_corners_are_a_square_on_the_plane(variant):
    """n · P + distance = 0 with the normal made one unit long and the distance as given."""
    for normal, distance in PLANES:
        mesh = plane(normal, distance, extent=10.0)
        points = np.array(mi.traverse(mesh)["vertex_positions"]).reshape(-1, 3)
        heights = points @ unit(normal) + distance
        assert_allclose(heights, 0, atol=1e-5)  # float32 numbers of up to 10
        assert_allclose(points.mean(axis=0), -distance * unit(normal), atol=1e-5)
        sides = np.roll(points, -1, axis=0) - points
        assert_allclose(np.linalg.norm(sides, axis=-1), 10, rtol=1e-6)
        assert abs(sides[0] @ sides[1]) < 1e-4
        for axis in np.flatnonzero(np.abs(unit(normal)) == 1):  # planes across an axis stay so
            assert (points[:, axis] == np.float32(-distance * unit(normal)[axis])).all()
