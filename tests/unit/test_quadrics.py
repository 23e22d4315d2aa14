"""Spheres, planes, cones and cylinders as ``mrt_whitted`` traces them: single rays, surfaces, and their tree.

Whether whole bundles of rays hit, miss and leave them at all sizes is measured by the study ``stability``.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import group, radius, sensor

from mrt_mitsuba.plugins import intersect
from mrt_mitsuba.plugins.quadric_kinds import BASE, CLOSED, KINDS, LATERAL, TOP
from mrt_mitsuba.plugins.whitted.quadrics import Quadrics
from mrt_mitsuba.scene.model import OBJECTS, Material
from mrt_mitsuba.validation.oracles import reference

pytestmark = pytest.mark.usefixtures("variant")

V = dr.scalar.Array3f64
MATTE = Material(0.5, 0.5, (0, 0, 0), (0.8, 0.8, 0.8))
# Apex or upper end at (0, 0, 1), base disc of radius 1 in the plane z = 0
UNIT = {kind: KINDS[kind].frame(V(0, 0, 1), V(0, 0, 0), 1.0) for kind in CLOSED if KINDS[kind].points == 2}


def meet(shape: str, o: Any, d: Any) -> Any:
    if shape == "plane":
        return intersect.intersect_plane(o, d, V(0, 1, 0), 0.0)
    if shape == "sphere":
        return intersect.intersect_sphere(o, d, V(1, 2, 3), 0.5)
    return KINDS[shape].intersect(o, d, UNIT[shape.removeprefix("open ")])


INF = np.inf


rays = Cases()
rays("sphere", (1, 2, 3), (0, 2, 0), 0.25, None)  # from the centre; t counts lengths of d
rays("sphere", (1, 2.5, 3), (0, 1, 0), INF, None)  # leaving its surface
rays("sphere", (1, 2.5, 3), (0, -1, 0), 1, None)  # through
rays("plane", (0, 0, 0), (1, -1, 0), INF, None)  # from on it
rays("plane", (0, -1, 0), (1, 2, 0), 0.5, None)  # from behind as well
rays("cone", (0, 0, 5), (0, 0, -1), 4, LATERAL)  # onto the apex
rays("cone", (0, 0, -5), (0, 0, 1), 5, BASE)  # up the axis
rays("cone", (0, 0, 0.5), (0, 0, 1), 0.5, LATERAL)  # from inside, out at the apex
rays("cone", (3, 0, 0.5), (-2, 0, 0), 1.25, LATERAL)
rays("cone", (3, 0, -1e-9), (-1, 0, 0), INF, None)  # just below the base, level with it
rays("cone", (3, 0, 1e-9), (-1, 0, 0), 2 + 1e-9, LATERAL)  # just above
rays("cone", (-2, 0.1, 0), (1, 0, 1), INF, None)  # parallel to a generatrix, outside
rays("cone", (-0.5, 0, 0), (1, 0, 1), 0.75, LATERAL)  # ... from inside to the other side
rays("cone", (0, 0, 1.0 + 1e-9), (1, 0, 1), INF, None)  # off the apex, away
rays("open cone", (0.2, 0, -5), (0, 0, 1), 5.8, LATERAL)  # through to the side
rays("cylinder", (0, 0, 5), (0, 0, -1), 4, TOP)
rays("cylinder", (1 - 1e-12, 0, 5), (0, 0, -1), 4, TOP)  # parallel to the side, just inside
rays("cylinder", (1 + 1e-12, 0, 5), (0, 0, -1), INF, None)
rays("cylinder", (3, 0, 1 + 1e-12), (-1, 0, 0), INF, None)  # level, just above
rays("cylinder", (3, 0, -1e-12), (-1, 0, 0), INF, None)  # ... and below
rays("cylinder", (2, 0, -1), (-1, 0, 1), 1, LATERAL)  # onto the rim
rays("open cylinder", (0.2, 0, -5), (0, 0, 1), INF, None)


@pytest.mark.parametrize(("shape", "o", "d", "t", "part"), rays)
def test_single_rays(shape, o, d, t, part):
    found = meet(shape, V(*o), V(*d))
    distance, hit = found if isinstance(found, tuple) else (found, None)
    assert distance == pytest.approx(t, rel=1e-12, abs=1e-12)
    assert part is None or hit == part


@pytest.mark.parametrize("kind", UNIT)
def test_surface_points_have_their_normal_and_uv(kind):
    """Points near each part end up on it, with the normal outwards."""
    import drjit.llvm.ad as arrays

    vector = arrays.Array3f64
    frame = KINDS[kind].frame(vector(0.3, 1.5, -0.2), vector(0.1, 0.4, 0.3), arrays.Float64(0.7))
    around = np.random.default_rng(2).normal(size=(3, 1000)) * 0.4
    p = vector(0.2, 0.95, 0.05) + vector(around)

    def off(part: int, q: Any) -> Any:
        """Distance above a part, in the unit frame."""
        if part == LATERAL:
            return dr.sqrt(q.x**2 + q.y**2) - radius(kind, q.z)
        return q.z - 1 if part == BASE else -q.z

    for part in KINDS[kind].parts:
        near = p
        for _ in range(8):  # to where one step will do, if the side is curved
            near, *_ = KINDS[kind].surface(near, part, frame)
        near += vector(around) * 1e-7
        on, n, _, v, *_ = KINDS[kind].surface(near, part, frame)
        q = frame.point(on)
        back = frame.point(on - n * 1e-6)
        other = ~(q.z > 0.05)  # above its apex a cone has another half
        assert dr.all(other | (dr.abs(off(part, q)) < 1e-12))
        assert dr.all(other | (off(part, back) < -1e-7))  # 1e-6 inside, over lengths of about 1
        assert dr.allclose(dr.norm(n), 1)
        assert dr.all((v >= 0) & (v <= 1))


@pytest.mark.parametrize("kind", CLOSED)
def test_stand_ins_are_wound_as_their_normals_point(kind):
    vertices, faces = KINDS[kind].mesh(12)
    corners = vertices[faces]
    a, b, c = np.moveaxis(corners[..., :3], 1, 0)
    assert (np.cross(b - a, c - a)[:, None] @ corners[..., 3:6].sum(axis=1)[:, :, None] > 0).all()


def nearest(kind: str, ends: np.ndarray, radii: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distances [N] by the float64 tracer, in lengths of d."""
    things = [OBJECTS[kind](*e.tolist(), float(r), MATTE) for e, r in zip(ends, radii, strict=True)]
    length = np.linalg.norm(np.float64(d), axis=1)
    t, *_ = reference.nearest(things, np.float64(o), d / length[:, None])
    return t / length


