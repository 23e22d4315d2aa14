"""Exact cones and cylinders under ``mrt_whitted``: the tree, the picture, shadows, variants."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.plugins import intersect
from mrt_mitsuba.plugins.quadric_kinds import KINDS
from mrt_mitsuba.plugins.quadrics import Quadrics
from mrt_mitsuba.plugins.tree import Tree
from mrt_mitsuba.scene.model import Camera, Capsule, Cone, Cylinder, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene

MATTE = Material(0.5, 0.5, (0, 0, 0), (0.8, 0.8, 0.8))
GLOSSY = Material(1.5, 0.2, (0.5, 0.5, 0.5), (0.3, 0.4, 0.5))


@pytest.fixture(autouse=True)
def _vectorised() -> Iterator[None]:
    runtime.use("llvm_ad_rgb")
    yield
    runtime.use("llvm_ad_rgb")


def random_shapes(count: int, seed: int = 1) -> list:
    """Cones and cylinders, some of them open, of sizes over two decades."""
    rng = np.random.default_rng(seed)
    shapes = []
    for k in range(count):
        end0 = rng.uniform(-10, 10, 3)
        size = 10 ** rng.uniform(-1.5, 0.5)
        end1 = end0 + rng.normal(size=3) * size
        kind = {"type": "mrt_cone", "apex": end0.tolist(), "base_center": end1.tolist()}
        if k % 2:
            kind = {"type": "mrt_cylinder", "p0": end0.tolist(), "p1": end1.tolist()}
        more = {"radius": float(size * rng.uniform(0.1, 1)), "segments": 3, "capped": bool(k % 3)}
        if k % 5 == 4:
            kind["type"] = "mrt_capsule"
            kind = dict(zip(("type", "p0", "p1"), kind.values(), strict=True))
            del more["capped"]
        shapes.append(mi.load_dict({**kind, **more}))
    return shapes


def random_rays(count: int, seed: int = 2):
    rng = np.random.default_rng(seed)
    o, d = rng.uniform(-12, 12, (3, count)).astype(np.float32), rng.normal(size=(3, count)).astype(np.float32)
    d[0, ::7], d[1, ::11] = 0, 0  # along planes of the axes, where box tests divide by nothing
    d[2, ::77] = 1
    return mi.Ray3f(mi.Point3f(o), mi.Vector3f(d), dr.opaque(mi.Float, 1e30), 0, [])


@pytest.mark.parametrize("count", [1, 2, 3, 100, 257])
def test_tree_finds_what_a_loop_over_all_finds(count: int) -> None:
    shapes, ray = random_shapes(count), random_rays(50_000)
    nearest = dr.full(mi.Float, 1e30, 50_000)
    for shape in shapes:
        exact = shape.frame()
        rows = (mi.Vector3f(row) for row in (exact.x, exact.y, exact.z))
        frame = intersect.Frame(mi.Point3f(exact.origin), *rows, exact.extent)
        dr.make_opaque(frame.origin, frame.x, frame.y, frame.z)
        nearest = dr.minimum(nearest, KINDS[shape.kind].intersect(ray.o, ray.d, frame).t)
        dr.eval(nearest)
    quadrics = Quadrics(shapes)
    t, _, _ = quadrics.intersect(ray, mi.Bool(True))
    # The same numbers through the same formulas: equal but for the order of additions in another kernel
    np.testing.assert_allclose(t.numpy(), nearest.numpy(), rtol=1e-5)
    assert dr.all(quadrics.occluded(ray, mi.Bool(True)) == (nearest < 1e30))
    ray.maxt = nearest * 0.999
    assert dr.none(quadrics.occluded(ray, mi.Bool(True)))
    assert dr.all(quadrics.intersect(ray, mi.Bool(False))[0] == ray.maxt)


@pytest.mark.parametrize("count", [1, 2, 5, 64, 1000])
def test_tree_holds_every_box_once_and_halves_evenly(count: int) -> None:
    low = np.random.default_rng(3).normal(size=(count, 3))
    tree = Tree(np.stack([low, low + 0.1], axis=1))
    assert len(set(tree.leaf_of.tolist())) == count
    assert tree.leaves == 1 << max(1, (count - 1).bit_length())
    sides = np.bincount(tree.leaf_of // max(1, tree.leaves // 2), minlength=2)[:2]
    assert count == 1 or abs(sides[0] - sides[1]) <= 1


def group_of(kind: str, ends: np.ndarray, radii: np.ndarray) -> Quadrics:
    """Quadrics of cones or cylinders from arrays [n, 2, 3] and [n]."""
    numbers = np.concatenate([ends.reshape(-1, 6), radii[:, None]], axis=1).astype(np.float32)
    return Quadrics([mi.load_dict({"type": "mrt_group", "kind": kind, "numbers": mi.Bitmap(numbers)})])


def nearest_of_all(kind: str, ends: np.ndarray, radii: np.ndarray, o: np.ndarray, d: np.ndarray):
    """Distances [N] in float64 by a loop over all objects, and those with every object a fiftieth thinner."""
    from drjit.llvm.ad import Array3f64, Float64

    make, meet = (getattr(intersect, name) for name in (f"{kind}_frame", f"intersect_{kind}"))
    o, d = Array3f64(o.T.astype(float)), Array3f64(d.T.astype(float))
    found = []
    for shrink in (1.0, 0.98):
        best = dr.full(Float64, np.inf, dr.width(o))
        for (p0, p1), radius in zip(ends.astype(np.float32).tolist(), radii.astype(np.float32), strict=True):
            frame = make(Array3f64(*p0), Array3f64(*p1), dr.opaque(Float64, float(radius) * shrink))
            dr.make_opaque(frame.origin, frame.x, frame.y, frame.z)
            best = dr.minimum(best, meet(o, d, frame).t)
            dr.eval(best)
        found.append(best.numpy())
    return found


def disagreements(t: np.ndarray, exact: np.ndarray, thinner: np.ndarray) -> np.ndarray:
    """Where float32 found another object, or none, [N].

    It moves a ray sideways by some roundings of the way to the object: from 1e4 sizes away, by up to a
    hundredth of the radius. So where a thinner object would be met elsewhere, it may go either way.
    """
    same = np.isclose(t, exact, rtol=1e-2) | (np.isinf(t) & np.isinf(exact))
    grazing = ~(np.isclose(exact, thinner, rtol=0.1) | (np.isinf(exact) & np.isinf(thinner)))
    return ~same & ~grazing


@pytest.mark.parametrize("kind", ["cone", "cylinder", "capsule"])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("place", ["among", "inside", "at the surface", "far away"])
def test_search_against_float64(kind: str, scale: float, place: str) -> None:
    """120 overlapping objects of sizes over three decades; ``far away`` is 1e4 times the size of one."""
    rng = np.random.default_rng(8)
    count, rays = 120, 20_000
    sizes = 10 ** rng.uniform(-2, 1, count)
    start = rng.uniform(-3, 3, (count, 3))
    ends = np.stack([start, start + rng.normal(size=(count, 3)) * sizes[:, None]], axis=1)
    radii = sizes * rng.uniform(0.1, 1, count)
    d = rng.normal(size=(rays, 3))
    which = rng.integers(0, count, rays)
    inner = ends[which].mean(axis=1)
    if place == "among":
        o = rng.uniform(-4, 4, (rays, 3))
    elif place == "inside":
        o = inner + rng.normal(size=(rays, 3)) * 0.05 * radii[which, None]
    elif place == "at the surface":  # a hundredth of the radius off it
        axis = np.diff(ends[which], axis=1)[:, 0]
        out = np.cross(axis, rng.normal(size=(rays, 3)))
        half = 0.5 if kind == "cone" else 1.0
        o = inner + out / np.linalg.norm(out, axis=1, keepdims=True) * (radii[which] * half * 1.01)[:, None]
    else:
        o = inner + 1e4 * sizes[which, None] * d / np.linalg.norm(d, axis=1, keepdims=True)
        d = inner + rng.normal(size=(rays, 3)) * 0.3 * radii[which, None] - o
    o, d, ends, radii = (np.float32(x) for x in (o * scale, d, ends * scale, radii * scale))
    quadrics = group_of(kind, ends, radii)
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T), dr.opaque(mi.Float, 2.0**127), 0, [])
    t = np.array(quadrics.intersect(ray, mi.Bool(True))[0], float)
    t[t > 1e38] = np.inf
    exact, thinner = nearest_of_all(kind, ends, radii, o, d)
    wrong = disagreements(t, exact, thinner)
    assert np.isfinite(exact).mean() > 0.3
    assert wrong.mean() < 2e-4
    blocked = np.array(quadrics.occluded(ray, mi.Bool(True)))
    assert (blocked == np.isfinite(t)).all()
    # The comparison has power: what one ray in a hundred overlooks is seen
    assert disagreements(np.where(np.arange(rays) % 100 == 0, np.inf, t), exact, thinner).mean() > 2e-4


def test_equal_objects_in_one_place_hide_nothing() -> None:
    """An open tube around a cone of the same length and radius: their boxes are one and the same."""
    tube = mi.load_dict({"type": "mrt_cylinder", "p0": [0, 0, 0], "p1": [0, 0, 1], "capped": False})
    twins = [tube] * 3 + [mi.load_dict({"type": "mrt_cone", "apex": [0, 0, 0], "base_center": [0, 0, 1]})] * 2
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.6, 0.6, (2, 10_000))
    o, d = mi.Point3f(x, y, -2), mi.Vector3f(0, 0, 1)
    ray = mi.Ray3f(o, d, dr.opaque(mi.Float, 1e30, 10_000), 0, [])
    t = Quadrics(twins).intersect(ray, mi.Bool(True))[0].numpy()
    np.testing.assert_allclose(t, 2 + np.hypot(x, y), rtol=1e-5)  # the side of the cone


def test_a_large_object_among_small_ones() -> None:
    """Before, behind and around the small ones, from outside and from within it."""
    rng = np.random.default_rng(6)
    start = rng.uniform(-1, 1, (50, 3))
    ends = np.stack([start, start + rng.normal(size=(50, 3)) * 0.2], axis=1)
    ends = np.concatenate([ends, [[[0, 0, -60], [0, 0, 0.5]]]])
    radii = np.append(np.full(50, 0.1), 40.0)
    o, d = (np.float32(rng.normal(size=(20_000, 3)) * size) for size in (3, 1))
    quadrics = group_of("cylinder", ends, radii)
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T), dr.opaque(mi.Float, 1e30), 0, [])
    t = np.array(quadrics.intersect(ray, mi.Bool(True))[0], float)
    t[t > 1e29] = np.inf
    assert disagreements(t, *nearest_of_all("cylinder", ends, radii, o, d)).mean() < 2e-4


def scene_9_depths(width: int, height: int) -> np.ndarray:
    """Distances from the eye in scene 9, [H, W], by textbook formulas in float64; the cone is upright."""
    scene = report_scene(9)
    (cone,), eye = scene.cones, np.array(scene.camera.position, float)
    z = -eye / np.linalg.norm(eye)
    x = np.cross(scene.camera.up, z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    half = np.tan(np.radians(scene.camera.hfov / 2))
    right = (np.arange(width) + 0.5) / width * 2 - 1
    up = (1 - (np.arange(height) + 0.5) / height * 2) * height / width
    d = z + half * (right[None, :, None] * x + up[:, None, None] * y)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    apex, base = np.array(cone.apex, float), np.array(cone.base_center, float)
    slope = cone.radius / (apex[1] - base[1])
    p = eye - apex
    metric = np.array([1, -(slope**2), 1])
    a, b, c = (d * d * metric).sum(-1), (d * p * metric).sum(-1), (p * p * metric).sum(-1)
    found = [np.where(d[..., 1] < 0, -eye[1] / d[..., 1], np.inf)]  # the plane y = 0
    with np.errstate(invalid="ignore"):
        for sign in (1, -1):
            t = (-b + sign * np.sqrt(b * b - a * c)) / a
            height_there = p[1] + t * d[..., 1]
            found.append(
                np.where((height_there <= 0) & (height_there >= base[1] - apex[1]) & (t > 0), t, np.inf)
            )
    t = (base[1] - eye[1]) / d[..., 1]
    off = eye + t[..., None] * d - base
    found.append(np.where((np.hypot(off[..., 0], off[..., 2]) <= cone.radius) & (t > 0), t, np.inf))
    return np.min(found, axis=0)


def test_depth_of_scene_9() -> None:
    """99.5 % of pixels within 2e-6 relative; silhouettes, less than 0.02 % of pixels, may be off by more."""
    depth = mrt.render(9, width=800, height=600, aa=1, layers=["depth"]).layers["depth.Z"]
    error = np.abs(depth / scene_9_depths(800, 600) - 1)
    assert np.quantile(error, 0.995) < 2e-6
    assert np.mean(error > 1e-3) < 2e-4


def scene_of(*, camera: Camera, light=(0.0, 10.0, 0.0), material=MATTE, **shapes) -> Scene:
    return Scene(camera=camera, sky=(0, 0, 0), lights=(Light(light, (1, 1, 1)),), **shapes)


def test_base_is_there() -> None:
    """Seen and lit from below, a cone is a disc of one brightness, Kd/π · cos."""
    cone = Cone((0, 1, 0), (0, 0, 0), 0.5, MATTE)
    camera = Camera((0, -4, 0), (0, 0, 0), (0, 0, 1), hfov=30)
    scene = scene_of(camera=camera, light=(0, -1e4, 0), cones=(cone,))
    image = mrt.render(scene, width=101, height=101, aa=1).image
    assert image[50, 50] == pytest.approx([0.8 / np.pi] * 3, rel=1e-5)
    lit = image[..., 0] > 0
    radius = np.sqrt(lit.sum() / np.pi)  # pixels
    assert radius == pytest.approx(0.5 / 4 / np.tan(np.radians(15)) * 50.5, rel=0.02)  # a pixel at the rim
    assert np.ptp(image[lit]) < 1e-5


@pytest.mark.parametrize("shape", ["cone", "cylinder"])
def test_shadow_on_a_plane(shape: str) -> None:
    """Under a light high above, the shadow on the ground is a disc of the shape's radius."""
    objects = {"cones": (Cone((0, 1, 0), (0, 0.5, 0), 0.5, MATTE),)}
    if shape == "cylinder":
        objects = {"cylinders": (Cylinder((0, 1, 0), (0, 0.5, 0), 0.5, MATTE),)}
    camera = Camera((2.5, 0.3, 0), (0, 0, 0), (0, 1, 0), hfov=60)  # under the shape, above the plane
    scene = scene_of(camera=camera, light=(0, 1e4, 0), planes=(Plane((0, 1, 0), 0, MATTE),), **objects)
    result = mrt.render(scene, width=400, height=100, aa=1, layers=["depth", "normal"])
    ground, depth = np.array(result.layers["normal.Y"]) > 0.999, result.layers["depth.Z"]
    half = np.tan(np.radians(30))
    z = -np.array([2.5, 0.3, 0]) / np.hypot(2.5, 0.3)
    x = np.array([0, 0, 1])
    y = np.cross(z, x)
    right = ((np.arange(400) + 0.5) / 200 - 1)[None, :, None]
    up = ((1 - (np.arange(100) + 0.5) / 50) * 0.25)[:, None, None]
    d = z + half * (right * x + up * y)
    p = np.array([2.5, 0.3, 0]) + d / np.linalg.norm(d, axis=-1, keepdims=True) * depth[..., None]
    ground &= np.abs(p[..., 1]) < 1e-4
    r = np.hypot(p[..., 0], p[..., 2])
    inside, outside = ground & (r < 0.499), ground & (r > 0.501)
    assert inside.sum() > 500 and outside.sum() > 1000
    assert result.image[inside].max() == 0
    assert result.image[outside].min() > 0.1


