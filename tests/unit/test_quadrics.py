"""Spheres, planes, cones and cylinders as ``mrt_whitted`` traces them: single rays, surfaces, and their tree.

Whether whole bundles of rays hit, miss and leave them at all sizes is measured by the study ``stability``.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import group

from mrt_mitsuba.plugins import intersect
from mrt_mitsuba.plugins.intersect import BASE, LATERAL, TOP
from mrt_mitsuba.plugins.quadric_kinds import KINDS
from mrt_mitsuba.plugins.quadrics import Quadrics
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Scene
from mrt_mitsuba.validation.oracles import reference

pytestmark = pytest.mark.usefixtures("variant")

V = dr.scalar.Array3f64
MATTE = Material(0.5, 0.5, (0, 0, 0), (0.8, 0.8, 0.8))
# Apex or upper end at (0, 0, 1), base disc of radius 1 in the plane z = 0
UNIT = {kind: KINDS[kind].frame(V(0, 0, 1), V(0, 0, 0), 1.0) for kind in ("cone", "cylinder")}


def meet(shape: str, o: Any, d: Any) -> Any:
    if shape == "plane":
        return intersect.intersect_plane(o, d, V(0, 1, 0), 0.0)
    if shape == "sphere":
        return intersect.intersect_sphere(o, d, V(1, 2, 3), 0.5)
    return KINDS[shape].intersect(o, d, UNIT[shape.removeprefix("open ")])


INF = np.inf


@pytest.mark.parametrize(
    ("shape", "o", "d", "t", "part"),
    [
        ("sphere", (1, 2, 3), (0, 2, 0), 0.25, None),  # from the centre; t counts lengths of d
        ("sphere", (1, 2.5, 3), (0, 1, 0), INF, None),  # leaving its surface
        ("sphere", (1, 2.5, 3), (0, -1, 0), 1, None),  # through
        ("plane", (0, 0, 0), (1, -1, 0), INF, None),  # from on it
        ("plane", (0, 1, 0), (1, -2, 0), 0.5, None),
        ("plane", (0, -1, 0), (1, 2, 0), 0.5, None),  # from behind as well
        ("cone", (0, 0, 5), (0, 0, -1), 4, LATERAL),  # onto the apex
        ("cone", (0, 0, -5), (0, 0, 1), 5, BASE),  # up the axis
        ("cone", (0, 0, 0.5), (0, 0, 1), 0.5, LATERAL),  # from inside, out at the apex
        ("cone", (3, 0, 0.5), (-2, 0, 0), 1.25, LATERAL),
        ("cone", (3, 0, 1.5), (-1, 0, 0), INF, None),  # above the apex
        ("cone", (3, 0, -1e-9), (-1, 0, 0), INF, None),  # just below the base, level with it
        ("cone", (3, 0, 1e-9), (-1, 0, 0), 2 + 1e-9, LATERAL),  # just above
        ("cone", (-2, 0.1, 0), (1, 0, 1), INF, None),  # parallel to a generatrix, outside
        ("cone", (-0.5, 0, 0), (1, 0, 1), 0.75, LATERAL),  # ... from inside to the other side
        ("cone", (0.5, 0, 2.5), (-1, 0, -1), INF, None),  # ... through the half above the apex only
        ("cone", (0, 0, 1.0 + 1e-9), (1, 0, 1), INF, None),  # off the apex, away
        ("open cone", (0.2, 0, -5), (0, 0, 1), 5.8, LATERAL),  # through to the side
        ("cylinder", (0, 0, 5), (0, 0, -1), 4, TOP),
        ("cylinder", (1 - 1e-12, 0, 5), (0, 0, -1), 4, TOP),  # parallel to the side, just inside
        ("cylinder", (1 + 1e-12, 0, 5), (0, 0, -1), INF, None),
        ("cylinder", (0.2, 0, 0.5), (0, 0, 1), 0.5, TOP),
        ("cylinder", (3, 1 + 1e-12, 0.5), (-1, 0, 0), INF, None),
        ("cylinder", (3, 0, 1 + 1e-12), (-1, 0, 0), INF, None),
        ("cylinder", (2, 0, -1), (-1, 0, 1), 1, LATERAL),  # onto the rim
        ("open cylinder", (0.2, 0, -5), (0, 0, 1), INF, None),
    ],
)
def test_single_rays(shape: str, o: tuple, d: tuple, t: float, part: int | None) -> None:
    found = meet(shape, V(*o), V(*d))
    distance, hit = found if isinstance(found, tuple) else (found, None)
    assert distance == pytest.approx(t, rel=1e-12, abs=1e-12)
    assert part is None or hit == part


@pytest.mark.parametrize("kind", UNIT)
def test_surface_points_have_their_normal_and_uv(kind: str) -> None:
    """Points near each part end up on it, with the normal outwards; uv goes around the axis."""
    import drjit.llvm.ad as arrays

    rng = np.random.default_rng(2)
    end0, end1 = np.array([0.3, 1.5, -0.2]), np.array([0.1, 0.4, 0.3])
    frame = KINDS[kind].frame(
        *(arrays.Array3f64(*map(arrays.Float64, end)) for end in (end0, end1)), arrays.Float64(0.7)
    )
    p = arrays.Array3f64(((end0 + end1) / 2 + rng.normal(size=(1000, 3)) * 0.4).T)
    levels = {
        LATERAL: lambda q: dr.sqrt(q.x**2 + q.y**2) - (q.z if kind == "cone" else 1),
        BASE: lambda q: q.z - 1,
        TOP: lambda q: -q.z,
    }
    for part in KINDS[kind].parts:
        on, n, u, v = KINDS[kind].surface(p, part, frame)
        q, back = frame.point(on), frame.point(on - n * 1e-6)
        other = ~(q.z > 0.05)  # above its apex a cone has another half
        assert dr.all(other | (dr.abs(levels[part](q)) < 1e-12))
        assert dr.all(other | (levels[part](back) < -1e-7))  # 1e-6 inside, over lengths of about 1
        assert dr.allclose(dr.norm(n), 1)
        assert dr.all((v >= 0) & (v <= 1))
        if part == LATERAL:
            azimuth = u * 2 * np.pi
            assert dr.all((u >= 0) & (u < 1))
            assert dr.all(other | (dr.abs(dr.sin(azimuth) * q.x - dr.cos(azimuth) * q.y) < 1e-12))


def nearest(kind: str, ends: np.ndarray, radii: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distances [N] by the float64 tracer, in lengths of d."""
    make = Cone if kind == "cone" else Cylinder
    things = [make(*e.tolist(), float(r), MATTE) for e, r in zip(ends, radii, strict=True)]
    length = np.linalg.norm(np.float64(d), axis=1)
    return reference.nearest(things, np.float64(o), d / length[:, None])[0] / length


