"""Cone and cylinder: intersection and surface against extended precision, and rays where formulas break."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrt_mitsuba.plugins.intersect import (
    BASE,
    LATERAL,
    TOP,
    cone_frame,
    cone_surface,
    cylinder_frame,
    cylinder_surface,
    intersect_cone,
    intersect_cylinder,
    intersect_plane,
)

PRECISIONS = ["float32", "float64"]
EPSILON = {"float32": 2.0**-24, "float64": 2.0**-53}
SCALES = [1e-6, 1.0, 1e6]
SHAPES = {
    "cone": (cone_frame, intersect_cone, cone_surface),
    "cylinder": (cylinder_frame, intersect_cylinder, cylinder_surface),
}
# The integrator starts secondary rays this many roundings off a surface, relative to the largest coordinate
OFFSET = 32


@pytest.fixture(autouse=True)
def _vectorised() -> None:
    from mrt_mitsuba import runtime

    runtime.use("llvm_ad_rgb")


def array_types(precision: str):
    import drjit.llvm.ad as arrays

    return (arrays.Float, arrays.Array3f) if precision == "float32" else (arrays.Float64, arrays.Array3f64)


def make_frame(shape: str, precision: str, end0, end1, radius):
    number, vector = array_types(precision)
    return SHAPES[shape][0](vector(*map(number, end0)), vector(*map(number, end1)), number(radius))


def place(shape: str, scale: float, precision: str):
    """Ends of the axis and radius of a slanted shape away from the origin, rounded to the precision."""
    ends = np.array([[0.3, 1.5, -0.2], [0.1, 0.4, 0.3]], precision) * np.dtype(precision).type(scale)
    return ends[0], ends[1], np.dtype(precision).type(0.7 * scale)


def exact_hits(shape: str, o, d, end0, end1, radius):
    """First hits by the textbook quadratics in world space, in extended precision: t and part."""
    o, d, end0, end1 = (np.asarray(x, np.longdouble) for x in (o, d, end0, end1))
    axis = end1 - end0
    length = np.sqrt(axis @ axis)
    axis = axis / length
    slope, at_end0 = (radius / length, 0) if shape == "cone" else (0, radius)
    p = o - end0
    pz, uz = p @ axis, d @ axis
    across, u_across = p - pz[:, None] * axis, d - uz[:, None] * axis
    r0, dr0 = at_end0 + slope * pz, slope * uz
    a = (u_across**2).sum(1) - dr0**2
    b = (across * u_across).sum(1) - r0 * dr0
    c = (across**2).sum(1) - r0**2
    best, part = np.full(len(o), np.inf, np.longdouble), np.full(len(o), -1)
    caps = [(length, BASE)] + ([(0, TOP)] if shape == "cylinder" else [])
    with np.errstate(all="ignore"):
        for sign in (1, -1):
            t = (-b + sign * np.sqrt(b * b - a * c)) / a
            z = pz + t * uz
            closer = (t > 0) & (z >= 0) & (z <= length) & (t < best)
            best[closer], part[closer] = t[closer], LATERAL
        for height, name in caps:
            t = (height - pz) / uz
            r = np.sqrt(((across + t[:, None] * u_across) ** 2).sum(1))
            closer = (t > 0) & (r <= radius) & (t < best)
            best[closer], part[closer] = t[closer], name
    return best, part


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_hits_are_those_of_extended_precision(shape: str, precision: str, scale: float) -> None:
    rng = np.random.default_rng(1)
    count = 100_000
    end0, end1, radius = place(shape, scale, precision)
    o = (rng.normal(size=(count, 3)) * 2 * scale).astype(precision)  # a tenth of them start inside
    towards = rng.normal(size=(count, 3)) * 0.5 * scale + (end0 + end1) / 2
    d = ((towards - o) / scale).astype(precision)
    frame = make_frame(shape, precision, end0, end1, radius)
    _, vector = array_types(precision)
    hit = SHAPES[shape][1](vector(o.T), vector(d.T), frame)
    t, part = hit.t.numpy().astype(np.float64), hit.part.numpy()
    exact_t, exact_part = exact_hits(shape, o, d, end0, end1, radius)

    found, exact_found = np.isfinite(t), np.isfinite(exact_t)
    assert 0.3 * count < exact_found.sum() < 0.9 * count
    # Rays within some roundings of a silhouette or a rim may go either way: about 1e-7 of them
    assert (found != exact_found).sum() <= 2
    both = found & exact_found
    assert (part[both] != exact_part[both]).sum() <= 2
    # What must be small is the distance from the surface, t error × cos of incidence: at grazing incidence t
    # itself is ill-conditioned. Some ten roundings add up, of numbers up to the origin's distance from the
    # shape
    point = vector((o + d * t[:, None])[both].T.astype(precision))
    surface = SHAPES[shape][2](point, type(hit.part)(part[both]), frame)
    cos = np.abs((surface.n.numpy().T * d[both]).sum(1))
    same = part[both] == exact_part[both]
    error = np.abs(t[both] - exact_t[both]) * cos
    size = np.linalg.norm(o[both], axis=1) + 2 * scale
    assert (error / size)[same].max() < 32 * EPSILON[precision]


@pytest.mark.parametrize("shape", SHAPES)
def test_surface_point(shape: str) -> None:
    """Points near each part end up on it, with the normal of finite differences and uv in the unit square."""
    rng = np.random.default_rng(2)
    _, vector = array_types("float64")
    end0, end1, radius = place(shape, 1, "float64")
    frame = make_frame(shape, "float64", end0, end1, radius)
    p = vector(((end0 + end1) / 2 + rng.normal(size=(1000, 3)) * 0.4).T)
    for part in (LATERAL, BASE) + ((TOP,) if shape == "cylinder" else ()):
        surface = SHAPES[shape][2](p, part, frame)
        q, back = frame.point(surface.p), frame.point(surface.p - surface.n * 1e-6)
        level = {
            LATERAL: (lambda q: dr.sqrt(q.x**2 + q.y**2) - (q.z if shape == "cone" else 1)),
            BASE: lambda q: q.z - 1,
            TOP: lambda q: -q.z,
        }[part]
        mostly = q.z > 0.05  # below its apex a cone has another half
        assert dr.all(~mostly | (dr.abs(level(q)) < 1e-12))
        assert dr.all(~mostly | (level(back) < -1e-7))  # 1e-6 inside, over lengths of about 1
        assert dr.allclose(dr.norm(surface.n), 1)
        assert dr.all((surface.v >= 0) & (surface.v <= 1))
        if part == LATERAL:
            assert dr.all((surface.u >= 0) & (surface.u < 1))
            azimuth = surface.u * 2 * np.pi
            assert dr.all(~mostly | (dr.abs(dr.sin(azimuth) * q.x - dr.cos(azimuth) * q.y) < 1e-12))


@pytest.mark.parametrize("shape", [*SHAPES, "plane"])
def test_leaving_rays_hit_nothing_they_left(shape: str) -> None:
    """10⁶ rays from points over 13 decades of scale, outwards and inwards, started as the integrator does."""
    rng = np.random.default_rng(3)
    count = 1_000_000
    number, vector = array_types("float32")
    size = number((10 ** rng.uniform(-6.5, 6.5, count)).astype(np.float32))
    end0 = vector(rng.normal(size=(3, count)).astype(np.float32)) * size
    end1 = end0 + vector(rng.normal(size=(3, count)).astype(np.float32)) * size
    radius = size * number(rng.uniform(0.2, 1, count).astype(np.float32))
    inwards = number(rng.random(count).astype(np.float32)) < 0.5
    d = dr.normalize(vector(rng.normal(size=(3, count)).astype(np.float32)))
    if shape == "plane":
        n = dr.normalize(end1 - end0)
        distance = -dr.dot(n, end0)
        p = end0 + dr.cross(n, vector(rng.normal(size=(3, count)).astype(np.float32))) * radius
        p -= n * (dr.dot(n, p) + distance)
        scale, edge = dr.abs(distance), 1e30

        def intersect(o):
            return intersect_plane(o, d, n, distance)
    else:
        make, cut, surface_of = SHAPES[shape]
        frame = make(end0, end1, radius)
        p, part, edge = random_surface_points(shape, rng, count, end0, end1, radius, frame)
        surface = surface_of(p, part, frame)
        p, n = surface.p, surface.n
        reach = [dr.max(dr.maximum(dr.abs(end0), dr.abs(end1))), radius]
        scale = dr.maximum(*reach) + radius  # at least the largest coordinate of the bounding box

        def intersect(o):
            return cut(o, d, frame).t

    d = d * dr.select((dr.dot(d, n) > 0) == inwards, -1, 1)
    step = OFFSET * EPSILON["float32"] * dr.maximum(scale, dr.max(dr.abs(p)))
    t = intersect(p + n * dr.select(inwards, -step, step))
    assert dr.none(~inwards & dr.isfinite(t))
    if shape != "plane":
        # Nearer to a rim or apex than a few steps, the start of an inward ray may lie behind the other
        # surface
        assert dr.none(inwards & (edge > 8 * step) & ~dr.isfinite(t))


def random_surface_points(shape, rng, count, end0, end1, radius, frame):
    """Points on side and discs, and the distance of each from the rims and the apex (a lower bound)."""
    number, _ = array_types("float32")
    axis = end1 - end0
    s, t = dr.normalize(frame.x), dr.normalize(frame.y)
    angle = number(rng.uniform(0, 2 * np.pi, count).astype(np.float32))
    out = s * dr.cos(angle) + t * dr.sin(angle)
    along = number(rng.random(count).astype(np.float32))
    kinds = 2 if shape == "cone" else 3
    part = dr.llvm.ad.Int(rng.integers(0, kinds, count).astype(np.int32))
    side = end0 + axis * along + out * (radius * (along if shape == "cone" else 1))
    disc = dr.select(part == BASE, end1, end0) + out * (radius * along)
    length = dr.norm(axis)
    shortest = dr.minimum(length, radius) * dr.minimum(1, radius / length)
    edge = dr.minimum(along, 1 - along) * shortest
    return dr.select(part == LATERAL, side, disc), part, edge


def unit_cone():
    """Apex at (0, 0, 1), base disc of radius 1 in the plane z = 0: sides at 45°."""
    v = dr.scalar.Array3f64
    return cone_frame(v(0, 0, 1), v(0, 0, 0), 1.0)


def unit_cylinder():
    v = dr.scalar.Array3f64
    return cylinder_frame(v(0, 0, 1), v(0, 0, 0), 1.0)


@pytest.mark.parametrize(
    ("o", "d", "t", "part"),
    [
        ((0, 0, 5), (0, 0, -1), 4, LATERAL),  # onto the apex
        ((0, 0, -5), (0, 0, 1), 5, BASE),  # up the axis
        ((0, 0, 0.5), (0, 0, 1), 0.5, LATERAL),  # from inside, out at the apex
        ((0, 0, 0.5), (0, 0, -1), 0.5, BASE),
        ((3, 0, 0.5), (-1, 0, 0), 2.5, LATERAL),
        ((3, 0, 0.5), (-2, 0, 0), 1.25, LATERAL),  # t counts lengths of d
        ((3, 0, 1.5), (-1, 0, 0), np.inf, None),  # above the apex
        ((3, 0, -1e-9), (-1, 0, 0), np.inf, None),  # just below the base
        ((-2, 0.1, 0), (1, 0, 1), np.inf, None),  # parallel to a generatrix, outside
        ((-0.5, 0, 0), (1, 0, 1), 0.75, LATERAL),  # parallel to a generatrix, from inside to the other side
        ((-0.5, 0, -1), (1, 0, 1), 1, BASE),  # ... entered from below
        ((3, 0, 2.5), (-1, 0, -1), 2.25, LATERAL),  # ... entered from the side
        ((0.5, 0, 2.5), (-1, 0, -1), np.inf, None),  # ... through the half above the apex only
        ((0, 0, 1.0 + 1e-9), (1, 0, 1), np.inf, None),  # off the apex, away
    ],
)
def test_cone_special_rays(o, d, t, part) -> None:
    v = dr.scalar.Array3f64
    hit = intersect_cone(v(*o), v(*d), unit_cone())
    assert hit.t == pytest.approx(t, rel=1e-12, abs=1e-12)
    if part is not None:
        assert hit.part == part


@pytest.mark.parametrize(
    ("o", "d", "t", "part"),
    [
        ((0, 0, 5), (0, 0, -1), 4, TOP),
        ((1 - 1e-12, 0, 5), (0, 0, -1), 4, TOP),  # parallel to the side, just inside
        ((1 + 1e-12, 0, 5), (0, 0, -1), np.inf, None),
        ((0, 0, -5), (0, 0, 1), 5, BASE),
        ((0.2, 0, 0.5), (0, 0, 1), 0.5, TOP),
        ((3, 0, 0.5), (-1, 0, 0), 2, LATERAL),
        ((3, 1 + 1e-12, 0.5), (-1, 0, 0), np.inf, None),
        ((3, 0, 1 + 1e-12), (-1, 0, 0), np.inf, None),
        ((0, 0, 0.5), (1, 0, 0), 1, LATERAL),
        ((2, 0, -1), (-1, 0, 1), 1, LATERAL),  # onto the rim
    ],
)
def test_cylinder_special_rays(o, d, t, part) -> None:
    v = dr.scalar.Array3f64
    hit = intersect_cylinder(v(*o), v(*d), unit_cylinder())
    assert hit.t == pytest.approx(t, rel=1e-12, abs=1e-12)
    if part is not None:
        assert hit.part == part


def test_vectors_may_be_lists() -> None:
    """The float64 reference computes on lists of components."""
    from mrt_mitsuba.plugins.columns import Vector3

    o, d = Vector3([2.0, 1.0, 3.0]), Vector3([-1.0, -0.4, -1.3])
    apex, base = Vector3([0.0, 0.0, 1.0]), Vector3([0.0, 0.1, 0.0])
    v = dr.scalar.Array3f64
    for make, cut, surface_of in SHAPES.values():
        hit, same = cut(o, d, make(apex, base, 1.0)), cut(v(o), v(d), make(v(apex), v(base), 1.0))
        assert hit.t == pytest.approx(same.t, rel=1e-14) and hit.part == same.part
        surface = surface_of(o + d * hit.t, hit.part, make(apex, base, 1.0))
        assert dr.norm(surface.n) == pytest.approx(1)


def test_open_shapes_have_no_caps() -> None:
    v = dr.scalar.Array3f64
    below, up = v(0.2, 0, -5), v(0, 0, 1)
    assert intersect_cone(below, up, unit_cone(), capped=False).t == pytest.approx(5.8)  # through to the side
    assert intersect_cylinder(below, up, unit_cylinder(), capped=False).t == np.inf


finite = st.floats(-1e3, 1e3)
points = st.tuples(finite, finite, finite)


@pytest.mark.parametrize("shape", SHAPES)
@given(o=points, d=points, end0=points, end1=points, radius=st.floats(1e-3, 1e3))
def test_any_ray_gives_a_point_on_the_shape(shape: str, o, d, end0, end1, radius: float) -> None:
    """Whatever the ray: no error, no NaN, and a hit is on the surface, on its bounded part."""
    v = dr.scalar.Array3f64
    length = np.linalg.norm(np.subtract(end1, end0))
    if np.linalg.norm(d) < 1e-6 or not 1e-3 < length / radius < 1e3:
        return
    make, cut, _ = SHAPES[shape]
    frame = make(v(*end0), v(*end1), radius)
    hit = cut(v(*o), v(*d), frame)
    assert hit.t > 0
    if hit.t == np.inf:
        return
    q = frame.point(v(*o) + v(*d) * hit.t)
    # Roundings of coordinates up to 1e4 after up to 1e6-fold magnification into the unit frame of the
    # smallest shapes; a grazing ray turns them into their square root along its way, which is what leaves the
    # bounded part
    rounding = 64 * EPSILON["float64"] * (1e4 + abs(hit.t) * np.linalg.norm(d)) / min(radius, length)
    r = np.hypot(q.x, q.y)
    side = q.z if shape == "cone" else 1
    assert -rounding <= q.z <= 1 + rounding
    assert r <= side + rounding
    on = {LATERAL: r - side, BASE: q.z - 1, TOP: q.z}[int(hit.part)]
    assert abs(on) <= rounding
