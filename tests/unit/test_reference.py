"""The float64 tracer that judges the pictures, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cases import Cases
from numpy.testing import assert_allclose
from PIL import Image

from mrt_mitsuba import SceneError
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Mesh, Plane, Scene, Sphere
from mrt_mitsuba.validation.oracles.reference import reference_render

WOOD = Material(1.5, 0.3, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))
# A camera on the x axis, with one pixel: its ray runs along -x
ONE_PIXEL = {"width": 1, "height": 1}
ALONG_X = Camera((3, 0, 0), (0, 0, 0))

# Some dozen roundings of float64, some of them in exp and sqrt, on numbers of about 1
EXACT = {"rtol": 1e-12, "atol": 1e-14}


def scene(*things, camera: Camera = ALONG_X, lights=(), sky=(0.0, 0.0, 0.0)) -> Scene:
    kinds = {"spheres": Sphere, "planes": Plane, "cones": Cone, "cylinders": Cylinder, "meshes": Mesh}
    groups = {name: tuple(t for t in things if isinstance(t, kind)) for name, kind in kinds.items()}
    return Scene(camera=camera, sky=sky, lights=tuple(lights), **groups)


def pixel(the_scene: Scene, **settings) -> np.ndarray:
    return reference_render(the_scene, **ONE_PIXEL, **settings).image[0, 0]


budgets = Cases()
budgets(1.5, {}, 10)
budgets(0.9, {}, 10)
budgets(0.89, {}, 5)  # a bounce costs 10 - int(8.9) = 2
budgets(0.5, {}, 2)
budgets(0.0, {}, 1)
budgets(1.5, {"max_depth": 3}, 3)
budgets(0.5, {"bounce_budget": "plain", "max_depth": 4}, 4)


@pytest.mark.parametrize(("ior", "settings", "surfaces"), budgets)
def test_bounce_budget_between_two_mirrors(ior, settings, surfaces):
    """Straight between two parallel mirrors: a geometric series that ends with the budget."""
    # The lobe is so narrow that the lights, far from the mirror direction, are seen by the diffuse part alone
    material = Material(ior, 0.01, (0.5, 0.5, 0.5), (0.3, 0.3, 0.3))
    color = np.array([0.2, 0.4, 0.6])
    mirrors = Plane((1, 0, 0), 1, material), Plane((-1, 0, 0), 6, material)
    found = pixel(scene(*mirrors, lights=[Light((2, 4, 0), tuple(color))]), **settings)
    lit = [0.3 / np.pi * color * depth / np.hypot(depth, 4) for depth in (3, 4)]  # of both mirrors
    reflectance = 0.5 * ((ior - 1) / (ior + 1)) ** 2
    expected = sum(reflectance**i * lit[i % 2] for i in range(surfaces))
    assert_allclose(found, expected, **EXACT)


def test_a_surface_is_lit_on_its_outer_side_alone():
    """From within a ball, no light is seen behind its wall, nor what the wall would reflect."""
    light = Light((-9, 4, 0), (2.0, 2.0, 2.0))
    around = scene(Sphere((0, 0, 0), 5, WOOD), lights=[light], sky=(1.0, 1.0, 1.0))
    assert (pixel(around) == 0).all()
    before = scene(Sphere((-7, 0, 0), 5, WOOD), lights=[replace(light, position=(9, 4, 0))])
    assert (pixel(before) > 0).all()


CORNERS = np.array([(0, -1, -1), (0, -1, 3), (0, 3, -1)], float)
TRIANGLE = Mesh(CORNERS, np.array([[0, 2, 1]]), WOOD)


def test_triangles_show_the_nearest_texel(tmp_path):
    """v = 0 is the first row; one light along the normal sends back Kd / π."""
    rows = [[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]]
    Image.fromarray(np.array(rows, np.uint8)).save(tmp_path / "four.png")
    matte = Material(1, 1, (0, 0, 0), (0, 0, 0), str(tmp_path / "four.png"))
    uvs = np.array([(0, 0), (1, 0), (0, 1)], np.float32)
    texels = {(-0.5, -0.5): (1, 0, 0), (-0.5, 1.5): (0, 1, 0), (1.5, -0.5): (0, 0, 1)}
    for place, color in texels.items():
        camera = Camera((3, *place), (0, *place))
        mesh = replace(TRIANGLE, material=matte, uvs=uvs)
        found = pixel(scene(mesh, camera=camera, lights=[Light((1e9, 0, 0), (1, 1, 1))]))
        assert_allclose(found * np.pi, color, atol=1e-6)
    with pytest.raises(SceneError, match="textures on triangles only"):
        pixel(scene(Sphere((0, 0, 0), 1, matte)))
