"""``check_shape``: the laws that any shape must obey, stock, mesh or in Python.

A new law is a function of ``Law`` and ``Case`` and a row of ``LAWS``; see ``bsdf``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.checks import law as laws
from mrt_mitsuba.validation.checks import noise
from mrt_mitsuba.validation.checks.law import LEVEL, SIGMAS, TIMEOUT, Check, Law, Skip, Subject, figures, rare
from mrt_mitsuba.validation.checks.noise import ROUNDING
from mrt_mitsuba.validation.checks.probe import Array, Lanes, lanes, unit
from mrt_mitsuba.validation.tools.compare import sidak

OFFSET = 1500 * ROUNDING  # of the origin of a spawned ray from its surface, over 1 + max |p|
FLAT = 0.05  # cosine below which a ray grazes: what it meets hangs on roundings
MOST_HITS = 16  # along a line
HIT_ROUNDINGS = 64  # of the largest number in a ray: some dozen operations
TYPICAL = 16  # roundings: twice the most that was measured of sound shapes
FAR = 1e4  # sizes away
SMOOTHED = ("SDFGrid", "BSplineCurve", "LinearCurve", "Instance")

RAY = """si = scene.ray_intersect(mi.Ray3f(o, d))
print(si)
back = scene.ray_intersect(mi.Ray3f(si.spawn_ray(d).o, -d))
print("from just behind:", back.n, "at", back.t)
"""


def check_shape(
    shape: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check the laws of a shape in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    Any other object that has ``ray_intersect``, ``ray_test`` and ``bbox`` will do as well.
    ``quick``: fewer rays. ``only``: names of ``LAWS``. ``timeout``: seconds after which a law fails that is
    not done. Raises ``UsageError`` for anything else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    return laws.examine(Case, shape, LAWS, quick=quick, seed=seed, only=only, timeout=timeout)


# --------------------------------------- Rays and what they meet ---------------------------------------


def trace(target: Any, o: Array, d: Array) -> Lanes:
    """Trace rays from float32 points [N, 3] in directions [N, 3].

    Return whether each ``found`` anything, the distance ``t``, the points and vectors ``p``, ``n``,
    ``shading``, ``du``, ``dv`` [N, 3], ``uv`` [N, 2], the index of the triangle or the like (``part``), and
    whether the surface is ``steep``: met, and not in passing.
    """

    def call(origin: Any, direction: Any) -> list[Any]:
        si = target.ray_intersect(mi.Ray3f(origin, direction))
        return [si.is_valid(), si.t, si.p, si.n, si.sh_frame.n, si.dp_du, si.dp_dv, si.uv, si.prim_index]

    names = ("found", "t", "p", "n", "shading", "du", "dv", "uv", "part")
    hits = Lanes(**dict(zip(names, lanes(call, ("Point3f", o), ("Vector3f", d)), strict=True)))
    hits.cos = dot(hits.n, d)
    hits.steep = hits.found & (np.abs(hits.cos) > FLAT)
    return hits


def dot(a: Array, b: Array) -> Array:
    """Return the dot products of vectors [N, 3]."""
    return (a * b).sum(axis=-1)


def walk(target: Any, o: Array, d: Array, first: Lanes | None = None) -> Iterator[tuple[Array, Lanes]]:
    """Follow N lines through all that they meet; yield hit by hit which lines do, and what they meet."""
    line, hits = np.arange(len(o)), first or trace(target, o, d)
    for _ in range(MOST_HITS):
        line, d, hits = line[hits.found], d[hits.found], hits.only(hits.found)
        if not len(line):
            return
        yield line, hits
        hits = trace(target, leave(hits.p, hits.n, d), d)


class Case(Subject):
    """A shape under examination, rays towards it and what they meet."""

    word = "shape"

    def __init__(self, given: Any, quick: bool, seed: int) -> None:
        super().__init__(given, quick, seed)
        if not all(hasattr(self.plugin, name) for name in ("ray_intersect", "ray_test", "bbox")):
            kind = type(self.plugin).__name__
            raise UsageError(f"{kind} is not a shape of {mi.variant()}: give a dict or a loaded shape")
        self.target = self.plugin
        if laws.class_name(self.plugin) == "Instance":
            if self.description is None:
                raise UsageError("a loaded instance does not give its group away: give a dict of both")
            self.target = self.scene()
        elif isinstance(self.plugin, mi.Shape):
            name = self.plugin.id()
            self.target = mi.load_dict({"type": "scene", "shape": self.plugin})
            self.plugin.set_id(name)  # which the scene has changed
        box = self.plugin.bbox()
        self.box = np.array([np.ravel(np.array(corner, np.float64)) for corner in (box.min, box.max)])
        if not np.isfinite(self.box).all() or (self.box[1] < self.box[0]).any():
            raise UsageError(f"the bounding box of the shape is {self.box}: it must be finite")
        self.points = self.box  # and of a mesh the vertices and the middles of edges
        params = mi.traverse(self.plugin) if isinstance(self.plugin, mi.Mesh) else {}
        if "faces" in params:  # a rectangle hides that it is a mesh
            vertex, face = (np.array(params[name]).reshape(-1, 3) for name in ("vertex_positions", "faces"))
            middles = [(vertex[face[:, k]] + vertex[face[:, k - 1]]) / 2 for k in range(3)]
            self.points = np.concatenate([self.box, vertex, *middles])
        self.low, self.high = self.points.min(axis=0), self.points.max(axis=0)  # the box itself may be wrong
        self.middle, self.size = (self.low + self.high) / 2, float(np.linalg.norm(self.high - self.low))

    def around(self, count: int) -> Array:
        """Return points that look at the shape, from 1.5 sizes away."""
        return (self.middle + 1.5 * self.size * self.units(count)).astype(np.float32)

    @cached_property
    def seen(self) -> tuple[Array, Array, Lanes]:
        """Rays from all around to points in the box, and what they meet."""
        o = self.around(self.count(2**14, 2**17))
        extent = np.maximum(self.high - self.low, 0.01 * self.size)
        d = unit(self.middle + extent * self.rng.uniform(-0.55, 0.55, o.shape) - o)
        return o, d, trace(self.target, o, d)

    @cached_property
    def met(self) -> tuple[Array, Array, Lanes]:
        """The rays that meet the surface and do not graze it, and their hits."""
        o, d, hits = self.seen
        if hits.steep.sum() < 20:
            raise Skip("hardly any ray towards its bounding box meets the shape")
        return o[hits.steep], d[hits.steep], hits.only(hits.steep)

    @cached_property
    def behind(self) -> Lanes:
        """The hits of rays that come back from just behind ``met``."""
        _, d, hits = self.met
        return trace(self.target, leave(hits.p, hits.n, d), -d)

    @cached_property
    def positions(self) -> tuple[list[Array], Array, float]:
        """Sampled positions: points, normals, densities stated and asked for; their ``u``; and the area."""
        u = self.uniform(self.count(2**14, 2**19), 2)

        def sample(second: Any) -> list[Any]:
            ps = self.plugin.sample_position(0, second)
            return [ps.p, ps.n, ps.pdf, self.plugin.pdf_position(ps)]

        try:
            area = float(np.ravel(np.array(self.plugin.surface_area()))[0])
            return lanes(sample, ("Point2f", u)), u, area
        except (AttributeError, RuntimeError) as problem:
            raise Skip("positions cannot be sampled") from problem

    @cached_property
    def crossings(self) -> list[tuple[Array, Lanes]]:
        """Whole lines: hit by hit, which line, and what it meets."""
        return list(walk(self.target, *self.seen))

    @cached_property
    def closed(self) -> bool:
        """Whether most lines cross the surface an even number of times: it is closed, with holes perhaps."""
        judged, even = self.lines
        return bool(judged.sum() > 20 and even[judged].mean() > 0.75)

    @cached_property
    def lines(self) -> tuple[Array, Array]:
        """Which lines can be judged, and which cross the surface an even number of times; both [N]."""
        met, even = self.seen[2].found, np.ones(len(self.seen[0]), bool)
        clear, last = met.copy(), np.full((len(met), 3), np.inf)
        for line, hits in self.crossings:
            clear[line] &= (np.abs(hits.cos) > 4 * FLAT) & ~near(hits.p, last[line])
            even[line] ^= True
            last[line] = hits.p
        return clear, even


def offset(p: Array) -> Array:
    """Return how far off the surface ``spawn_ray`` starts from points [N, 3]."""
    return OFFSET * (1 + np.abs(p).max(axis=1))


def near(p: Array, q: Array) -> Array:
    """Return whether points [N, 3] are one, for all that a spawned ray can tell."""
    return np.linalg.norm(p - q, axis=1) < 4 * offset(p)


def leave(p: Array, n: Array, d: Array) -> Array:
    """Return origins off the surface on the side of ``d``, as ``spawn_ray`` has them."""
    return (p + np.sign(dot(n, d))[:, None] * n * offset(p)[:, None]).astype(np.float32)


# ------------------------------------------------- Laws ------------------------------------------------

MAXT = """ray = mi.Ray3f(o, d)
print("meets the surface at", scene.ray_intersect(ray).t)
ray.maxt = float("{maxt}")
print("up to", ray.maxt, "ray_test():", scene.ray_test(ray), "ray_intersect():", scene.ray_intersect(ray).t)
"""
ONE = "one question, one answer; of rays that graze, only those that just miss count"


@figures(
    ray_test=("share", "share of rays {rays} on which ray_test() is wrong", 0, ONE, MAXT),
    ray_intersect=("share", "share of rays {rays} on which ray_intersect() is wrong", 0, ONE, MAXT),
)  # fmt: skip
def hits(law: Law, case: Case) -> None:
    """``ray_test`` and ``ray_intersect`` agree, and respect ``maxt``, from outside and from the surface."""
    _, _, met = case.met
    away = case.units(len(met.t))
    start = leave(met.p, met.n, away)
    for rays, (o, d, seen), reach in (
        ("without a limit", case.seen, np.inf),
        ("up to just before the hit", case.met, 1 - 1e-3),
        ("up to just behind the hit", case.met, 1 + 1e-3),
        ("that leave the surface", (start, away, trace(case.target, start, away)), np.inf),
    ):
        maxt = (seen.t * reach).astype(np.float32)

        def call(origin: Any, direction: Any, most: Any) -> list[Any]:
            ray = mi.Ray3f(origin, direction)
            ray.maxt = most
            return [case.target.ray_test(ray), case.target.ray_intersect(ray).is_valid()]

        answers = lanes(call, ("Point3f", o), ("Vector3f", d), ("Float", maxt))
        for name, answer in zip(("ray_test", "ray_intersect"), answers, strict=True):
            wrong = (~seen.found | seen.steep) & (answer != (seen.found & (reach > 1)))
            law.hold(name, wrong, limit=5e-4 if np.isinf(reach) else 0, o=o, d=d, maxt=maxt, rays=rays)


@figures(
    on_ray=("most", "hit point off the ray at its distance, in roundings of the largest number",
            HIT_ROUNDINGS, "some dozen operations", RAY),
    near_by=(0.5, "hit point off a ray of a twentieth of the size, in roundings of the largest coordinate, "
             "median", TYPICAL, "a few operations", RAY),
    behind=(0.5, "hit points from in front and from behind, across the surface, in roundings of the largest "
            "coordinate, median", TYPICAL, "a few operations", RAY),
    again=("none", "rays from the surface, of {count}, that meet it where they start", 0,
           "self-intersections are dark spots; grazing rays are left out", RAY),
    missed=("share", "share of rays from a thousandth of the size before the surface that do not meet "
            "it there", 2e-3, "no absolute limits; outlines hang on roundings", RAY),
    noise=(0.9, f"noise of the {{what}} over that of {noise.ALLOWANCE:g} roundings with a rounded ray, "
           "9 in 10", noise.LOST, "digits are lost inside that could be kept", RAY),
)  # fmt: skip
def surface(law: Law, case: Case) -> None:
    """p = o + t d is on the surface; spawned rays do not meet it where they start; digits are kept."""
    o, d, met = case.met
    largest = np.maximum(np.abs(o).max(axis=1), np.abs(met.p).max(axis=1)) + met.t
    off = np.abs(o.astype(np.float64) + met.t[:, None] * d - met.p).max(axis=1)
    law.hold("on_ray", off / (ROUNDING * largest), o=o, d=d)
    _from_near_by(law, case)
    count = case.count(10**5, 10**6)
    few, away = met.only(case.rng.integers(len(met.t), size=count)), case.units(count)
    start = leave(few.p, few.n, away)
    again = trace(case.target, start, away)
    # another part may truly be that near, in a hollow edge
    alike = np.abs(dot(again.n, few.n)) > np.where(again.part == few.part, 0.9, 0.9999)
    bad = again.found & near(few.p, again.p) & alike & (np.abs(dot(few.n, away)) > FLAT)
    law.hold("again", bad, o=start, d=away, count=count)
    before = (met.p - 1e-3 * case.size * d).astype(np.float32)
    again = trace(case.target, before, d)
    missed = ~again.found | (np.linalg.norm(again.p - met.p, axis=1) >= 1e-3 * case.size)
    law.hold("missed", missed, o=before, d=d)
    first, scale = slice(0, case.count(300, 1000)), np.abs(o).max(axis=1) + met.t
    inputs = np.concatenate([o, d], axis=1)[first]
    for what, size, pick in (
        ("distance", scale, lambda x: trace(case.target, x[:, :3], x[:, 3:]).t),
        ("hit point", scale, lambda x: trace(case.target, x[:, :3], x[:, 3:]).p.sum(axis=1)),
        ("normal", 1 + 0 * scale, lambda x: trace(case.target, x[:, :3], x[:, 3:]).n @ [0.6, 0.48, 0.64]),
    ):
        found = noise.measure(pick, inputs, size=size[first], strides=(64,), seed=case.seed)
        law.hold("noise", found.lost, o=o, d=d, what=what)


def _from_near_by(law: Law, case: Case) -> None:
    """From near by, and from the other side, numbers are small, and points that are off show."""
    few = slice(0, case.count(2**12, 2**15))
    d, met = case.met[1][few], case.met[2].only(few)
    close = (met.p - 0.05 * case.size * d).astype(np.float32)
    again = trace(case.target, close, d)
    same, largest = again.found & near(met.p, again.p), np.abs(met.p).max(axis=1) + 0.05 * case.size
    off = np.abs(close + again.t[:, None].astype(np.float64) * d - again.p).max(axis=1)
    # the same line the other way around, from as far behind
    back = trace(case.target, (met.p + 0.05 * case.size * d).astype(np.float32), -d)
    apart = np.linalg.norm(back.p.astype(np.float64) - again.p, axis=1) * np.abs(dot(met.n, d))
    alike = same & back.found & (back.part == met.part) & (apart < 0.01 * case.size)
    alike &= case.behind.found.mean() > 0.5  # else rays pass it from behind
    for name, error, known in (("near_by", off, same), ("behind", apart, alike)):
        if known.sum() > 20:
            law.hold(name, np.where(known, error / (ROUNDING * largest), np.nan), o=close, d=d)


NEIGHBOUR = """aside = mi.Vector3f({aside})
si = scene.ray_intersect(mi.Ray3f(o, d))
near = scene.ray_intersect(mi.Ray3f(o + 1e-3 * {size} * aside, d))
step, uv = near.p - si.p, near.uv - si.uv
print("slope against the normal:", dr.dot(step, si.n) / dr.norm(step))
print("step", step, "by partial derivatives:", si.dp_du * uv.x + si.dp_dv * uv.y)
"""
PARTED = "extrapolated to no step; edges may part neighbours"


@figures(
    outwards=("share", "share of rays from outside whose normal points the wrong way", 1e-3,
              "a closed shape has an outside; what edges hide is left room for", RAY),
    length=("most", "length of a normal less 1", 1e-5, "a square root and a quotient", RAY),
    side=("none", "shading normals on the other side than the geometric one", 0, "one surface", RAY),
    shading=(0.9, "shading normal against the geometric one, except on smoothed meshes, 9 in 10",
             2e-3, "the same, within some roundings", RAY),
    turned=("share", "share of normals that turn where the same point is met from behind", 1e-3,
            "a surface has one normal; thin parts are left room for", RAY),
    slant=("most", "cosine between the normal and a partial derivative of the point", 1e-3,
           "both are known to a few roundings; near a pole the derivatives are short", RAY),
    slope=(0.95, "slope of the surface against its normal, by differences, 95 in 100", 1e-2, PARTED,
           NEIGHBOUR),
    step=(0.95, "step along the surface less its partial derivatives, 95 in 100", 1e-2, PARTED, NEIGHBOUR),
)  # fmt: skip
def normals(law: Law, case: Case) -> None:
    """n has unit length, points outwards, n · ∂p/∂u = n · ∂p/∂v = 0, and differences of points agree."""
    if case.closed:
        o, d, seen = case.seen
        judged, even = case.lines
        flipped = isinstance(case.plugin, mi.Shape) and case.plugin.has_flipped_normals()
        law.hold("outwards", judged & even & ((dot(seen.n, d) > 0) != flipped), o=o, d=d)
    else:
        law.notes.append("open: there is no outside for normals to point to")
    o, d, met = case.met
    length = np.linalg.norm(np.stack([met.n, met.shading]).astype(np.float64), axis=-1)
    law.hold("length", np.abs(length - 1).max(axis=0), o=o, d=d)
    law.hold("side", dot(met.n, met.shading) <= 0, o=o, d=d)
    smoothed = isinstance(case.plugin, mi.Mesh) and case.plugin.has_vertex_normals()
    if not smoothed and laws.class_name(case.plugin) not in SMOOTHED:
        law.hold("shading", np.linalg.norm(met.shading - met.n, axis=1), o=o, d=d)
    # the normal is the surface's, not the ray's: the same for a ray that comes back from behind
    back = case.behind
    same = back.found & near(met.p, back.p) & (back.part == met.part)
    if same.sum() > 20:
        law.hold("turned", same & (dot(back.n, met.n) < -0.5), o=o, d=d)
    slant = np.maximum(*(np.abs(dot(unit(v), met.n)) for v in (met.du, met.dv)))  # NaN of derivatives of 0
    if np.isfinite(slant).any():
        law.hold("slant", np.where(np.isfinite(slant), slant, 0), o=o, d=d)
    _differences(law, case)


def _differences(law: Law, case: Case) -> None:
    """Neighbouring hits against normal and partial derivatives; two widths separate curvature from error."""
    o, d, met = case.met
    aside = unit(np.cross(d, case.units(len(d))))
    slopes, partials = [], []
    for h in (2e-3, 1e-3):
        other = trace(case.target, (o + h * case.size * aside).astype(np.float32), d)
        step = (other.p - met.p).astype(np.float64)
        length = np.linalg.norm(step, axis=1)
        ok = other.found & (other.part == met.part) & (length < 40 * h * case.size) & (length > 0)
        ok &= dot(other.n, met.n) > 0.9
        du, dv = (other.uv - met.uv).T[:, :, None].astype(np.float64)
        slopes.append(np.where(ok, np.abs(dot(step, met.n)) / length, np.nan))
        off = np.linalg.norm(step - du * met.du - dv * met.dv, axis=1) / length
        ok &= (np.abs([du, dv]).max(axis=(0, 2)) < 0.2) & met.du.any()
        partials.append(np.where(ok, off, np.nan))
    for name, (wide, narrow) in (("slope", slopes), ("step", partials)):
        if np.isfinite(wide + narrow).sum() >= 20:
            law.hold(name, np.maximum(2 * narrow - wide, 0), o=o, d=d, aside=aside, size=case.size)


@figures(
    blind=("share", "share of rays that pass the surface from behind", 1e-2,
           "it has two sides; edges have room", RAY),
    odd=("share", "share of lines, of {judged}, that cross the surface an odd number of times", 1e-3,
         "near sharp edges, the offset of a ray that goes on leads out again; grazing lines are left out",
         RAY),
    out=("at most", "share of rays from inside, of {count}, that surely meet nothing", 1e-5,
         "a closed surface; of a million rays at triangles, some pass along an edge", RAY),
)  # fmt: skip
def watertight(law: Law, case: Case) -> None:
    """Lines enter and leave in turn, and no ray from inside gets out without a hit."""
    o, d, met = case.met
    # else such a ray may fall off an edge, or its offset be larger than the shape
    steep = (np.abs(met.cos) > 0.5) & (offset(met.p) < 1e-3 * case.size)
    blind = steep & ~case.behind.found
    if blind.mean() > 1e-2:
        law.hold("blind", blind, o=o, d=d)
        return
    if not case.closed:
        raise Skip("the shape is open: lines do not leave it as often as they enter")
    (o, d, _), (judged, even) = case.seen, case.lines
    law.hold("odd", judged & ~even, o=o, d=d, judged=judged.sum())
    inside = np.zeros((0, 3), np.float32)
    if len(case.crossings) > 1:  # points well inside: middles of the longer first chords
        (first, enter), (second, leaving) = case.crossings[:2]
        _, i, j = np.intersect1d(first, second, return_indices=True)
        chord = np.linalg.norm(enter.p[i] - leaving.p[j], axis=1)
        inside = ((enter.p[i] + leaving.p[j]) / 2)[chord >= np.median(chord)].astype(np.float32)
    if not len(inside):
        law.notes.append("no room inside to start rays in")
        return
    count = case.count(10**5, 10**6)
    o, d = inside[case.rng.integers(len(inside), size=count)], case.units(count)
    out = ~trace(case.target, o, d).found
    surely = stats.binomtest(int(out.sum()), count).proportion_ci(1 - 2 * LEVEL).low  # Clopper and Pearson
    law.hold("out", surely, o=o[out.argmax()], d=d[out.argmax()], count=count)


SCALED = """print("as it is, t:", scene.ray_intersect(mi.Ray3f(o, d)).t)
shape = load(to_world=mi.ScalarTransform4f({matrix}))
scene = mi.load_dict({{"type": "scene", "shape": shape}})
print("scaled, t over the scale:", scene.ray_intersect(mi.Ray3f(o * 2.0**{power}, d)).t / 2.0**{power})
"""


@figures(
    answer=("none", "rays answered otherwise at 2^{power} of the size", 0,
            "scaling by a power of two rounds nothing; grazing rays are left out", SCALED),
    off=("most", "distance (relative) or normal at 2^{power} of the size, off", HIT_ROUNDINGS * ROUNDING,
         "some dozen operations, on scaled numbers", SCALED),
)  # fmt: skip
def scale(law: Law, case: Case) -> None:
    """A millionth and a million times the size: the same, scaled. Powers of two leave no roundings."""
    matrix = getattr(case.with_().get("to_world"), "values", np.eye(4))
    few = slice(0, case.count(2**12, 2**14))
    o, d, seen = case.seen[0][few], case.seen[1][few], case.seen[2].only(few)
    for power in (-20, -10, 10, 20):
        larger = np.diag([2.0**power] * 3 + [1]) @ matrix
        try:
            box = case.load(to_world=mi.ScalarTransform4f(larger)).bbox()
        except RuntimeError as problem:
            raise Skip("to_world is not accepted") from problem
        grown = np.linalg.norm(np.ravel(np.array(box.max, np.float64) - np.array(box.min, np.float64)))
        if not np.isclose(grown, 2.0**power * case.size, rtol=1e-3):
            raise Skip("to_world does not scale all of it (of curves, the radius stays)")
        scene = case.scene(to_world=mi.ScalarTransform4f(larger))
        there = trace(scene, (o * 2.0**power).astype(np.float32), d)
        both = seen.steep & there.found
        apart = np.abs(there.t / 2.0**power - seen.t) / np.where(both, seen.t, 1)
        error = np.where(both, np.maximum(apart, 1 - dot(there.n, seen.n)), 0)
        otherwise = (~seen.found | seen.steep) & (there.found != seen.found)
        for name, errors in (("answer", otherwise), ("off", error)):
            law.hold(name, errors, o=o, d=d, power=power, matrix=larger.tolist())


TWICE = """for o in (o, mi.Point3f({other})):
    dr.make_opaque(o)
    print("from", o, "it is met at", scene.ray_intersect(mi.Ray3f(o, d)).p)
