"""The float64 reference tracer against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrt_mitsuba import SceneError, UsageError, runtime
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Mesh, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.oracles.reference import CHOICES, camera_directions, reference_render
from mrt_mitsuba.validation.tools.sensitivity import sensitivity

needs_llvm = pytest.mark.skipif(runtime.obstacle("llvm_ad_rgb") is not None, reason="no LLVM to run kernels")

WOOD = Material(1.5, 0.3, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))
# A camera on the x axis, with one pixel: its ray runs along -x
ONE_PIXEL = {"width": 1, "height": 1, "device": "scalar"}
ALONG_X = Camera((3, 0, 0), (0, 0, 0))

# Two dozen roundings of float64, some of them in exp and sqrt, on numbers of about 1
EXACT = {"rtol": 1e-13, "atol": 1e-15}


def scene(
    *things: Sphere | Plane | Cone | Cylinder, camera: Camera = ALONG_X, lights=(), sky=(0.0, 0.0, 0.0)
) -> Scene:
    kinds = {
        name: tuple(t for t in things if isinstance(t, kind))
        for name, kind in (("spheres", Sphere), ("planes", Plane), ("cones", Cone), ("cylinders", Cylinder))
    }
    return Scene(camera=camera, sky=sky, lights=tuple(lights), **kinds)


def pixel(the_scene: Scene, **settings) -> np.ndarray:
    return reference_render(the_scene, **ONE_PIXEL, **settings).image[0, 0]


def report_bsdf(normal, to_light, to_viewer, m: Material, fresnel: str) -> np.ndarray:
    """The report's BSDF [3] between two directions in world space, in 50 digits."""
    n = np.array(normal) / np.linalg.norm(normal)
    s = np.cross(n, (0, 0, 1))
    s /= np.linalg.norm(s)
    frame = np.stack([s, np.cross(n, s), n])
    l, v = frame @ to_light, frame @ to_viewer  # noqa: E741
    lobe = float(exact.specular_bsdf(v, l, m.alpha, form=fresnel, int_ior=m.ior))
    return np.array(m.diffuse) / np.pi + np.array(m.specular) * lobe


@pytest.mark.parametrize("fresnel", CHOICES["fresnel"])
@pytest.mark.parametrize("alpha", [0.3, 0.9, -0.4])
def test_a_lit_pixel_is_the_formula_of_the_report(fresnel: str, alpha: float) -> None:
    material = replace(WOOD, alpha=alpha)
    plane = Plane((1, 0.75, 0.2), 0, material)
    light = Light((2, 2, -0.5), (0.9, 0.5, 0.7))
    n = np.array(plane.normal) / np.linalg.norm(plane.normal)
    cos_light = n @ light.position / np.linalg.norm(light.position)
    f = report_bsdf(plane.normal, light.position, ALONG_X.position, material, fresnel)
    expected = np.array(light.color) * f * cos_light
    assert expected.min() > 0 and expected.max() < 1  # else the clamp would hide the formula
    np.testing.assert_allclose(pixel(scene(plane, lights=[light]), fresnel=fresnel), expected, **EXACT)


def test_mirror_shows_the_sky_by_fresnel() -> None:
    sky = (0.2, 0.4, 0.8)
    plane = Plane((1, 0.75, 0.2), 0, WOOD)
    c = 1 / np.linalg.norm(plane.normal)
    g = np.sqrt(WOOD.ior**2 - 1 + c**2)
    rs, rp = (c - g) / (c + g), (g - WOOD.ior**2 * c) / (g + WOOD.ior**2 * c)
    expected = np.array(sky) * WOOD.specular * (rs**2 + rp**2) / 2
    np.testing.assert_allclose(pixel(scene(plane, sky=sky)), expected, **EXACT)
    np.testing.assert_allclose(pixel(scene(sky=sky)), sky, **EXACT)


