"""The float64 tracer that judges the pictures, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrt_mitsuba import SceneError
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Mesh, Plane, Scene, Sphere
from mrt_mitsuba.validation.oracles.reference import nearest, reference_render, unit

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


@pytest.mark.parametrize(
    ("ior", "settings", "surfaces"),
    [
        (1.5, {}, 10),
        (0.9, {}, 10),
        (0.89, {}, 5),  # a bounce costs 10 - int(8.9) = 2
        (0.5, {}, 2),
        (0.0, {}, 1),
        (1.5, {"max_depth": 3}, 3),
        (0.5, {"bounce_budget": "plain", "max_depth": 4}, 4),
    ],
)
def test_bounce_budget_between_two_mirrors(ior: float, settings: dict, surfaces: int) -> None:
    """Straight between two parallel mirrors: a geometric series that ends with the budget."""
    # The lobe is so narrow that the lights, far from the mirror direction, are seen by the diffuse part alone
    material, color = Material(ior, 0.01, (0.5, 0.5, 0.5), (0.3, 0.3, 0.3)), np.array([0.2, 0.4, 0.6])
    mirrors = Plane((1, 0, 0), 1, material), Plane((-1, 0, 0), 6, material)
    found = pixel(scene(*mirrors, lights=[Light((2, 4, 0), tuple(color))]), **settings)
    lit = [0.3 / np.pi * color * depth / np.hypot(depth, 4) for depth in (3, 4)]  # of both mirrors
    expected = sum((0.5 * ((ior - 1) / (ior + 1)) ** 2) ** i * lit[i % 2] for i in range(surfaces))
    np.testing.assert_allclose(found, expected, **EXACT)


CONE, TUBE = Cone((0, 1, 0), (0, 0, 0), 0.5, WOOD), Cylinder((0, -1, 0), (0, 2, 0), 0.5, WOOD)
TRIANGLE = Mesh(np.array([(0, -1, -1), (0, -1, 3), (0, 3, -1)], float), np.array([[0, 2, 1]]), WOOD)
NEAR, FAR = Sphere((0.5, 0, 0), 0.5, WOOD), Sphere((-2, 0, 0), 0.5, WOOD)


@pytest.mark.parametrize(
    ("things", "position", "target", "depth", "normal", "index"),
    [
        ((NEAR, FAR), (3, 0, 0), (0, 0, 0), 2, (1, 0, 0), 0),
        ((FAR, NEAR), (3, 0, 0), (0, 0, 0), 2, (1, 0, 0), 1),
        ((Sphere((0, 0, 0), 9, WOOD),), (3, 0, 0), (0, 0, 0), 12, (-1, 0, 0), 0),
        ((Plane((2, 0, 0), 5, WOOD), TUBE), (3, 4, 0), (0, 4, 0), 8, (1, 0, 0), 0),
        ((CONE,), (0.1, -3, 0), (0.1, 0, 0), 3, (0, -1, 0), 0),
        ((CONE,), (3, 0.2, 0), (0, 0.2, 0), 3 - 0.4, (2 / 5**0.5, 1 / 5**0.5, 0), 0),  # a slope of 1 over 0.5
        ((CONE,), (0.3, 3, 0), (0.3, 0, 0), 2.6, (2 / 5**0.5, 1 / 5**0.5, 0), 0),  # no disc at the apex
        ((CONE,), (3, 1.2, 0), (0, 1.2, 0), np.inf, (0, 0, 0), -1),
        ((TUBE,), (3, 0, 0), (0, 0, 0), 2.5, (1, 0, 0), 0),
        ((TUBE,), (0.2, 5, 0), (0.2, 0, 0), 3, (0, 1, 0), 0),
        ((TUBE,), (0.2, -5, 0), (0.2, 0, 0), 4, (0, -1, 0), 0),
        ((TUBE,), (0.6, 5, 0), (0.6, 0, 0), np.inf, (0, 0, 0), -1),
        ((TRIANGLE,), (3, 0.9, 0.9), (0, 0.9, 0.9), 3, (1, 0, 0), 0),
        ((TRIANGLE,), (3, 1.1, 1), (0, 1.1, 1), np.inf, (0, 0, 0), -1),
    ],
)
def test_a_ray_meets_the_nearest_thing(things, position, target, depth, normal, index) -> None:
    o = np.array([position], float)
    t, thing, n, _ = nearest(things, o, unit(target - o))
    assert t[0] == pytest.approx(depth, abs=1e-13) and thing[0] == index
    np.testing.assert_allclose(n[0], normal, atol=1e-13, rtol=0)


def test_triangles_show_the_nearest_texel(tmp_path: Path) -> None:
    """v = 0 is the first row; one light along the normal sends back Kd / π."""
    rows = [[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]]
    Image.fromarray(np.array(rows, np.uint8)).save(tmp_path / "four.png")
    matte = Material(1, 1, (0, 0, 0), (0, 0, 0), str(tmp_path / "four.png"))
    uvs = np.array([(0, 0), (1, 0), (0, 1)], np.float32)
    for place, color in (((-0.5, -0.5), (1, 0, 0)), ((-0.5, 1.5), (0, 1, 0)), ((1.5, -0.5), (0, 0, 1))):
        camera = Camera((3, *place), (0, *place))
        mesh = replace(TRIANGLE, material=matte, uvs=uvs)
        found = pixel(scene(mesh, camera=camera, lights=[Light((1e9, 0, 0), (1, 1, 1))]))
        np.testing.assert_allclose(found * np.pi, color, atol=1e-6)
    with pytest.raises(SceneError, match="textures on triangles only"):
        pixel(scene(Sphere((0, 0, 0), 1, matte)))


def test_no_light_is_negative_and_each_is_seen_by_itself() -> None:
    """With a roughness of the wrong sign, Smith's term is negative where the eye is low, the light high."""
    wrong = Plane((1, 2, 0), 0, replace(WOOD, alpha=-1.5, diffuse=(0, 0, 0)))
    assert (pixel(scene(wrong, lights=[Light((1.6, 1.7, 0), (1, 1, 1))]), clamp=False) == 0).all()
    ball, lights = Sphere((0, 0, 0), 1, WOOD), [Light((x, 1, 0), (1, 1, 1)) for x in (5, -5)]
    hashes = [
        reference_render(scene(ball, lights=order), **ONE_PIXEL).lights for order in (lights, lights[::-1])
    ]
    assert hashes[0] != hashes[1]