def everything(material: Material = GLOSSY) -> Scene:
    return Scene(
        camera=Camera((3, 2, 4), (0, 0.4, 0)),
        sky=(0.2, 0.3, 0.7),
        lights=(Light((3, 5, 1), (1.5, 1.5, 1.5)), Light((-2, 4, 5), (1, 1, 1))),
        spheres=(Sphere((0.2, 0.4, 1.2), 0.4, material),),
        planes=(Plane((0, 1, 0), 0, material),),
        cones=(
            Cone((-0.5, 1.5, 0), (-0.4, 0, 0.1), 0.6, material),
            Cone((2, 0, 0), (1.2, 0.5, 0.1), 0.4, MATTE),
        ),
        cylinders=(Cylinder((1, 0, -1), (0.7, 1.2, -1), 0.4, material),),
        capsules=(Capsule((-1.2, 0.3, 1), (-0.4, 0.2, 1.6), 0.2, material),),
    )


def test_variants_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    size = {"width": 60, "height": 40, "aa": 1}
    monkeypatch.setattr(
        runtime, "warn_if_slow", lambda: None
    )  # it warns once, and another test waits for that
    scalar = mrt.render(everything(), **size, variant="scalar_rgb").image
    vector = mrt.render(everything(), **size, variant="llvm_ad_rgb").image
    # float32 both: but for a pixel at a silhouette or a shadow's edge, roundings only
    assert np.quantile(np.abs(scalar - vector), 0.995) < 1e-4