def test_mirror_image_is_the_mirrored_scene() -> None:
    """What a perfect mirror shows is what the scene behind it, mirrored, would show."""

    def mirrored(p):
        n = np.array(mirror.normal) / np.linalg.norm(mirror.normal)
        return tuple(np.array(p) - 2 * (n @ p + mirror.distance) * n)

    mirror = Plane((1, 0.2, -0.1), 1, Material(1.5, 1e-4, (1, 1, 1), (0, 0, 0)))
    ball, light = Sphere((4.5, 1.2, -0.5), 1.2, WOOD), Light((2, 3, 1), (0.8, 0.7, 0.6))
    settings = {"width": 24, "height": 18, "fresnel": "unity", "device": "scalar"}
    shown = reference_render(
        scene(mirror, ball, lights=[light], sky=(0.1, 0.2, 0.3)), max_depth=2, **settings
    )
    behind = scene(
        replace(ball, center=mirrored(ball.center)),
        lights=[replace(light, position=mirrored(light.position))],
        sky=(0.1, 0.2, 0.3),
    )
    expected = reference_render(behind, max_depth=1, **settings)
    assert (shown.object_id == 1).all()  # only the mirror is in direct view: spheres come first, planes after
    assert 20 < (expected.object_id == 0).sum() < 300
    # the robust offset is 1e-10 of the size of the coordinates
    np.testing.assert_allclose(shown.image, expected.image, rtol=1e-7, atol=1e-9)


def test_each_light_is_clamped_by_itself() -> None:
    plane = Plane((1, 0, 0), 0, replace(WOOD, specular=(0, 0, 0), diffuse=(0.5, 5, 50)))
    # both lights at 60 degrees: f cos = Kd / 2π
    lights = [Light((1, 3**0.5, 0), (1, 1, 1)), Light((1, 0, 3**0.5), (1, 0.1, 1))]
    unclamped = np.array([0.5, 5, 50]) / (2 * np.pi)
    np.testing.assert_allclose(
        pixel(scene(plane, lights=lights), clamp=False), unclamped * [2, 1.1, 2], **EXACT
    )
    expected = [2 * unclamped[0], unclamped[1] * 1.1, 2]
    np.testing.assert_allclose(pixel(scene(plane, lights=lights)), expected, **EXACT)


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
    material = Material(ior, 0.01, (0.5, 0.5, 0.5), (0.3, 0.3, 0.3))
    color = np.array([0.2, 0.4, 0.6])
    mirrors = scene(
        Plane((1, 0, 0), 1, material), Plane((-1, 0, 0), 6, material), lights=[Light((2, 4, 0), tuple(color))]
    )
    result = reference_render(mirrors, **ONE_PIXEL, **settings)
    assert result.bounces[0, 0] == surfaces - 1
    reflectance = 0.5 * ((ior - 1) / (ior + 1)) ** 2
    lit = [0.3 / np.pi * color * depth / np.hypot(depth, 4) for depth in (3, 4)]  # of both mirrors
    expected = sum(reflectance**i * lit[i % 2] for i in range(surfaces))
    np.testing.assert_allclose(result.image[0, 0], expected, **EXACT)


def test_light_behind_the_surface_or_an_object_is_not_seen() -> None:
    ball = Sphere((0, 0, 0), 1, WOOD)
    front, behind = Light((5, 1, 0), (1, 1, 1)), Light((-5, 1, 0), (1, 1, 1))
    assert (pixel(scene(ball, lights=[behind])) == 0).all()
    assert (pixel(scene(ball, lights=[front])) > 0).all()
    between = Sphere((3, 0.5, 0), 0.4, WOOD)
    beyond = Sphere((9, 1.8, 0), 0.4, WOOD)
    assert (pixel(scene(ball, between, lights=[front], camera=Camera((3, 0, 0), (0, 0, 0)))) == 0).all()
    lit = pixel(scene(ball, lights=[front]))
    np.testing.assert_array_equal(pixel(scene(ball, beyond, lights=[front])), lit)


def test_surfaces_are_dark_from_behind() -> None:
    sky = (1.0, 1.0, 1.0)
    plane = Plane((-1, 0, 0), 0, WOOD)
    assert (pixel(scene(plane, lights=[Light((-1, 1, 0), sky), Light((1, 1, 0), sky)], sky=sky)) == 0).all()


