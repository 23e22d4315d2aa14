"""Laws of shapes at the ends of what numbers can be: tiny and huge, far away, degenerate rays."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks.law import Law, Skip
from mrt_mitsuba.validation.checks.noise import ROUNDING
from mrt_mitsuba.validation.checks.probe import unit
from mrt_mitsuba.validation.checks.recipe import Kept
from mrt_mitsuba.validation.checks.shape_case import FLAT, HIT_ROUNDINGS, Case, corners, trace

FAR = 1e4  # sizes away

SCALED = """ray
print("as it is, t:", scene.ray_intersect(mi.Ray3f(o, d)).t)
scene = mi.load_dict({{"type": "scene", "shape": load(2.0**{power})}})
print("scaled, t over the scale:", scene.ray_intersect(mi.Ray3f(o * 2.0**{power}, d)).t / 2.0**{power})
"""
TWICE = """ray
for o in (o, mi.Point3f({other})):
    dr.make_opaque(o)
    print("from", o, "it is met at", scene.ray_intersect(mi.Ray3f(o, d)).p)
"""


def scale(law: Law, case: Case) -> None:
    """A millionth and a million times the size: the same, scaled. Powers of two leave no roundings."""
    given = case.with_().get("to_world")
    matrix = given.values if isinstance(given, Kept) else np.eye(4)
    o, d, seen = case.seen
    few = slice(0, case.count(2**12, 2**14))
    o, d, seen = o[few], d[few], seen.only(few)
    steep = ~seen.found | (np.abs((seen.n * d).sum(axis=1)) > FLAT)
    for power in (-20, -10, 10, 20):
        larger = np.diag([2.0**power] * 3 + [1]) @ matrix
        try:
            transform = mi.ScalarTransform4f(larger)
            shape = case.load(to_world=transform)
        except RuntimeError as problem:
            raise Skip(
                f"to_world is not accepted: {str(problem).strip().splitlines()[-1][:200]}"
            ) from problem
        box = shape.bbox()
        grown = np.linalg.norm(np.ravel(np.array(box.max, np.float64) - np.array(box.min, np.float64)))
        if not np.isclose(grown, 2.0**power * case.size, rtol=1e-3):
            raise Skip("to_world does not scale all of it (of curves, the radius stays)")
        there = trace(case.scene(to_world=transform), (o * 2.0**power).astype(np.float32), d)
        bad = steep & (there.found != seen.found)
        what = f"rays answered otherwise at 2^{power} of the size"
        why = "scaling by a power of two rounds nothing; grazing rays are left out"
        law.none(what, bad, why, case.at(o, d, SCALED, power=power))
        both = steep & there.found & seen.found
        apart = np.where(both, np.abs(there.t / 2.0**power - seen.t) / np.where(both, seen.t, 1), 0)
        turned = np.where(both, 1 - (there.n * seen.n).sum(axis=1), 0)
        error = np.maximum(apart, turned)
        what = f"distance (relative) or normal at 2^{power} of the size, off"
        why = "some dozen operations, on scaled numbers"
        law.most(what, error, HIT_ROUNDINGS * ROUNDING, why, case.at(o, d, SCALED, power=power))


def far(law: Law, case: Case) -> None:
    """Hits from ten thousand sizes away are those of the same lines from nearby, to some roundings."""
    _, d, met = case.met
    few = slice(0, case.count(2**12, 2**15))
    goal, d = met.p[few].astype(np.float64), d[few]
    origin = (goal - FAR * case.size * d.astype(np.float64)).astype(np.float32)
    closer = (origin + (FAR - 1.5) * case.size * d.astype(np.float64)).astype(np.float32)
    there, here = trace(case.target, origin, d), trace(case.target, closer, d)
    cos = np.abs((here.n * d).sum(axis=1))
    steep = here.found & (cos > 4 * FLAT)
    distance = FAR * case.size
    error = np.linalg.norm(there.p.astype(np.float64) - here.p, axis=1) * cos / (ROUNDING * distance)
    through = ~there.found | (error > HIT_ROUNDINGS)
    # a rounded origin moves the line: only what all lines around it meet counts
    bad = steep & through & (np.linalg.norm(here.p - met.p[few], axis=1) < 20 * ROUNDING * distance)
    across = unit(np.cross(d, case.units(len(d))))
    for side in (across, -across, np.cross(d, across), np.cross(across, d)):
        beside = trace(case.target, (closer + 4 * ROUNDING * distance * side).astype(np.float32), d)
        bad &= beside.found & ((beside.n * here.n).sum(axis=1) > 0.9)
    what = (
        f"share of rays from afar that miss what is met from nearby, or meet it {HIT_ROUNDINGS} roundings off"
    )
    why = "the origin is rounded, and some dozen operations with it; next to edges, more hangs on them"
    law.share(what, bad, 1e-3, why, case.at(origin, d, TWICE, other=closer))


def finite(law: Law, case: Case) -> None:
    """Rays along axes, from the surface, the middle, corners and very far: all results are finite."""
    _, _, met = case.met
    count = case.count(2**12, 2**15)
    pick = case.rng.integers
    corner = np.where(case.rng.random((count, 3)) < 0.5, case.low, case.high)
    kinds = [
        corner,
        np.broadcast_to(case.middle, (count, 3)),
        met.p[pick(len(met.p), size=count)],
        case.middle + case.size * 10.0 ** case.rng.uniform(0, 5, (count, 1)) * case.units(count),
    ]
    ends = corners(case.plugin)
    if ends is not None:
        kinds.append(ends[pick(len(ends), size=count)])
    o = np.choose(pick(len(kinds), size=count)[:, None], kinds).astype(np.float32)
    d = case.units(count)
    d[case.rng.random(d.shape) < 0.4] = 0
    d += np.where((d == 0).all(axis=1, keepdims=True), [0, 0, 1], 0).astype(np.float32)
    d = unit(d)
    d[(d == 0) & (case.rng.random(d.shape) < 0.3)] = 1e-30
    towards = case.rng.random((count, 1)) < 0.3
    d = np.where(towards, unit(np.where(np.abs(case.middle - o) > 0, case.middle - o, 1)), d)
    found = trace(case.target, o, d)
    numbers = np.concatenate([found.t[:, None], found.p, found.n, found.shading, found.uv], axis=1)
    partials = np.concatenate([found.du, found.dv], axis=1)
    bad = found.found & ~(
        np.isfinite(numbers).all(axis=1) & np.isfinite(partials).all(axis=1) & (found.t >= 0)
    )
    bad |= np.isnan(found.t)  # a miss is infinitely far
    law.none("hits with numbers that are not finite", bad, "one NaN spoils a picture", case.at(o, d))
