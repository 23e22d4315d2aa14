"""The law of the samples of a shape: positions by area, directions by solid angle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.linalg import norm
from scipy import stats

from .faults import larger, member, off_surface, put, smaller, tilted
from .law import (
    SIGMAS,
    Criterion,
    Outcome,
    difference,
    finds,
    measures,
    most,
    p_value,
    share_of,
    sidak,
)
from .noise import ROUNDING
from .probe import (
    Array,
    Lanes,
    lanes,
    unit,
)
from .shape_case import (
    CONE,
    MAX_HIT_ROUNDINGS,
    RAY,
    ShapeCase,
    dot,
    offset,
    trace,
    walk,
)

POSITIONS = """n = 100_000
rng = mi.PCG32(n)
ps = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
print("mean of 1 / density:", dr.mean(1 / ps.pdf), "surface_area():", shape.surface_area())
ratio = shape.pdf_position(ps) / ps.pdf
print("pdf_position() / density:", dr.min(ratio), "...", dr.max(ratio))
"""
SAME = "the same number"


def crowded(size, ps, time, u):
    """Positions on a square, crowded to one side."""
    return put(ps, p=mi.Point3f(2 * u.x ** (1 + size) - 1, ps.p.y, 0))


def around_z(size, v):
    """Vectors turned around z, to crowd at one azimuth."""
    turn = dr.atan2(v.y, v.x) / (2 * dr.pi) + 0.5
    azimuth = 2 * dr.pi * turn ** (1 + size)
    radius = dr.hypot(v.x, v.y)
    return mi.Vector3f(radius * dr.cos(azimuth), radius * dr.sin(azimuth), v.z)


def crowded_azimuth(size, ps, time, u):
    """Positions on a unit sphere, crowded to one azimuth."""
    p = around_z(size, ps.p)
    return put(ps, p=mi.Point3f(p), n=mi.Normal3f(p))


def crowded_directions(size, ds, it, u):
    """Directions turned around the one to the middle, to crowd at one azimuth."""
    frame = mi.Frame3f(dr.normalize(-mi.Vector3f(it.p)))
    d = frame.to_world(around_z(size, frame.to_local(ds.d)))
    return put(ds, d=d, p=it.p + ds.dist * d)


def too_short(size, ds, it, u):
    return put(ds, dist=ds.dist * dr.select(u.x < size, 0.99, 1))


@finds(
    "crossings",
    "area too large, and the density of positions too small",
    0.01,
    quick=0.02,
    surface_area=larger,
    pdf_position=smaller,
    sample_position=member("pdf", smaller),
)
@finds("area", "surface_area() too large", 3e-3, surface_area=larger)
@finds("position", "pdf_position() too large", 3e-3, pdf_position=larger)
@finds(
    "spread",
    "positions crowded to one side: u^(1 + this)",
    0.03,
    quick=0.1,
    nested={"type": "rectangle"},
    sample_position=crowded,
)
@finds(
    "spread",
    "positions on a sphere crowded at one azimuth: u^(1 + this)",
    0.03,
    quick=0.1,
    nested={"type": "sphere"},
    sample_position=crowded_azimuth,
)
@finds("off", "positions off the surface, in sizes", 1e-5, sample_position=off_surface)
@finds("normal", "normals of positions tilted, in radians", 0.1, sample_position=member("n", tilted))
@finds("direction", "pdf_direction() too large", 0.02, pdf_direction=larger)
@finds("misses", "distances too short for this share of directions", 0.02, sample_direction=too_short)
@finds(
    "aim",
    "directions to a sphere crowded at one azimuth: u^(1 + this)",
    0.05,
    quick=0.1,
    nested={"type": "sphere"},
    sample_direction=crowded_directions,
)
@finds(
    "angle",
    "density of directions too small",
    0.1,
    quick=0.2,
    pdf_direction=smaller,
    sample_direction=member("pdf", smaller),
)
@measures(
    position=most("density of a position against pdf_position(), relative", 1e-3, SAME, POSITIONS),
    area=most("mean of 1 / density against surface_area(), relative", 1e-3, SAME, POSITIONS),
    off=Criterion(
        0.9,
        "sampled positions off the surface, 90th percentile, in roundings of the largest coordinate",
        2 * MAX_HIT_ROUNDINGS,
        "a few roundings",
        RAY,
    ),
    normal=Criterion(
        0.9,
        "normals of sampled positions against those of rays, 1 - cosine, 90th percentile",
        1e-3,
        "one surface",
        RAY,
    ),
    crossings=most(
        f"surface_area() against that by crossings of lines, relative, beyond {SIGMAS} standard errors",
        3e-3,
        "lines that graze may cross twice within the offset of a spawned ray",
        POSITIONS,
    ),
    spread=p_value("p-value of sampled positions against the area, along the worst axis", POSITIONS),
    direction=Criterion(
        0.99,
        "density of a direction against pdf_direction(), relative, 99th percentile",
        1e-2,
        "the same number; near outlines the cosine, and the density with it, hangs on roundings",
        RAY,
    ),
    misses=share_of(
        "share of sampled directions that miss the shape, or reach it behind the sampled point",
        1e-2,
        "outlines hang on roundings; small leaks are watertight's business",
        RAY,
    ),
    aim=p_value(
        "p-value of sampled directions against their density, from the worst of some places", POSITIONS
    ),
    angle=most(
        "solid angle of what is visible by samples against uniform directions, relative, beyond "
        f"{SIGMAS} standard errors",
        1e-2,
        "the mean of 1 / density over what is seen; lines that graze are left room for",
        POSITIONS,
    ),
)
def sampling(law: Outcome, case: ShapeCase) -> None:
    """Sampled positions follow the area, and sampled directions the density that they state.

    Positions are judged by where random lines cross the surface; E[1 / pdf] is the area, and of directions
    the visible solid angle.
    """
    s, area = case.positions
    law.check("position", abs(s.pdf / s.again - 1))
    law.check("area", abs(np.mean(1 / s.pdf) / area - 1))
    # sampled positions, and their normals, as rays meet them
    few = case.few(s, 2**14, 2**17)
    back = trace(case.target, few.p + few.n * 0.01 * case.size, unit(-few.n))
    # another part of the surface may be nearer than a hundredth of the size
    away = np.where(back.met, norm(back.p - few.p, axis=1), np.inf)
    scale = abs(few.p).max(axis=1) + 0.01 * case.size
    law.check("off", away / (ROUNDING * scale), back)
    cosine = np.minimum(dot(few.n, back.shading), dot(few.n, back.n)) / norm(few.n, axis=1)
    law.check("normal", 1 - cosine, back, where=back.met)
    if case.behind.met.mean() > 0.5:
        _area(law, case, s, area)
    else:
        law.notes.append("rays pass it from behind: their crossings do not count its area")
    _directions(law, case)


def _area(law: Outcome, case: ShapeCase, s: Lanes, area: float) -> None:
    """Random lines cross a surface in proportion to its area, whatever its form (Crofton)."""
    count = case.count(2**17, 2**20)
    radius = 0.5 * case.size * 1.001
    d = case.units(count)
    across = unit(np.cross(d, case.units(count)))
    disk = radius * np.sqrt(case.rng.random((count, 1))) * across
    start = case.middle + disk - 2 * radius * d
    crossed = np.zeros(count)
    points = []
    for line, hits in walk(case.target, trace(case.target, start, d)):
        crossed[line] += 1
        points.append(hits.p)
    crossings = np.concatenate(points)
    estimates = 2 * np.pi * radius**2 * crossed
    beyond = max(abs(estimates.mean() - area) - SIGMAS * estimates.std() / np.sqrt(count), 0)
    room = 3e-3 + 20 * float(offset(s.p).max()) / case.size
    law.check("crossings", beyond / area, limit=room)
    # crossings of a line come together
    size = 1 / (1 / len(s.p) + (crossed**2).sum() / crossed.sum() / len(crossings))
    law.check("spread", _chance(s.p, crossings, case.units(AXES), size))


AXES = 8  # aslant, along which positions and directions are compared
GRAZING_ALLOWANCE = 2e-3  # lines that graze are left room for
VIEWS = 3  # from which directions are compared


def _chance(v: Array, w: Array, axes: Array, size: float) -> float:
    """The chance that sets of vectors [N, 3] and [M, 3] are so different along one of the axes [A, 3].

    By Kolmogorov and Smirnov's test, for samples of an effective ``size``.
    """
    apart = [stats.ks_2samp(v @ axis, w @ axis, method="asymp").statistic for axis in axes]
    beyond = max(max(apart) - GRAZING_ALLOWANCE, 0)
    return sidak(stats.kstwobign.sf(np.sqrt(size) * beyond), len(apart))


def _directions(law: Outcome, case: ShapeCase) -> None:
    """``sample_direction`` from outside: meets the shape, and states its own density."""
    u = case.uniform(case.count(2**14, 2**17), 2)
    o = case.around(len(u))
    try:
        d, dist, pdf, again = _sampled(case, o, u)
    except (RuntimeError, AttributeError):
        law.notes.append("the shape has no sample_direction()")
        return
    drawn = pdf > 0
    met = trace(case.target, o, d)
    law.check("direction", abs(pdf / again - 1), met, where=drawn)
    before_it = met.steep & (met.t > dist * (1 + 1e-3))
    law.check("misses", before_it | ~met.met, met, where=drawn)
    _aim(law, case)


def _sampled(case: ShapeCase, o: Array, u: Array) -> list[Array]:
    """Sampled directions from points [N, 3]: directions, distances, and densities stated and asked for."""

    def sample(origin: mi.Point3f, second: mi.Point2f) -> list[mi.Float]:
        it = dr.zeros(mi.Interaction3f)
        it.p = origin
        ds = case.plugin.sample_direction(it, second)
        return [ds.d, ds.dist, ds.pdf, case.plugin.pdf_direction(it, ds)]

    return lanes(sample, ("Point3f", o), ("Point2f", u))


def _aim(law: Outcome, case: ShapeCase) -> None:
    """Directions from some places: their density, and the solid angle of what is visible."""
    count = case.count(2**17, 2**19)
    rng = np.random.default_rng((case.seed, count))
    angles = []
    chances = []
    for _ in range(VIEWS):
        place = np.float32(case.middle + 1.5 * case.size * unit(rng.normal(size=3)))
        o = np.tile(place, (count, 1))
        d, dist, pdf, _ = _sampled(case, o, rng.random((count, 2), np.float32))
        met = trace(case.target, o, d)
        visible = (pdf > 0) & met.met & (met.t > dist * (1 - 1e-3))
        weight = np.where(visible, 1 / np.where(pdf > 0, pdf, 1), 0)
        away = case.view.into_cone(o, rng)
        within = trace(case.target, o, away).met
        angles.append(difference(weight, CONE * within))
        # of the directions to what is visible, as many as if they were uniform
        even = d[rng.random(count) * weight.max() < weight]
        uniform = away[within]
        if min(len(even), len(uniform)) > count // 32:  # else it is seen edge on
            size = 1 / (1 / len(even) + 1 / len(uniform))
            chances.append(_chance(even, uniform, case.units(AXES), size))
    law.check("angle", angles)
    if chances:
        law.check("aim", sidak(min(chances), len(chances)))