def test_nearest_object_wins_whatever_the_order() -> None:
    near, far = Sphere((0.5, 0, 0), 0.5, WOOD), Sphere((-2, 0, 0), 0.5, WOOD)
    wall = Plane((1, 0, 0), 5, WOOD)
    for things, index in (((near, far, wall), 0), ((far, near, wall), 1), ((wall, far), 0), ((wall,), 0)):
        result = reference_render(scene(*things), **ONE_PIXEL)
        assert result.object_id[0, 0] == index
    assert reference_render(scene(near, far, wall), **ONE_PIXEL).depth[0, 0] == pytest.approx(2, abs=1e-15)
    np.testing.assert_allclose(
        reference_render(scene(near), **ONE_PIXEL).normal[0, 0], [1, 0, 0], atol=1e-15, rtol=0
    )
    nothing = reference_render(scene(), **ONE_PIXEL)
    assert nothing.object_id[0, 0] == -1 and nothing.depth[0, 0] == np.inf


def test_picture_is_the_right_way_up_and_mirrored_as_in_the_original() -> None:
    """Columns grow along up × forward, rows downwards: forward is -x, up y, so columns grow along z."""
    d = camera_directions(ALONG_X, 4, 2, np.array([0.0, 4.0, 2.0]), np.array([1.0, 1.0, 2.0]))
    tan = np.tan(np.radians(30))
    expected = np.array([[-1, 0, -tan], [-1, 0, tan], [-1, tan / 2, 0]])
    np.testing.assert_allclose(d / -d[:, :1], expected, atol=1e-15, rtol=0)
    result = reference_render(scene(Sphere((0, 0.8, 0.6), 0.3, WOOD)), width=32, height=24, device="scalar")
    rows, columns = np.nonzero(result.object_id == 0)
    # the sphere's centre projects to u = 0.6 / 3 / tan 30° of half the width, v likewise
    assert columns.mean() + 0.5 == pytest.approx(16 + 16 * 0.2 / tan, abs=0.5)
    assert rows.mean() + 0.5 == pytest.approx(12 - 16 * 0.8 / 3 / tan, abs=0.5)


def test_lattice() -> None:
    """Samples of the report's lattice are pixel centres displaced by i / aa; their mean is the picture."""
    row = {"width": 24, "height": 18, "device": "scalar"}
    the_scene = report_scene(0)
    whole = reference_render(the_scene, aa=2, **row)
    parts = [
        reference_render(the_scene, displacement=(x, y), **row).image for x in (0, 0.5) for y in (0, 0.5)
    ]
    np.testing.assert_allclose(whole.image, np.mean(parts, axis=0), **EXACT)
    centered = reference_render(the_scene, aa=2, lattice="centered", displacement=(0.25, 0.25), **row)
    np.testing.assert_allclose(centered.image, whole.image, **EXACT)


def test_cone_has_a_base_and_casts_a_shadow() -> None:
    cone = Cone((0, 1, 0), (0, 0, 0), 0.5, WOOD)
    floor = Plane((0, 1, 0), 0.5, WOOD)
    below = Camera((0, -3, 0.1), (0, 0, 0.1), up=(1, 0, 0))
    base = reference_render(scene(cone, camera=below), **ONE_PIXEL)
    assert base.object_id[0, 0] == 0
    assert base.depth[0, 0] == pytest.approx(3, abs=1e-14)
    np.testing.assert_allclose(base.normal[0, 0], [0, -1, 0], atol=1e-14, rtol=0)
    # side: slope 1 over 0.5, so the normal at height y is (1, 0.5, 0) / |…|
    side = reference_render(scene(cone, camera=Camera((3, 0.2, 0), (0, 0.2, 0))), **ONE_PIXEL)
    np.testing.assert_allclose(side.normal[0, 0], np.array([2, 1, 0]) / 5**0.5, atol=1e-14, rtol=0)
    assert side.depth[0, 0] == pytest.approx(3 - 0.4, abs=1e-14)
    light = Light((0, 4, 0), (1, 1, 1))
    camera = Camera((3, 2, 0), (0.2, -0.5, 0))
    shadowed = scene(floor, cone, camera=camera, lights=[light])
    assert (pixel(shadowed, max_depth=1) == 0).all()
    assert (pixel(scene(floor, camera=camera, lights=[light])) > 0).all()


