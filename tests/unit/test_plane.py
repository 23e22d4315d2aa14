"""``mrt_plane``: its equation, and its stand-in for stock integrators."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytestmark = pytest.mark.usefixtures("variant")

PLANES = [((0, 1, 0), 0.2), ((3, 0, -3), 2.0), ((0.3, -0.2, 1), 4.0), ((0, 0, -1), -5.0)]


@pytest.mark.parametrize(
    "variant", ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized", "scalar_rgb"], indirect=True
)
def test_corners_are_a_square_on_the_plane(variant):
    """n · P + distance = 0 with the normal made one unit long and the distance as given."""
    for normal, distance in PLANES:
        mesh = mi.load_dict({"type": "mrt_plane", "normal": normal, "distance": distance, "extent": 10.0})
        points = np.array(mi.traverse(mesh)["vertex_positions"]).reshape(-1, 3)
        heights = points @ normal / np.linalg.norm(normal) + distance
        assert_allclose(heights, 0, atol=1e-5)  # float32 numbers of up to 10
        sides = np.roll(points, -1, axis=0) - points
        assert_allclose(np.linalg.norm(sides, axis=-1), 10, rtol=1e-6)
        assert abs(sides[0] @ sides[1]) < 1e-4