"""


@figures(missed=("share", "share of rays from afar that miss what is met from nearby, or meet it "
                 f"{HIT_ROUNDINGS} roundings off", 1e-3, "the origin is rounded, and some dozen operations "
                 "with it; next to edges, more hangs on them", TWICE))  # fmt: skip
def far(law: Law, case: Case) -> None:
    """Hits from ten thousand sizes away are those of the same lines from nearby, to some roundings."""
    few, distance = slice(0, case.count(2**12, 2**15)), FAR * case.size
    goal, d = case.met[2].p[few].astype(np.float64), case.met[1][few]
    origin = (goal - distance * d.astype(np.float64)).astype(np.float32)
    closer = (origin + (FAR - 1.5) * case.size * d.astype(np.float64)).astype(np.float32)
    there, here = trace(case.target, origin, d), trace(case.target, closer, d)
    cos = np.abs(here.cos)
    error = np.linalg.norm(there.p.astype(np.float64) - here.p, axis=1) * cos / (ROUNDING * distance)
    bad = here.found & (cos > 4 * FLAT) & (~there.found | (error > HIT_ROUNDINGS))
    # a rounded origin moves the line: only what all lines around it meet counts
    bad &= np.linalg.norm(here.p - goal, axis=1) < 20 * ROUNDING * distance
    across = unit(np.cross(d, case.units(len(d))))
    for side in (across, -across, np.cross(d, across), np.cross(across, d)):
        aside = trace(case.target, (closer + 4 * ROUNDING * distance * side).astype(np.float32), d)
        bad &= aside.found & (dot(aside.n, here.n) > 0.9)
    law.hold("missed", bad, o=origin, d=d, other=closer)


@figures(bad=("none", "hits with numbers that are not finite", 0, "one NaN spoils a picture", RAY))
def finite(law: Law, case: Case) -> None:
    """Rays along axes, from the surface, the middle, corners and very far: all results are finite."""
    _, _, met = case.met
    count, pick = case.count(2**12, 2**15), case.rng.integers
    kinds = (
        np.where(case.rng.random((count, 3)) < 0.5, case.low, case.high),
        np.broadcast_to(case.middle, (count, 3)),
        met.p[pick(len(met.p), size=count)],
        case.middle + case.size * 10.0 ** case.rng.uniform(0, 5, (count, 1)) * case.units(count),
        case.points[pick(len(case.points), size=count)],
    )
    o = np.choose(pick(len(kinds), size=count)[:, None], kinds).astype(np.float32)
    d = case.units(count)
    d[case.rng.random(d.shape) < 0.4] = 0
    d = unit(d + np.where((d == 0).all(axis=1, keepdims=True), [0, 0, 1], 0))
    d[(d == 0) & (case.rng.random(d.shape) < 0.3)] = 1e-30
    towards = unit(np.where(np.abs(case.middle - o) > 0, case.middle - o, 1))
    d = np.where(case.rng.random((count, 1)) < 0.3, towards, d)
    found = trace(case.target, o, d)
    vectors = (found.p, found.n, found.shading, found.uv, found.du, found.dv)
    sound = np.isfinite(np.concatenate([found.t[:, None], *vectors], axis=1)).all(axis=1) & (found.t >= 0)
    law.hold("bad", np.where(found.found, ~sound, np.isnan(found.t)), o=o, d=d)  # a miss is infinitely far


@figures(outside=("at most", "points outside the bounding box, in sizes", 1e-5, "some roundings", RAY))
def bbox(law: Law, case: Case) -> None:
    """Whatever is hit or sampled lies in the bounding box."""
    o, d, met = case.met
    points = [met.p, case.points]
    with suppress(Skip):
        points.append(case.positions[0][0])
    p = np.concatenate(points)
    out = np.maximum(case.box[0] - p, p - case.box[1]).max(axis=1) / case.size
    i = min(int(out.argmax()), len(o) - 1)
    law.hold("outside", out.max(), o=o[i], d=d[i])


@figures(
    answer=("share", "share of rays answered otherwise in {other}", 2e-3, "outlines hang on roundings", RAY),
    distance=("most", "distance in {other}, off by roundings of the largest number", 4 * HIT_ROUNDINGS,
              "some dozen operations each, and another cosine with the surface", RAY),
)  # fmt: skip
def variants(law: Law, case: Case) -> None:
    """Hits in the scalar variant against those in the vectorised one."""
    case.with_()
    few, other = slice(0, case.count(500, 2000)), case.other_kind
    o, d, seen = case.seen[0][few], case.seen[1][few], case.seen[2].only(few)
    there = case.elsewhere(other, lambda: trace(case.scene(), o, d))
    law.hold("answer", (there.found != seen.found) & (seen.steep | ~seen.found), o=o, d=d, other=other)
    error = np.abs(there.t - seen.t) / (ROUNDING * (np.abs(o).max(axis=1) + seen.t))
    law.hold("distance", np.where(there.found & seen.steep, error, 0), o=o, d=d, other=other)


# ---------------------------------------------- Samples --------------------------------------------------

POSITIONS = """n = 100_000
rng = mi.PCG32(n)
ps = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
print("mean of 1 / density:", dr.mean(1 / ps.pdf), "surface_area():", shape.surface_area())
ratio = shape.pdf_position(ps) / ps.pdf
print("pdf_position() / density:", dr.min(ratio), "...", dr.max(ratio))
"""
SAME = "the same number"


@figures(
    position=("most", "density of a position against pdf_position(), relative", 1e-3, SAME, POSITIONS),
    area=("at most", "mean of 1 / density against surface_area(), relative", 1e-3, SAME, POSITIONS),
    off=(0.9, "sampled positions off the surface, 9 in 10, in roundings of the largest coordinate",
         2 * HIT_ROUNDINGS, "a few roundings", RAY),
    normal=(0.9, "normals of sampled positions against those of rays, 1 - cosine, 9 in 10", 1e-3,
            "one surface", RAY),
    crossings=("at most", "surface_area() against that by crossings of lines, relative, beyond "
               f"{SIGMAS} standard errors", 3e-3, "lines that graze may cross twice within the offset of a "
               "spawned ray", POSITIONS),
    spread=rare("chance of such positions if they follow the area, along the worst of some axes", POSITIONS),
    direction=(0.99, "density of a direction against pdf_direction(), relative, 99 in 100", 1e-2,
               "the same number; near outlines the cosine, and the density with it, hangs on roundings", RAY),
    misses=("share", "share of sampled directions that miss the shape, or reach it behind the sampled point",
            1e-2, "outlines hang on roundings; small leaks are watertight's business", RAY),
    angle=("at most", "solid angle of what is visible, or its middle or width, by samples against uniform "
           f"directions, beyond {SIGMAS} standard errors", 1e-2, "the mean of 1 / density over what is seen; "
           "lines that graze are left room for", POSITIONS),
)  # fmt: skip
def sampling(law: Law, case: Case) -> None:
    """Positions by area, judged by where lines cross the surface; directions, and the densities of both.

    E[1 / pdf] is the area, and of directions the solid angle of what is seen.
    """
    (p, n, pdf, again), u, area = case.positions
    law.hold("position", np.abs(pdf / again - 1))
    law.hold("area", abs(np.mean(1 / pdf) / area - 1))
    few = slice(0, case.count(2**14, 2**17))
    # sampled positions, and their normals, as rays meet them
    start, inwards = (p + n * 0.01 * case.size).astype(np.float32)[few], -n[few]
    back = trace(case.target, start, unit(inwards))
    # another part of the surface may be nearer than a hundredth of the size
    away = np.where(back.found, np.linalg.norm(back.p - p[few], axis=1), np.inf)
    scale = np.abs(p[few]).max(axis=1) + 0.01 * case.size
    law.hold("off", away / (ROUNDING * scale), o=start, d=inwards)
    if back.found.any():
        alike = -np.minimum(dot(inwards, back.shading), dot(inwards, back.n))
        off = np.where(back.found, 1 - alike / np.linalg.norm(inwards, axis=1), np.nan)
        law.hold("normal", off, o=start, d=inwards)
    if case.behind.found.mean() > 0.5:
        _area(law, case, p, n, area)
    else:
        law.notes.append("rays pass it from behind: their crossings do not count its area")
    _directions(law, case, u[few])


def _area(law: Law, case: Case, p: Array, n: Array, area: float) -> None:
    """Random lines cross a surface in proportion to its area, whatever its form (Crofton)."""
    count, radius = case.count(2**16, 2**20), 0.5 * case.size * 1.001
    d = case.units(count)
    disk = radius * np.sqrt(case.rng.random((count, 1))) * unit(np.cross(d, case.units(count)))
    # where two parts of the surface coincide, a line meets only one of them
    n = unit(n)
    one, other = (trace(case.target, leave(p, n, side * n), -side * n) for side in (1, -1))
    twice = one.found & other.found & (one.part != other.part) & near(p, one.p) & near(p, other.p)
    crossed, found = np.zeros(count), []
    for line, hit in walk(case.target, (case.middle + disk - 2 * radius * d).astype(np.float32), d):
        crossed[line] += 1
        found.append(hit.p)
    estimate, error = 2 * np.pi * radius**2 * np.array([crossed.mean(), crossed.std() / np.sqrt(count)])
    room = 3e-3 + 20 * float(offset(p).max()) / case.size + twice.mean()
    law.hold("crossings", max(abs(estimate - area) - SIGMAS * error, 0) / area, limit=room)
    # both along axes aslant, by Kolmogorov and Smirnov; crossings of a line come together
    if twice.mean() > ROOM:
        law.notes.append("parts of it coincide: where positions lie is not judged")
        return
    points = np.concatenate(found)
    size = 1 / (1 / len(p) + (crossed**2).sum() / crossed.sum() / len(points))
    apart = [stats.ks_2samp(p @ axis, points @ axis, method="asymp").statistic for axis in case.units(AXES)]
    chance = float(stats.kstwobign.sf(max(max(apart) - ROOM, 0) * np.sqrt(size)))
    law.hold("spread", sidak(chance, AXES))


AXES, ROOM = 12, 2e-3  # lines that graze are left room for


def _directions(law: Law, case: Case, u: Array) -> None:
    """``sample_direction`` from outside: meets the shape, and states its own density."""
    o = case.around(len(u))

    def sample(origin: Any, second: Any) -> list[Any]:
        it = dr.zeros(mi.Interaction3f)
        it.p = origin
        ds = case.plugin.sample_direction(it, second)
        return [ds.d, ds.dist, ds.pdf, case.plugin.pdf_direction(it, ds)]

    try:
        d, dist, pdf, again = lanes(sample, ("Point3f", o), ("Point2f", u))
    except (RuntimeError, AttributeError):
        law.notes.append("the shape has no sample_direction()")
        return
    drawn, met = pdf > 0, trace(case.target, o, d.astype(np.float32))
    law.hold("direction", np.where(drawn, np.abs(pdf / again - 1), 0), o=o, d=d)
    law.hold("misses", drawn & np.where(met.found, met.steep & (met.t > dist * (1 + 1e-3)), True), o=o, d=d)
    visible = drawn & met.found & (met.t > dist * (1 - 1e-3))
    mean, variance = _moments(case, o, d, met.p, np.where(visible, 1 / np.where(drawn, pdf, 1), 0))
    # the same by uniform directions into the cone that holds the shape
    o = case.around(case.count(2**17, 2**19))
    axis = unit(case.middle - o)
    across = unit(np.cross(axis, case.units(len(o))))
    cos = 1 - case.rng.random((len(o), 1)) * CONE / (2 * np.pi)
    away = unit(cos * axis + np.sqrt(1 - cos**2) * across)
    met = trace(case.target, o, away)
    expected, other = _moments(case, o, away, met.p, np.where(met.found, CONE, 0))
    off = np.abs(mean - expected) - SIGMAS * np.sqrt(variance + other)
    law.hold("angle", max(off.max(), 0) / expected[0])


# solid angle of the sphere around, from 1.5 sizes away: the sine of its half angle is a third
CONE = 2 * np.pi * (1 - np.sqrt(1 - 1 / 9))


def _moments(case: Case, o: Array, d: Array, p: Array, weight: Array) -> tuple[Array, Array]:
    """Return means [8] of weights, alone and times place, its squares and the angle, and their variances."""
    place = (p - case.middle) / case.size
    angle = (1 - dot(d, unit(case.middle - o))[:, None]) * 2 * np.pi / CONE
    factors = np.concatenate([np.ones_like(angle), place, 4 * place**2, angle], axis=1)
    found = np.where(weight[:, None] > 0, weight[:, None] * factors, 0)
    return found.mean(axis=0), found.var(axis=0) / len(found)


LAWS = {law.__name__: law for law in (hits, surface, normals, watertight, scale, far, finite, sampling, bbox,
                                      variants)}  # fmt: skip