def test_cylinder_is_closed() -> None:
    def hit(position, target):
        result = reference_render(scene(cylinder, camera=Camera(position, target, up=(0, 0, 1))), **ONE_PIXEL)
        return result.depth[0, 0], result.normal[0, 0]

    cylinder = Cylinder((0, -1, 0), (0, 2, 0), 0.5, WOOD)
    for position, target, depth, normal in [
        ((3, 0, 0), (0, 0, 0), 2.5, (1, 0, 0)),
        ((0.2, 5, 0), (0.2, 0, 0), 3, (0, 1, 0)),
        ((0.2, -5, 0), (0.2, 0, 0), 4, (0, -1, 0)),
    ]:
        found = hit(position, target)
        assert found[0] == pytest.approx(depth, abs=1e-14)
        np.testing.assert_allclose(found[1], normal, atol=1e-14, rtol=0)
    assert hit((0.6, 5, 0), (0.6, 0, 0))[0] == np.inf


def test_what_it_cannot_draw_is_refused() -> None:
    textured = replace(WOOD, texture="wood.png")
    mesh = Mesh(np.zeros((3, 3), np.float32), np.zeros((1, 3), np.uint32), WOOD)
    for wrong in (scene(Sphere((0, 0, 0), 1, textured)), replace(scene(), meshes=(mesh,))):
        with pytest.raises(SceneError, match="no meshes and no textures"):
            pixel(wrong)


@needs_llvm
@pytest.mark.parametrize("number", [3, 9])
def test_both_backends_draw_the_same(number: int) -> None:
    size = {"width": 32, "height": 24}
    one, other = (reference_render(report_scene(number), device=d, **size) for d in ("scalar", "llvm"))
    np.testing.assert_array_equal(one.path, other.path)
    np.testing.assert_array_equal(one.lights, other.lights)
    # the stiffest lobe of scene 3 (alpha 0.0018) enlarges a rounding by 1e6
    np.testing.assert_allclose(one.image, other.image, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_robust_picture_does_not_depend_on_the_unit_of_length(scale: float) -> None:
    def scaled(v):
        return tuple(scale * x for x in v)

    the_scene = report_scene(3)
    other = replace(
        the_scene,
        camera=replace(
            the_scene.camera, position=scaled(the_scene.camera.position), target=scaled((0, 0.3, 0))
        ),
        lights=tuple(replace(x, position=scaled(x.position)) for x in the_scene.lights),
        spheres=tuple(
            replace(x, center=scaled(x.center), radius=scale * x.radius) for x in the_scene.spheres
        ),
        planes=tuple(replace(x, distance=scale * x.distance) for x in the_scene.planes),
    )
    size = {"width": 32, "height": 24, "device": "scalar"}
    one, two = reference_render(the_scene, **size), reference_render(other, **size)
    np.testing.assert_array_equal(one.path, two.path)
    np.testing.assert_allclose(one.image, two.image, rtol=1e-9, atol=1e-12)  # as between the backends
    # the original's absolute distances are of no use there: far too long, or all is out of reach
    lost = reference_render(other, self_intersection="original", **size)
    assert (np.abs(lost.image - one.image).max(axis=-1) > 1 / 255).mean() > 0.5


def test_sensitivity_names_what_changes() -> None:
    """A ball before a wall, lit from the side: outline, shadow of the ball on the wall, and nothing else."""
    ball, wall = Sphere((0, 0, 0), 0.5, WOOD), Plane((1, 0, 0), 1, WOOD)
    the_scene = scene(ball, wall, lights=[Light((3, 3, 0), (1, 1, 1))])
    found = sensitivity(the_scene, width=40, height=40, displacement=0.5, max_depth=1, device="scalar")
    outline = found.reference.object_id == 0
    inside = np.zeros_like(outline)
    inside[1:-1, 1:-1] = (
        outline[:-2, 1:-1] & outline[2:, 1:-1] & outline[1:-1, :-2] & outline[1:-1, 2:] & outline[1:-1, 1:-1]
    )
    assert found.silhouette.any() and found.shadow.any()
    assert not (found.silhouette & inside).any()
    assert not (found.silhouette & found.shadow).any()
    assert np.median(found.spread[found.silhouette]) > 10 * np.median(found.spread)


@pytest.mark.parametrize(
    "wrong", [{"fresnel": "exact"}, {"lattice": "x"}, {"aa": 0}, {"no_such": 1}, {"bounce_budget": "x"}]
)
def test_unknown_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        pixel(scene(), **wrong)
