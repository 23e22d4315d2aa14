"""Positions and directions that a shape samples: by area, on the surface, with the densities they state."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from mrt_mitsuba.validation.checks import snippets
from mrt_mitsuba.validation.checks.law import LEVEL, SIGMAS, Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, lanes, unit
from mrt_mitsuba.validation.checks.shape_case import FLAT, Case, trace, walk


def sampling(law: Law, case: Case) -> None:
    """Positions by area, judged by where lines cross the surface; directions, and the densities of both."""
    import mitsuba as mi

    if not isinstance(case.shape, mi.Shape):
        raise Skip("not a Mitsuba shape: it has no sample_position()")
    count = case.count(2**14, 2**17)
    u = case.rng.random((count, 2), np.float32)

    def positions(mi: Any, second: Any) -> list[Any]:
        ps = case.shape.sample_position(0, second)
        return [ps.p, ps.n, ps.pdf, case.shape.pdf_position(ps)]

    try:
        p, n, pdf, again = lanes(positions, ("Point2f", u))
        area = float(np.ravel(np.array(case.shape.surface_area()))[0])
    except RuntimeError as problem:
        raise Skip(f"positions cannot be sampled: {str(problem).strip().splitlines()[-1][:120]}") from problem
    for what, measured in (
        ("density of a position against pdf_position()", np.abs(pdf / again - 1).max()),
        ("mean of 1 / density against surface_area()", abs(np.mean(1 / pdf) / area - 1)),
    ):
        law.at_most(
            f"{what}, relative",
            measured,
            1e-3,
            "the same number",
            snippets.positions(case.shape, case.recipe.description),
        )
    start = (p + n * 0.01 * case.size).astype(np.float32)
    back = trace(case.target, start, unit(-n))
    away = np.where(back.found, np.linalg.norm(back.p - p, axis=1), np.inf) / case.size
    # another part of the surface may be nearer than a hundredth of the size
    off = np.quantile(away, 0.9)
    law.at_most(
        "sampled positions off the surface, 9 in 10, in sizes",
        off,
        1e-4,
        "a few roundings",
        case.snippet(start[0], -n[0]),
    )
    _area(law, case, p, area)
    _directions(law, case, u)


def _area(law: Law, case: Case, p: Array, area: float) -> None:
    """Random lines cross a surface in proportion to its area, whatever its form (Crofton)."""
    count = case.count(2**16, 2**18)
    radius = 0.5 * case.size * 1.001
    d = case.units(count)
    a = unit(np.cross(d, case.units(count)))
    disk = radius * np.sqrt(case.rng.random((count, 1)))
    o = (case.middle + disk * a - 2 * radius * d).astype(np.float32)
    crossed, points = np.zeros(count), []
    for line, hit, _ in walk(case.target, o, d):
        crossed[line] += 1
        points.append(hit.p)
    estimate = 2 * np.pi * radius**2 * crossed.mean()
    error = 2 * np.pi * radius**2 * crossed.std() / np.sqrt(count)
    law.at_most(
        f"surface_area() against that by crossings of lines, relative, beyond {SIGMAS} standard errors",
        max(abs(estimate - area) - SIGMAS * error, 0) / area,
        1e-2,
        "lines that graze may cross twice within the offset of a spawned ray",
        snippets.positions(case.shape, case.recipe.description),
    )
    _uniform(law, case, p, np.concatenate(points), max((crossed**2).sum() / crossed.sum(), 1))


def _uniform(law: Law, case: Case, p: Array, points: Array, bunch: float) -> None:
    """Sampled positions against crossings, in cells of equally many made by halving along axes in turn.

    A line's crossings come together: their counts vary ``bunch`` times as much.
    """
    both, cells = np.concatenate([p, points]), np.zeros(len(p) + len(points), int)
    for level, axis in enumerate(case.units(6)):  # aslant, so that flat faces make no jumps
        for cell in range(2**level):
            here = cells == cell
            x = both[here] @ axis
            middle = np.median(x[: int(here[: len(p)].sum())]) if here[: len(p)].any() else 0
            cells[here] = cell + 2**level * (x > middle)
    sampled, crossing = (np.bincount(c, minlength=64) for c in (cells[: len(p)], cells[len(p) :]))
    used, total = sampled + crossing > 20, (sampled.sum(), crossing.sum())
    pull = (sampled / total[0] - crossing / total[1]) ** 2
    mean = (sampled + crossing) / sum(total)
    statistic = (pull / (mean / total[0] + bunch * mean / total[1] + (2e-3 * mean) ** 2))[used].sum()
    law.at_least(
        "chance of such counts in parts of the surface if positions follow its area",
        float(stats.chi2.sf(statistic, max(used.sum() - 1, 1))),
        LEVEL,
        "a false alarm in a million checks",
        snippets.positions(case.shape, case.recipe.description),
    )


def _directions(law: Law, case: Case, u: Array) -> None:
    """``sample_direction`` from outside: meets the shape, and states its own density."""
    count = len(u)
    o = (case.middle + 1.5 * case.size * case.units(count)).astype(np.float32)

    def sample(mi: Any, origin: Any, second: Any) -> list[Any]:
        import drjit as dr

        it = dr.zeros(mi.Interaction3f)
        it.p = origin
        ds = case.shape.sample_direction(it, second)
        return [ds.d, ds.dist, ds.pdf, case.shape.pdf_direction(it, ds)]

    try:
        d, dist, pdf, again = lanes(sample, ("Point3f", o), ("Point2f", u))
    except RuntimeError:
        law.notes.append("the shape has no sample_direction()")
        return
    drawn = pdf[:, 0] > 0
    error = np.where(drawn, np.abs(pdf / again - 1)[:, 0], 0)
    i = int(error.argmax())
    # near an outline the cosine, and the density with it, hangs on roundings
    law.at_most(
        "density of a direction against pdf_direction(), relative, 99 in 100",
        np.quantile(error, 0.99),
        1e-2,
        "the same number; near outlines it hangs on roundings",
        case.snippet(o[i], d[i]),
    )
    met = trace(case.target, o, d.astype(np.float32))
    steep = np.abs((met.n * d).sum(axis=1)) > FLAT
    bad = drawn & steep & met.found & (met.t > dist[:, 0] * (1 + 1e-3))
    lost = drawn & ~met.found
    i = int((bad | lost).argmax())
    law.at_most(
        "share of sampled directions that miss the shape, or reach it behind the sampled point",
        (bad | lost).mean(),
        1e-3,
        "outlines hang on roundings",
        case.snippet(o[i], d[i]),
    )
