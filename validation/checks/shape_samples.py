"""Positions and directions that a shape samples: by area, on the surface, with the densities they state."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from scipy import stats

from mrt_mitsuba.validation.checks.law import LEVEL, SIGMAS, Law, Skip
from mrt_mitsuba.validation.checks.noise import ROUNDING
from mrt_mitsuba.validation.checks.probe import Array, lanes, unit
from mrt_mitsuba.validation.checks.shape_case import (
    FLAT,
    HIT_ROUNDINGS,
    Case,
    leave,
    near,
    offset,
    trace,
    walk,
)
from mrt_mitsuba.validation.tools.image_tests import sidak

POSITIONS = """
n = 100_000
rng = mi.PCG32(n)
ps = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
print("mean of 1 / density:", dr.mean(1 / ps.pdf), "surface_area():", shape.surface_area())
ratio = shape.pdf_position(ps) / ps.pdf
print("pdf_position() / density:", dr.min(ratio), "...", dr.max(ratio))
"""


def sampling(law: Law, case: Case) -> None:
    """Positions by area, judged by where lines cross the surface; directions, and the densities of both."""
    if not hasattr(case.plugin, "sample_position"):
        raise Skip("there is no sample_position()")
    u = case.rng.random((case.count(2**14, 2**19), 2), np.float32)

    def positions(mi: Any, second: Any) -> list[Any]:
        ps = case.plugin.sample_position(0, second)
        return [ps.p, ps.n, ps.pdf, case.plugin.pdf_position(ps)]

    try:
        p, n, pdf, again = lanes(positions, ("Point2f", u))
        area = float(np.ravel(np.array(case.plugin.surface_area()))[0])
    except RuntimeError as problem:
        raise Skip(f"positions cannot be sampled: {str(problem).strip().splitlines()[-1][:120]}") from problem
    show = case.program(POSITIONS)
    for what, measured in (
        ("density of a position against pdf_position()", np.abs(pdf / again - 1).max()),
        ("mean of 1 / density against surface_area()", abs(np.mean(1 / pdf) / area - 1)),
    ):
        law.at_most(f"{what}, relative", measured, 1e-3, "the same number", show)
    few = slice(0, case.count(2**14, 2**17))
    # sampled positions, and their normals, as rays meet them
    start, inwards = (p + n * 0.01 * case.size).astype(np.float32)[few], -n[few]
    back = trace(case.target, start, unit(inwards))
    away = np.where(back.found, np.linalg.norm(back.p - p[few], axis=1), np.inf)
    # another part of the surface may be nearer than a hundredth of the size
    what = "sampled positions off the surface, 9 in 10, in roundings of the largest coordinate"
    rounded = away / (ROUNDING * (np.abs(p[few]).max(axis=1) + 0.01 * case.size))
    law.quantile(what, rounded, 0.9, 2 * HIT_ROUNDINGS, "a few roundings", case.at(start, inwards))
    if back.found.any():
        alike = -np.minimum((inwards * back.shading).sum(axis=1), (inwards * back.n).sum(axis=1))
        turned = np.where(back.found, 1 - alike / np.linalg.norm(inwards, axis=1), np.nan)
        what = "normals of sampled positions against those of rays, 1 - cosine, 9 in 10"
        law.quantile(what, turned, 0.9, 1e-3, "one surface", case.at(start, inwards))
    if case.behind.found.mean() > 0.5:
        _area(law, case, p, n, area)
    else:
        law.notes.append("rays pass it from behind: their crossings do not count its area")
    _directions(law, case, u[few])


def _area(law: Law, case: Case, p: Array, n: Array, area: float) -> None:
    """Random lines cross a surface in proportion to its area, whatever its form (Crofton)."""

    def doubled(p: Array, n: Array) -> Array:
        """Return where two parts of the surface coincide, of which lines meet one."""
        n = unit(n)
        one, other = (trace(case.target, leave(p, n, side * n), -side * n) for side in (1, -1))
        return one.found & other.found & (one.part != other.part) & near(p, one.p) & near(p, other.p)

    count = case.count(2**16, 2**20)
    radius = 0.5 * case.size * 1.001
    d = case.units(count)
    a = unit(np.cross(d, case.units(count)))
    disk = radius * np.sqrt(case.rng.random((count, 1)))
    o = (case.middle + disk * a - 2 * radius * d).astype(np.float32)
    twice = doubled(p, n)
    crossed, points = np.zeros(count), []
    for line, hit, _ in walk(case.target, o, d):
        crossed[line] += 1
        points.append(hit.p[~doubled(hit.p, hit.n)] if twice.any() else hit.p)
    estimate = 2 * np.pi * radius**2 * crossed.mean()
    error = 2 * np.pi * radius**2 * crossed.std() / np.sqrt(count)
    what = f"surface_area() against that by crossings of lines, relative, beyond {SIGMAS} standard errors"
    why = "lines that graze may cross twice within the offset of a spawned ray"
    limit = 3e-3 + 20 * float(offset(p).max()) / case.size + twice.mean()
    show = case.program(POSITIONS)
    law.at_most(what, max(abs(estimate - area) - SIGMAS * error, 0) / area, limit, why, show)
    _uniform(law, case, p[~twice], np.concatenate(points), max((crossed**2).sum() / crossed.sum(), 1))


def _uniform(law: Law, case: Case, p: Array, points: Array, bunch: float) -> None:
    """Sampled positions against crossings, in cells of equally many made by halving along axes in turn.

    A line's crossings come together: their counts vary ``bunch`` times as much.
    """
    both, cells = np.concatenate([p, points]), np.zeros(len(p) + len(points), int)
    levels = 6 if case.quick else 9
    for level, axis in enumerate(case.units(levels)):  # aslant, so that flat faces make no jumps
        x, order = both @ axis, np.argsort(cells, kind="stable")
        for here in np.split(order, np.cumsum(np.bincount(cells, minlength=2**level))[:-1]):
            sampled = here[here < len(p)]
            middle = np.median(x[here][: len(sampled)]) if len(sampled) else 0
            cells[here] += 2**level * (x[here] > middle)
    chances = []
    for count in {64, 2**levels}:
        sampled, crossing = (np.bincount(c % count, minlength=count) for c in np.split(cells, [len(p)]))
        used, total = sampled + crossing > 20, (sampled.sum(), crossing.sum())
        pull = (sampled / total[0] - crossing / total[1]) ** 2
        mean = (sampled + crossing) / sum(total)
        statistic = (pull / (mean / total[0] + bunch * mean / total[1] + (2e-3 * mean) ** 2))[used].sum()
        chances.append(float(stats.chi2.sf(statistic, max(used.sum() - 1, 1))))
    what = "chance of such counts in parts of the surface if positions follow its area"
    why = "a false alarm in a million checks"
    law.at_least(what, sidak(min(chances), len(chances)), LEVEL, why, case.program(POSITIONS))


def _directions(law: Law, case: Case, u: Array) -> None:
    """``sample_direction`` from outside: meets the shape, and states its own density."""
    count = len(u)
    o = case.around(count)

    def sample(mi: Any, origin: Any, second: Any) -> list[Any]:
        it = dr.zeros(mi.Interaction3f)
        it.p = origin
        ds = case.plugin.sample_direction(it, second)
        return [ds.d, ds.dist, ds.pdf, case.plugin.pdf_direction(it, ds)]

    try:
        d, dist, pdf, again = lanes(sample, ("Point3f", o), ("Point2f", u))
    except (RuntimeError, AttributeError):
        law.notes.append("the shape has no sample_direction()")
        return
    drawn = pdf[:, 0] > 0
    error = np.where(drawn, np.abs(pdf / again - 1)[:, 0], 0)
    # near an outline the cosine, and the density with it, hangs on roundings
    what = "density of a direction against pdf_direction(), relative, 99 in 100"
    why = "the same number; near outlines it hangs on roundings"
    law.quantile(what, error, 0.99, 1e-2, why, case.at(o, d))
    met = trace(case.target, o, d.astype(np.float32))
    steep = np.abs((met.n * d).sum(axis=1)) > FLAT
    bad = drawn & steep & met.found & (met.t > dist[:, 0] * (1 + 1e-3))
    bad |= drawn & ~met.found
    what = "share of sampled directions that miss the shape, or reach it behind the sampled point"
    why = "outlines hang on roundings; small leaks are watertight's business"
    law.share(what, bad, 1e-2, why, case.at(o, d))
    visible = drawn & met.found & (met.t > dist[:, 0] * (1 - 1e-3))
    weight = np.where(visible, 1 / np.where(drawn, pdf[:, 0], 1), 0)
    mean, variance = _moments(case, o, d, met.p, weight)
    # the same by uniform directions
    o = case.around(case.count(2**17, 2**19))
    away = _cone(case, o)
    met = trace(case.target, o, away)
    expected, other = _moments(case, o, away, met.p, np.where(met.found, CONE, 0))
    off = np.abs(mean - expected) - SIGMAS * np.sqrt(variance + other)
    what = (
        "solid angle of what is visible, or its middle or width, by samples against uniform directions, "
        f"beyond {SIGMAS} standard errors"
    )
    why = "the mean of 1 / density over what is seen; lines that graze are left room for"
    law.at_most(what, max(off.max(), 0) / expected[0], 1e-2, why, case.program(POSITIONS))


SINE = 1 / 3  # of the angle between the middle and the rim of the sphere around, from 1.5 sizes away
CONE = 2 * np.pi * (1 - np.sqrt(1 - SINE**2))  # solid angle


def _cone(case: Case, o: Array) -> Array:
    """Return a random direction from each point into the cone that holds the shape."""
    axis = unit(case.middle - o)
    across = unit(np.cross(axis, case.units(len(o))))
    cos = 1 - case.rng.random((len(o), 1)) * CONE / (2 * np.pi)
    return unit(cos * axis + np.sqrt(1 - cos**2) * across)


def _moments(case: Case, o: Array, d: Array, p: Array, weight: Array) -> tuple[Array, Array]:
    """Return means [8] of weights, alone and times place, its squares and the angle, and their variances."""
    place = (p - case.middle) / case.size
    angle = (1 - (d * unit(case.middle - o)).sum(axis=1, keepdims=True)) * 2 * np.pi / CONE
    factors = np.concatenate([np.ones_like(angle), place, 4 * place**2, angle], axis=1)
    found = np.where(weight[:, None] > 0, weight[:, None] * factors, 0)
    return found.mean(axis=0), found.var(axis=0) / len(found)
