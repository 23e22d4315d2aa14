"""``check_shape``: the laws that any shape must obey, stock, mesh or in Python."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.checks import noise, snippets
from mrt_mitsuba.validation.checks.law import Check, Law, Skip, class_name, examine
from mrt_mitsuba.validation.checks.probe import SCALAR_SHARE, Array, is_scalar, lanes, unit
from mrt_mitsuba.validation.checks.recipe import Recipe, Transform

ROUNDING = noise.ROUNDING
OFFSET = 1500 * ROUNDING  # of the origin of a spawned ray from its surface, over 1 + max |p|
SIGMAS = 6
LEVEL = 1e-6
FAR = 1e4  # sizes away
FLAT = 0.05  # cosine below which a ray grazes: what it meets hangs on roundings
HIT_ROUNDINGS = 64  # of the largest number in a ray: some dozen operations
NORMAL = 1e-5  # a few roundings of a square root and a quotient


def check_shape(
    shape: Any, *, quick: bool = False, seed: int = 0, only: Iterable[str] | None = None
) -> Check:
    """Check the laws of a shape in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    An object that is no Mitsuba shape but has ``ray_intersect``, ``ray_test`` and ``bbox`` will do as well.
    ``quick``: fewer rays. ``only``: names of ``LAWS``. Raises ``UsageError`` for anything else.
    """
    import mitsuba as mi

    runtime.use()
    recipe = Recipe.of(shape)
    loaded = shape if recipe.description is None else recipe.load()
    if not all(hasattr(loaded, name) for name in ("ray_intersect", "ray_test", "bbox")):
        raise UsageError(
            f"{type(loaded).__name__} is no shape of {mi.variant()}: give a dict or a loaded shape"
        )
    name = recipe.description["type"] if recipe.description else class_name(loaded)
    with np.errstate(all="ignore"):
        return examine(name, Case(loaded, recipe, quick, seed), LAWS, only=only, quick=quick)


@dataclass(frozen=True)
class Hits:
    """What N rays met."""

    found: Array  # bool [N]
    t: Array  # [N]
    p: Array  # [N, 3], as are the others
    n: Array
    shading: Array
    du: Array
    dv: Array
    uv: Array  # [N, 2]
    part: Array  # index of the triangle or the like [N]

    def only(self, keep: Any) -> Hits:
        return Hits(*(getattr(self, f.name)[keep] for f in fields(self)))


def trace(target: Any, o: Array, d: Array) -> Hits:
    """Trace rays from float32 points [N, 3] in directions [N, 3]."""

    def call(mi: Any, origin: Any, direction: Any) -> list[Any]:
        si = target.ray_intersect(mi.Ray3f(origin, direction))
        return [si.is_valid(), si.t, si.p, si.n, si.sh_frame.n, si.dp_du, si.dp_dv, si.uv, si.prim_index]

    found, t, p, n, shading, du, dv, uv, part = lanes(call, ("Point3f", o), ("Vector3f", d))
    return Hits(found[:, 0].astype(bool), t[:, 0], p, n, shading, du, dv, uv, part[:, 0])


@dataclass
class Case:
    """A shape under examination, rays towards it and what they meet."""

    shape: Any
    recipe: Recipe
    quick: bool
    seed: int

    def __post_init__(self) -> None:
        import mitsuba as mi

        self.rng = np.random.default_rng(self.seed)
        self.target = self.shape
        if isinstance(self.shape, mi.Shape):
            name = self.shape.id()
            self.target = mi.load_dict({"type": "scene", "shape": self.shape})
            self.shape.set_id(name)  # which the scene has changed
        box = self.shape.bbox()
        low, high = (np.ravel(np.array(corner, np.float64)) for corner in (box.min, box.max))
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (high >= low).all()):
            raise UsageError(f"the bounding box of the shape is {low} … {high}: it must be finite")
        self.low, self.high, self.middle = low, high, (low + high) / 2
        self.size = float(np.linalg.norm(high - low))

    def count(self, quick: int, full: int) -> int:
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number

    def units(self, count: int) -> Array:
        return unit(self.rng.normal(size=(count, 3)))

    def rays(self, count: int, distance: float = 1.5) -> tuple[Array, Array]:
        """Return rays from all around to points in the box."""
        o = (self.middle + distance * self.size * self.units(count)).astype(np.float32)
        extent = np.maximum(self.high - self.low, 0.01 * self.size)
        goal = self.middle + extent * self.rng.uniform(-0.55, 0.55, (count, 3))
        return o, unit(goal - o)

    @cached_property
    def seen(self) -> tuple[Array, Array, Hits]:
        """Rays from outside and what they meet."""
        o, d = self.rays(self.count(2**14, 2**17))
        return o, d, trace(self.target, o, d)

    @cached_property
    def met(self) -> tuple[Array, Array, Hits]:
        """Only those that meet the surface, and do not graze it."""
        o, d, hits = self.seen
        steep = hits.found & (np.abs((hits.n * d).sum(axis=1)) > FLAT)
        if steep.sum() < 20:
            raise Skip("hardly any ray towards its bounding box meets the shape")
        return o[steep], d[steep], hits.only(steep)

    @cached_property
    def crossings(self) -> list[tuple[Array, Array, Array]]:
        """Whole lines: of each, hits one after the other as (line, point, cosine with the normal)."""
        o, d, hits = self.seen
        line, found = np.arange(len(o)), []
        for _ in range(16):
            line, d, hits = line[hits.found], d[hits.found], hits.only(hits.found)
            if not len(line):
                break
            cos = (hits.n * d).sum(axis=1)
            found.append((line, hits.p, cos))
            hits = trace(self.target, _leave(hits.p, hits.n, d), d)
        return found

    @cached_property
    def closed(self) -> bool:
        """Whether most lines enter and leave in turn: a closed surface, with holes perhaps."""
        judged, turns = self.turns
        return bool(judged.sum() > 20 and turns[judged].mean() > 0.75)

    @cached_property
    def turns(self) -> tuple[Array, Array]:
        """Which lines meet something and graze nothing, and which leave and enter in turn. Both [N]

        Normals may all point inwards: that is for the law of normals to say.
        """
        count = len(self.seen[0])
        met, steep = np.zeros(count, bool), np.ones(count, bool)
        turn, last = np.ones((2, count), bool), np.array([np.ones(count), -np.ones(count)])
        for line, _, cos in self.crossings:
            met[line] = True
            steep[line] &= np.abs(cos) > 4 * FLAT
            turn[:, line] &= np.sign(cos) != np.sign(last[:, line])
            last[:, line] = cos
        turn &= [last[0] > 0, last[1] < 0]
        judged = met & steep
        return judged, max(turn, key=lambda way: way[judged].mean() if judged.any() else 0)

    def snippet(self, o: Array, d: Array, body: str = snippets.RAY, **names: Any) -> str:
        return snippets.shape(self.shape, self.recipe.description, body, {"o": o, "d": d, **names})


def _leave(p: Array, n: Array, d: Array) -> Array:
    """Return origins off the surface on the side of ``d``, as ``spawn_ray`` has them."""
    side = np.sign((n * d).sum(axis=1, keepdims=True))
    return (p + side * n * OFFSET * (1 + np.abs(p).max(axis=1, keepdims=True))).astype(np.float32)


# ------------------------------------------------- Hits ---------------------------------------------------


def hits(law: Law, case: Case) -> None:
    """``ray_test``, ``ray_intersect_preliminary`` and ``ray_intersect`` agree, and heed ``maxt``."""
    o, d, seen = case.seen
    steep = ~seen.found | (np.abs((seen.n * d).sum(axis=1)) > FLAT)
    t = np.where(seen.found, seen.t, 1)

    def tested(maxt: Array | None) -> Array:
        def call(mi: Any, origin: Any, direction: Any, limit: Any) -> list[Any]:
            ray = mi.Ray3f(origin, direction)
            if maxt is not None:
                ray.maxt = limit
            return [case.target.ray_test(ray), case.target.ray_intersect(ray).is_valid()]

        limit = t if maxt is None else maxt
        return np.array(
            [x[:, 0] for x in lanes(call, ("Point3f", o), ("Vector3f", d), ("Float", limit))], bool
        )

    for what, maxt, expected in (
        ("without a limit", None, seen.found),
        ("up to just before the hit", (t * (1 - 1e-3)).astype(np.float32), np.zeros(len(o), bool)),
        ("up to just behind the hit", (t * (1 + 1e-3)).astype(np.float32), seen.found),
    ):
        counts = steep & seen.found if maxt is not None else steep
        for name, found in zip(("ray_test()", "ray_intersect()"), tested(maxt), strict=True):
            bad = counts & (found != expected)
            i = int(bad.argmax())
            law.at_most(
                f"rays on which {name} is wrong {what}",
                bad.sum(),
                0,
                "one question, one answer; grazing rays are left out",
                case.snippet(o[i], d[i], snippets.MAXT, maxt=np.float32(np.inf) if maxt is None else maxt[i]),
            )


def surface(law: Law, case: Case) -> None:
    """Hit points lie on the ray; rays from the surface meet it no more where they start; little is lost."""
    o, d, met = case.met
    largest = np.maximum(np.abs(o).max(axis=1), np.abs(met.p).max(axis=1)) + met.t
    along = o.astype(np.float64) + met.t[:, None].astype(np.float64) * d
    error = np.abs(along - met.p).max(axis=1) / (ROUNDING * largest)
    i = int(error.argmax())
    law.at_most(
        "hit point off the ray at its distance, in roundings of the largest number",
        error[i],
        HIT_ROUNDINGS,
        "some dozen operations",
        case.snippet(o[i], d[i]),
    )
    count = case.count(10**5, 10**6)
    few = met.only(case.rng.integers(len(met.t), size=count))
    away = case.units(count)
    cos = (few.n * away).sum(axis=1)
    start = _leave(few.p, few.n, away)
    again = trace(case.target, start, away)
    offset = OFFSET * (1 + np.abs(few.p).max(axis=1))
    same = (np.abs((again.n * few.n).sum(axis=1)) > 0.9) & (
        np.linalg.norm(again.p - few.p, axis=1) < 4 * offset
    )
    bad = again.found & same & (np.abs(cos) > FLAT)
    i = int(bad.argmax())
    law.at_most(
        f"rays from the surface, of {count}, that meet it where they start",
        bad.sum(),
        0,
        "self-intersections are dark spots; grazing rays are left out",
        case.snippet(start[i], away[i]),
    )
    _roundoff(law, case)


def _roundoff(law: Law, case: Case) -> None:
    o, d, met = case.met
    few = slice(0, case.count(300, 1000))
    inputs = np.concatenate([o[few], d[few]], axis=1)
    scale = np.abs(o[few]).max(axis=1) + met.t[few]
    for what, pick, size in (
        ("distance", lambda h: h.t, scale),
        ("hit point", lambda h: h.p.sum(axis=1), scale),
        ("normal", lambda h: h.n @ np.array([0.6, 0.48, 0.64]), np.ones_like(scale)),
    ):

        def function(x: Array, pick: Any = pick) -> Array:
            return np.asarray(pick(trace(case.target, x[:, :3], x[:, 3:])))

        found = noise.measure(function, inputs, size=size, stride=64, seed=case.seed)
        lost = np.nan_to_num(found.lost(noise.ALLOWANCE), posinf=0)
        measured = float(np.quantile(lost, 0.9))
        i = int(np.abs(lost - measured).argmin())
        law.at_most(
            f"noise of the {what} over that of {noise.ALLOWANCE:g} roundings with a rounded ray, 9 in 10",
            measured,
            noise.LOST,
            "digits are lost inside that could be kept",
            case.snippet(o[i], d[i]),
        )


# ------------------------------------------------ Normals -------------------------------------------------


def normals(law: Law, case: Case) -> None:
    """Unit length, outwards, as the partial derivatives and differences have it."""
    import mitsuba as mi

    o, d, met = case.met
    length = np.abs(np.linalg.norm(np.stack([met.n, met.shading]).astype(np.float64), axis=-1) - 1).max(
        axis=0
    )
    i = int(np.where(np.isnan(length), np.inf, length).argmax())
    law.at_most(
        "length of a normal less 1",
        length[i],
        NORMAL,
        "a square root and a quotient",
        case.snippet(o[i], d[i]),
    )
    flipped = isinstance(case.shape, mi.Shape) and case.shape.has_flipped_normals()
    if case.closed:
        o, d, seen = case.seen
        judged, turns = case.turns
        bad = judged & turns & (((seen.n * d).sum(axis=1) > 0) != flipped)
        i = int(bad.argmax())
        law.at_most(
            f"rays from outside that meet a normal that points {'outwards' if flipped else 'inwards'}",
            bad.sum(),
            0,
            "a closed shape has an outside",
            case.snippet(o[i], d[i]),
        )
    else:
        law.notes.append("open: there is no outside for normals to point to")
    o, d, met = case.met
    apart = (met.n * met.shading).sum(axis=1) <= 0
    i = int(apart.argmax())
    law.at_most(
        "shading normals on the other side than the geometric one",
        apart.sum(),
        0,
        "one surface",
        case.snippet(o[i], d[i]),
    )
    usable = (np.linalg.norm(met.du, axis=1) > 0) & (np.linalg.norm(met.dv, axis=1) > 0)
    if usable.any():
        slant = np.maximum(*(np.abs((unit(v) * met.n).sum(axis=1)) for v in (met.du, met.dv)))
        slant = np.where(usable & np.isfinite(slant), slant, 0)
        i = int(slant.argmax())
        law.at_most(
            "cosine between the normal and a partial derivative of the point",
            slant[i],
            1e-3,
            "both are known to a few roundings; near a pole the derivatives are short",
            case.snippet(o[i], d[i]),
        )
    _differences(law, case)


def _differences(law: Law, case: Case) -> None:
    """Neighbouring hits against normal and partial derivatives; two widths tell curvature from error."""
    o, d, met = case.met
    aside = unit(np.cross(d, case.units(len(d))))
    slopes, partials = [], []
    for h in (2e-3, 1e-3):
        near = trace(case.target, (o + h * case.size * aside).astype(np.float32), d)
        step = (near.p - met.p).astype(np.float64)
        length = np.linalg.norm(step, axis=1)
        ok = near.found & (near.part == met.part) & (length < 40 * h * case.size) & (length > 0)
        ok &= (near.n * met.n).sum(axis=1) > 0.9
        du, dv = (near.uv - met.uv).T[:, :, None].astype(np.float64)
        slopes.append(np.where(ok, (step * met.n).sum(axis=1) / length, np.nan))
        off = np.linalg.norm(step - du * met.du - dv * met.dv, axis=1) / length
        partials.append(np.where(ok & (np.abs([du, dv]).max(axis=(0, 2)) < 0.2), off, np.nan))
    for what, (wide, narrow) in (
        ("slope of the surface against its normal, by differences", np.abs(slopes)),
        ("step along the surface less its partial derivatives", partials),
    ):
        error = np.maximum(2 * narrow - wide, 0)
        if np.isfinite(error).sum() < 20 or (what.startswith("step") and not met.du.any()):
            continue
        measured = float(np.nanquantile(error, 0.95))
        i = int(np.nanargmin(np.abs(error - measured)))
        law.at_most(
            f"{what}, 95 in 100",
            measured,
            1e-2,
            "extrapolated to no step; edges may part neighbours",
            case.snippet(o[i], d[i], snippets.NEIGHBOUR, aside=aside[i], size=case.size),
        )


def watertight(law: Law, case: Case) -> None:
    """Lines enter and leave in turn, and no ray from inside gets out without a hit."""
    if not case.closed:
        raise Skip("the shape is open: lines do not leave it as often as they enter")
    judged, turns = case.turns
    bad = judged & ~turns
    i = int(bad.argmax())
    law.at_most(
        f"lines, of {judged.sum()}, that do not enter and leave in turn",
        bad.sum(),
        0,
        "a closed surface; grazing lines are left out",
        case.snippet(case.seen[0][i], case.seen[1][i]),
    )
    inside = _inside(case)
    if inside is None:
        law.notes.append("no room inside to start rays in")
        return
    count = case.count(10**5, 10**6)
    o = inside[case.rng.integers(len(inside), size=count)]
    d = case.units(count)
    bad = ~trace(case.target, o, d).found
    i = int(bad.argmax())
    law.at_most(
        f"rays from inside, of {count}, that meet nothing",
        bad.sum(),
        0,
        "a closed surface",
        case.snippet(o[i], d[i]),
    )
    corners = _corners(case)
    if corners is not None:  # the ray tracer's doing, whatever the mesh
        out = ~trace(case.target, o, unit(corners[case.rng.integers(len(corners), size=count)] - o)).found
        if out.any():
            law.notes.append(
                f"of rays aimed at vertices and edges exactly, {out.mean():.2g} pass between triangles"
            )


def _inside(case: Case) -> Array | None:
    """Points well inside: middles of the longer first chords."""
    if len(case.crossings) < 2:
        return None
    (first, p, _), (second, q, _) = case.crossings[:2]
    _, i, j = np.intersect1d(first, second, return_indices=True)
    chord = np.linalg.norm(p[i] - q[j], axis=1)
    return ((p[i] + q[j]) / 2)[chord >= np.median(chord)].astype(np.float32) if len(chord) else None


def _corners(case: Case) -> Array | None:
    """Vertices of a mesh, and middles of edges."""
    import mitsuba as mi

    if not isinstance(case.shape, mi.Mesh):
        return None
    params = mi.traverse(case.shape)
    if not {"vertex_positions", "faces"} <= set(params.keys()):  # a rectangle hides that it is one
        return None
    vertex = np.array(params["vertex_positions"]).reshape(-1, 3)
    face = np.array(params["faces"]).reshape(-1, 3)
    return np.concatenate([vertex, *((vertex[face[:, k]] + vertex[face[:, k - 1]]) / 2 for k in range(3))])


# ----------------------------------------------- Distances ------------------------------------------------


def scale(law: Law, case: Case) -> None:
    """A millionth and a million times the size: the same, scaled. Powers of two leave no roundings."""
    import mitsuba as mi

    given = (case.recipe.with_().description or {}).get("to_world")
    matrix = given.matrix if isinstance(given, Transform) else np.eye(4)
    o, d, seen = case.seen
    few = slice(0, case.count(2**12, 2**14))
    o, d, seen = o[few], d[few], seen.only(few)
    steep = ~seen.found | (np.abs((seen.n * d).sum(axis=1)) > FLAT)
    for power in (-20, -10, 10, 20):
        larger = np.diag([2.0**power] * 3 + [1]) @ matrix
        try:
            shape = case.recipe.with_(to_world=mi.ScalarTransform4f(larger)).load()
        except RuntimeError as problem:
            raise Skip(
                f"to_world is not accepted: {str(problem).strip().splitlines()[-1][:200]}"
            ) from problem
        box = shape.bbox()
        grown = np.linalg.norm(np.ravel(np.array(box.max, np.float64) - np.array(box.min, np.float64)))
        if not np.isclose(grown, 2.0**power * case.size, rtol=1e-3):
            raise Skip("to_world does not scale all of it (of curves, the radius stays)")
        target = mi.load_dict({"type": "scene", "shape": shape})
        there = trace(target, (o * 2.0**power).astype(np.float32), d)
        bad = steep & (there.found != seen.found)
        i = int(bad.argmax())
        law.at_most(
            f"rays answered otherwise at 2^{power} of the size",
            bad.sum(),
            0,
            "scaling by a power of two rounds nothing; grazing rays are left out",
            case.snippet(o[i], d[i], snippets.SCALED, power=power),
        )
        both = steep & there.found & seen.found
        apart = np.where(both, np.abs(there.t / 2.0**power - seen.t) / np.where(both, seen.t, 1), 0)
        turned = np.where(both, 1 - (there.n * seen.n).sum(axis=1), 0)
        error = np.maximum(apart, turned)
        i = int(error.argmax())
        law.at_most(
            f"distance (relative) or normal at 2^{power} of the size, off",
            error[i],
            HIT_ROUNDINGS * ROUNDING,
            "some dozen operations, on scaled numbers",
            case.snippet(o[i], d[i], snippets.SCALED, power=power),
        )


def far(law: Law, case: Case) -> None:
    """From ten thousand sizes away: hit where the same line is hit from nearby, to some roundings."""
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
    through = ~there.found | (error > 4 * HIT_ROUNDINGS)
    error = np.where(steep & ~through, error, 0)
    i = int(error.argmax())
    law.at_most(
        "hit point from afar against the same from nearby, in roundings of the distance",
        error[i],
        HIT_ROUNDINGS,
        "the origin is rounded, and some dozen operations with it",
        case.snippet(origin[i], d[i]),
    )
    # a rounded origin moves the line: only what is surely met counts
    bad = steep & through & (np.linalg.norm(here.p - met.p[few], axis=1) < 20 * ROUNDING * distance)
    i = int(bad.argmax())
    law.at_most(
        "share of rays from afar that miss what they meet from nearby, or meet it elsewhere",
        bad.mean(),
        2e-3,
        "outlines are as wide as the rounding of the distance",
        case.snippet(origin[i], d[i]),
    )


def finite(law: Law, case: Case) -> None:
    """Rays along axes, from the surface, the middle, corners and very far: all results are numbers."""
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
    corners = _corners(case)
    if corners is not None:
        kinds.append(corners[pick(len(corners), size=count)])
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
    i = int(bad.argmax())
    law.at_most(
        "hits with numbers that are none", bad.sum(), 0, "one NaN spoils a picture", case.snippet(o[i], d[i])
    )


# ------------------------------------------- Sampling, box, variants --------------------------------------


def sampling(law: Law, case: Case) -> None:
    """Positions by area, judged by where lines cross the surface; directions, and the densities of both."""
    import mitsuba as mi

    if not isinstance(case.shape, mi.Shape):
        raise Skip("no Mitsuba shape: there is no sample_position()")
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
    from scipy import stats

    count = case.count(2**16, 2**18)
    radius = 0.5 * case.size * 1.001
    d = case.units(count)
    a = unit(np.cross(d, case.units(count)))
    disk = radius * np.sqrt(case.rng.random((count, 1)))
    o = (case.middle + disk * a - 2 * radius * d).astype(np.float32)
    line, crossed, points = np.arange(count), np.zeros(count), []
    hit = trace(case.target, o, d)
    for _ in range(16):
        line, d, hit = line[hit.found], d[hit.found], hit.only(hit.found)
        if not len(line):
            break
        crossed[line] += 1
        points.append(hit.p)
        hit = trace(case.target, _leave(hit.p, hit.n, d), d)
    estimate = 2 * np.pi * radius**2 * crossed.mean()
    error = 2 * np.pi * radius**2 * crossed.std() / np.sqrt(count)
    law.at_most(
        f"surface_area() against that by crossings of lines, relative, beyond {SIGMAS} standard errors",
        max(abs(estimate - area) - SIGMAS * error, 0) / area,
        1e-2,
        "lines that graze may cross twice within the offset of a spawned ray",
        snippets.positions(case.shape, case.recipe.description),
    )
    # cells of equally many sampled positions, by halving along axes in turn
    both = np.concatenate([p, *points])
    cells = np.zeros(len(both), int)
    axes = case.units(6)  # aslant, so that flat faces are no jumps
    for level in range(6):
        for cell in range(2**level):
            here = cells == cell
            x = both[here] @ axes[level]
            middle = np.median(x[: int(here[: len(p)].sum())]) if here[: len(p)].any() else 0
            cells[here] = cell + 2**level * (x > middle)
    sampled, crossing = (np.bincount(c, minlength=64) for c in (cells[: len(p)], cells[len(p) :]))
    used = sampled + crossing > 20
    # a line's crossings come together: that many times the variance
    bunch = max((crossed**2).sum() / crossed.sum(), 1)
    total = sampled.sum(), crossing.sum()
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
        law.notes.append("sample_direction() is not there")
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


def bbox(law: Law, case: Case) -> None:
    """Whatever is hit or sampled lies in the bounding box."""
    import mitsuba as mi

    o, d, met = case.met
    points = [met.p]
    corners = _corners(case)
    if corners is not None:
        points.append(corners)
    elif isinstance(case.shape, mi.Shape):
        try:
            u = case.rng.random((len(o), 2), np.float32)
            points += lanes(lambda mi, x: [case.shape.sample_position(0, x).p], ("Point2f", u))
        except RuntimeError:
            law.notes.append("sample_position() is not there")
    p = np.concatenate(points)
    out = np.maximum(case.low - p, p - case.high).max(axis=1) / case.size
    i = int(out.argmax())
    law.at_most(
        "points outside the bounding box, in sizes",
        max(out[i], 0),
        1e-5,
        "some roundings",
        case.snippet(o[min(i, len(o) - 1)], d[min(i, len(o) - 1)]),
    )


def variants(law: Law, case: Case) -> None:
    """The same hits in the scalar variant, or of a scalar one in the vectorised."""
    import mitsuba as mi

    case.recipe.with_()
    here = mi.variant()
    swap = ("scalar_", "llvm_ad_") if is_scalar() else (here.split("_")[0] + "_ad_", "scalar_")
    other = here.replace(*swap)
    if other not in mi.variants() or runtime.obstacle(other):
        raise Skip(f"{other} cannot run here")
    few = slice(0, case.count(500, 2000))
    o, d, seen = case.seen[0][few], case.seen[1][few], case.seen[2].only(few)
    try:
        mi.set_variant(other)
        runtime.use(other)
        there = trace(mi.load_dict({"type": "scene", "shape": case.recipe.load()}), o, d)
    except RuntimeError as problem:
        if "not found" not in str(problem):
            raise
        raise Skip(f"{other} does not know the plugin: register it there, too") from problem
    finally:
        mi.set_variant(here)
    steep = np.abs((seen.n * d).sum(axis=1)) > FLAT
    bad = (there.found != seen.found) & (steep | ~seen.found)
    both = there.found & seen.found & steep
    scale = np.abs(o).max(axis=1) + seen.t
    error = np.where(both, np.abs(there.t - seen.t) / (ROUNDING * scale), 0)
    i = int((bad if bad.any() else error).argmax())
    law.at_most(
        f"share of rays answered otherwise in {other}",
        bad.mean(),
        2e-3,
        "outlines hang on roundings",
        case.snippet(o[i], d[i]),
    )
    law.at_most(
        f"distance in {other}, off by roundings of the largest number",
        error.max(),
        4 * HIT_ROUNDINGS,
        "some dozen operations each, and another cosine with the surface",
        case.snippet(o[i], d[i]),
    )


LAWS = {
    "hits": hits,
    "surface": surface,
    "normals": normals,
    "watertight": watertight,
    "scale": scale,
    "far": far,
    "finite": finite,
    "sampling": sampling,
    "bbox": bbox,
    "variants": variants,
}