def crowd(count: int) -> tuple[np.ndarray, ...]:
    """Overlapping objects of sizes over three decades, and rays among them: ends, radii, o, d."""
    rng = np.random.default_rng(8)
    rays = 8_000
    sizes = 10 ** rng.uniform(-2, 1, count)
    start = rng.uniform(-3, 3, (count, 3))
    end = start + rng.normal(size=(count, 3)) * sizes[:, None]
    ends = np.stack([start, end], axis=1)
    radii = sizes * rng.uniform(0.1, 1, count)
    d = rng.normal(size=(rays, 3))
    d[::7, 0] = 0
    d[::11, 1] = 0  # along planes of the axes, where box tests divide by nothing
    o = rng.uniform(-4, 4, (rays, 3))
    return ends, radii, o, d


@pytest.mark.parametrize("kind", UNIT)
@pytest.mark.parametrize(("count", "scale"), [(120, 1e-6), (120, 1e6), (1, 1.0), (5, 1.0)])
def test_search_against_float64(kind, count, scale):
    ends, radii, o, d = crowd(count)
    ends = np.float32(ends * scale)
    radii = np.float32(radii * scale)
    o = np.float32(o * scale)
    d = np.float32(d)
    numbers = np.column_stack([ends.reshape(-1, 6), radii])
    quadrics = Quadrics([mi.load_dict(group(numbers, kind=kind))])
    farthest = dr.opaque(mi.Float, 2.0**127)
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T), farthest, 0, [])
    t = np.array(quadrics.intersect(ray, mi.Bool(True))[0], float)
    t[t > 1e38] = INF
    exact = nearest(kind, ends, radii, o, d)
    assert (~np.isclose(t, exact, rtol=1e-2)).mean() < 5e-4  # also where both are infinite
    assert (np.array(quadrics.occluded(ray, mi.Bool(True))) == np.isfinite(t)).all()
    ray.maxt = np.float32(np.where(np.isfinite(t), 0.999 * t, 1e38))  # short of what was met
    assert dr.none(quadrics.occluded(ray, mi.Bool(True)))
    assert count < 120 or np.isfinite(exact).mean() > 0.3


def test_kernel_does_not_grow_with_the_number_of_cones():
    def operations(count: int) -> int:
        crowd = group([[i, 1, 0, i, 0, 0, 0.4] for i in range(count)], kind="cone")
        nodes = {"type": "scene", "integrator": {"type": "mrt_whitted"}, "crowd": crowd}
        nodes["light"] = {"type": "mrt_light", "position": [0, 10, 0]}
        nodes["sensor"] = sensor([5, 5, 5], [0, 0, 0], (8, 8))
        loaded = mi.load_dict(nodes)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(mi.render(loaded, spp=1))
            return max(entry["operation_count"] for entry in dr.kernel_history([dr.KernelType.JIT]))

    few = operations(2)
    many = operations(100)  # many: with light buffers
    assert few > 1000
    assert operations(50) == few != many == operations(1000)