def disagreements(t: np.ndarray, exact: np.ndarray, thinner: np.ndarray) -> np.ndarray:
    """Where float32 found another object, or none, [N].

    It moves a ray sideways by some roundings of the way to the object: from 1e4 sizes away, by up to a
    hundredth of the radius. So where a thinner object would be met elsewhere, it may go either way.
    """
    same = np.isclose(t, exact, rtol=1e-2) | (np.isinf(t) & np.isinf(exact))
    grazing = ~(np.isclose(exact, thinner, rtol=0.1) | (np.isinf(exact) & np.isinf(thinner)))
    return ~same & ~grazing


def crowd(count: int, place: str, kind: str) -> tuple[np.ndarray, ...]:
    """Overlapping objects of sizes over three decades, and rays from a place to them: ends, radii, o, d."""
    rng, rays = np.random.default_rng(8), 8_000
    sizes = 10 ** rng.uniform(-2, 1, count)
    start = rng.uniform(-3, 3, (count, 3))
    ends = np.stack([start, start + rng.normal(size=(count, 3)) * sizes[:, None]], axis=1)
    radii, d = sizes * rng.uniform(0.1, 1, count), rng.normal(size=(rays, 3))
    which = rng.integers(0, count, rays)
    d[::7, 0], d[::11, 1] = 0, 0  # along planes of the axes, where box tests divide by nothing
    inner = ends[which].mean(axis=1)
    if place == "among":
        o = rng.uniform(-4, 4, (rays, 3))
    elif place == "inside":
        o = inner + rng.normal(size=(rays, 3)) * 0.05 * radii[which, None]
    elif place == "at the surface":  # a hundredth of the radius off it
        out = np.cross(np.diff(ends[which], axis=1)[:, 0], rng.normal(size=(rays, 3)))
        half = 0.5 if kind == "cone" else 1.0
        o = inner + out / np.linalg.norm(out, axis=1, keepdims=True) * (radii[which] * half * 1.01)[:, None]
    else:  # 1e4 times the size of an object
        o = inner + 1e4 * sizes[which, None] * d / np.linalg.norm(d, axis=1, keepdims=True)
        d = inner + rng.normal(size=(rays, 3)) * 0.3 * radii[which, None] - o
    return ends, radii, o, d


@pytest.mark.parametrize("kind", UNIT)
@pytest.mark.parametrize(
    ("count", "scale", "place"),
    [
        *((120, 1.0, place) for place in ("inside", "far away", "at the surface")),
        *((120, scale, "among") for scale in (1e-6, 1e6)),
        *((count, 1.0, "among") for count in (1, 5)),
    ],
)
def test_search_against_float64(kind: str, count: int, scale: float, place: str) -> None:
    ends, radii, o, d = crowd(count, place, kind)
    o, d, ends, radii = (np.float32(x) for x in (o * scale, d, ends * scale, radii * scale))
    quadrics = Quadrics([mi.load_dict(group(np.column_stack([ends.reshape(-1, 6), radii]), kind=kind))])
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T), dr.opaque(mi.Float, 2.0**127), 0, [])
    t = np.array(quadrics.intersect(ray, mi.Bool(True))[0], float)
    t[t > 1e38] = INF
    exact, thinner = (nearest(kind, ends, shrink * radii, o, d) for shrink in (1.0, 0.98))
    assert disagreements(t, exact, thinner).mean() < 2e-4
    assert (np.array(quadrics.occluded(ray, mi.Bool(True))) == np.isfinite(t)).all()
    ray.maxt = np.float32(np.where(np.isfinite(t), 0.999 * t, 1e38))  # short of what was met
    assert dr.none(quadrics.occluded(ray, mi.Bool(True)))
    assert count < 120 or np.isfinite(exact).mean() > 0.3


def test_kernel_does_not_grow_with_the_number_of_cones() -> None:
    def operations(count: int) -> int:
        cones = tuple(Cone((i, 1, 0), (i, 0, 0), 0.4, MATTE) for i in range(count))
        scene = Scene(Camera((5, 5, 5), (0, 0, 0)), (0, 0, 0), (Light((0, 10, 0), (1, 1, 1)),), cones=cones)
        loaded = mi.load_dict(scene.to_dict(width=8, height=8))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(mi.render(loaded, spp=1))
            return max(entry["operation_count"] for entry in dr.kernel_history([dr.KernelType.JIT]))

    few, many = operations(2), operations(100)  # many: with light buffers
    assert few > 1000
    assert operations(50) == few != many == operations(1000)