def test_exact_shapes_look_like_fine_meshes() -> None:
    """Against the meshes that other integrators see, through ``direct``: one light, no mirrors, no clamp."""
    scene = everything(MATTE)
    left_out = ("sky", "light_1", "plane_0", "integrator")
    nodes = {
        name: node for name, node in scene.to_dict(width=160, height=120).items() if name not in left_out
    }
    for node in nodes.values():
        if isinstance(node, dict) and node["type"] in ("mrt_cone", "mrt_cylinder"):
            node["segments"] = 1024
    exact = mrt.render(nodes, aa=1, integrator={"type": "mrt_whitted", "clamp": False}).image
    mesh = mrt.render(nodes, aa=1, integrator="direct").image
    assert exact.max() > 0.2
    # The normals of a mesh are wrong near an apex, by half a turn of 2π/1024
    assert np.quantile(np.abs(exact - mesh), 0.97) < 2e-3
    assert np.abs(exact.mean() / mesh.mean() - 1) < 5e-3


def test_no_cone_no_cone_code() -> None:
    scene = mi.load_dict(report_scene(0).to_dict())
    assert scene.integrator().prepare(scene).quadrics is None
    left_out = mrt.render(0, width=8, height=8, aa=1).plan.left_out
    assert "cones and cylinders" in {omission.what for omission in left_out}


def test_kernel_does_not_grow_with_the_number_of_cones() -> None:
    def operations(count: int) -> list[int]:
        cones = tuple(Cone((i, 1, 0), (i, 0, 0), 0.4, MATTE) for i in range(count))
        scene = scene_of(camera=Camera((5, 5, 5), (0, 0, 0)), cones=cones)
        loaded = mi.load_dict(scene.to_dict(width=8, height=8))
        loaded.integrator().prepare(loaded)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(mi.render(loaded, spp=1))
            return [entry["operation_count"] for entry in dr.kernel_history([dr.KernelType.JIT])]

    few = operations(2)
    assert max(few) > 1000
    assert operations(100) == operations(1000) == few
