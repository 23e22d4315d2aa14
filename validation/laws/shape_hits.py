"""Laws of the hits of a shape: where rays meet it, from near and far, and what its surface is like."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.linalg import norm
from scipy import stats

from . import plots
from .case import READS, READS_WHY, WAVE, class_name, reads_checked
from .faults import PLACE, SIZE, larger, member, off_surface, put, tilted
from .law import (
    MIN_QUANTILE_ERRORS,
    SIGNIFICANCE,
    Criterion,
    Outcome,
    Skip,
    finds,
    measures,
    most,
    number_of,
    share_of,
)
from .noise import ROUNDING
from .probe import (
    Array,
    Lanes,
    lanes,
    unit,
)
from .shape_case import (
    FAR_DISTANCE,
    GRAZING_COSINE,
    MAX_HIT_ROUNDINGS,
    MAX_MEDIAN_ROUNDINGS,
    RAY,
    SMOOTHED,
    UNSCALED,
    ShapeCase,
    dot,
    leave,
    near,
    offset,
    trace,
)

MAXT = """ray = mi.Ray3f(o, d)
print("meets the surface at", scene.ray_intersect(ray).t)
ray.maxt = float("{maxt}")
print("up to", ray.maxt, "ray_test():", scene.ray_test(ray), "ray_intersect():", scene.ray_intersect(ray).t)
"""
ONE = "one question, one answer; of rays that graze, only those that just miss count"


def in_share(size, ray):
    """Rays of a share of the directions."""
    return ray.d.x > 1 - 2 * size


def missed_in_share(size, met, ray):
    return met & ~in_share(size, ray)


@finds("ray_test", "ray_test() misses in this share of directions", 1e-5, ray_test=missed_in_share)
@measures(
    ray_test=share_of("share of rays {rays} on which ray_test() is wrong", 0, ONE, MAXT),
    ray_intersect=share_of("share of rays {rays} on which ray_intersect() is wrong", 0, ONE, MAXT),
)
def hits(law: Outcome, case: ShapeCase) -> None:
    """``ray_test`` and ``ray_intersect`` agree, and respect ``maxt``, from outside and from the surface."""
    away = case.units(len(case.met.t))
    leaving = trace(case.target, leave(case.met, away), away)
    _answers(law, case, "without a limit", case.seen, np.inf)
    _answers(law, case, "up to just before the hit", case.met, 1 - 1e-3)
    _answers(law, case, "up to just behind the hit", case.met, 1 + 1e-3)
    _answers(law, case, "that leave the surface", leaving, np.inf)


def _answers(law: Outcome, case: ShapeCase, rays: str, seen: Lanes, reach: float) -> None:
    """Check answers about rays of ``reach`` times the distance against what they are known to meet."""
    maxt = (seen.t * reach).astype(np.float32)

    def call(origin: mi.Point3f, direction: mi.Vector3f, most: mi.Float) -> list[mi.Mask]:
        ray = mi.Ray3f(origin, direction)
        ray.maxt = most
        return [case.target.ray_test(ray), case.target.ray_intersect(ray).is_valid()]

    answers = lanes(call, ("Point3f", seen.o), ("Vector3f", seen.d), ("Float", maxt))
    limit = 5e-4 if np.isinf(reach) else 0
    for name, answer in zip(("ray_test", "ray_intersect"), answers, strict=True):
        wrong = answer != (seen.met & (reach > 1))
        law.check(name, wrong, seen, where=seen.clear, limit=limit, maxt=maxt, rays=rays)


def too_far(size, si, ray):
    return put(si, t=si.t + SIZE * size, p=si.p + SIZE * size * ray.d)


def missed(where):
    """A change of hits that are missed in some places."""

    def apply(size, si, ray):
        return put(si, t=dr.select(where(size, si, ray), dr.inf, si.t))

    return apply


def close(size, si, ray):
    return (si.t < 0.01) & in_share(size, ray)


@finds("on_ray", "hit points off the ray, in sizes", 1e-5, ray_intersect=off_surface)
@finds("near_by", "hit points off, in sizes", 5e-7, ray_intersect=off_surface)
@finds("behind", "hits too far away, in sizes", 5e-7, ray_intersect=too_far)
@finds("missed", "a least distance for this share of directions", 3e-3, ray_intersect=missed(close))
@measures(
    on_ray=most(
        "hit point off the ray at its distance, in roundings of the largest number",
        MAX_HIT_ROUNDINGS,
        "some dozen operations",
        RAY,
    ),
    near_by=Criterion(
        0.5,
        "hit point off a ray of a thousandth of the size, in roundings of the largest coordinate, median",
        MAX_MEDIAN_ROUNDINGS,
        "a few operations",
        RAY,
    ),
    behind=Criterion(
        0.5,
        "hit points from in front and from behind, across the surface, in roundings of the largest "
        "coordinate, median",
        MAX_MEDIAN_ROUNDINGS,
        "a few operations",
        RAY,
    ),
    again=number_of(
        "rays from the surface, of {count}, that meet it where they start",
        0,
        "self-intersections are dark spots; grazing rays are left out",
        RAY,
    ),
    missed=share_of(
        "share of rays from a thousandth of the size before the surface that do not meet it there",
        2e-3,
        "no absolute limits; outlines hang on roundings",
        RAY,
    ),
)
def surface(law: Outcome, case: ShapeCase) -> None:
    """Hits lie on the ray and the surface; spawned rays do not meet it where they start."""
    met = case.met
    largest = abs(np.column_stack([met.o, met.p])).max(axis=1) + met.t
    law.check("on_ray", _off_ray(met) / (ROUNDING * largest), met)
    _from_near_by(law, case)
    _again(law, case)


def _off_ray(hits: Lanes) -> Array:
    """The distance of hit points from where their rays are after ``t``, per axis at most. [N]"""
    along = hits.o + np.float64(hits.t[:, None]) * hits.d
    return abs(along - hits.p).max(axis=1)


def _again(law: Outcome, case: ShapeCase) -> None:
    """Rays that leave the surface do not meet it where they start."""
    count = case.count(10**5, 10**6)
    few = case.met[case.rng.integers(len(case.met.t), size=count)]
    away = case.units(count)
    again = trace(case.target, leave(few, away), away)
    # another part may truly be that near, in a hollow edge
    alike = abs(dot(again.n, few.n)) > np.where(again.part == few.part, 0.9, 0.9999)
    bad = again.met & near(few.p, again.p) & (abs(dot(few.n, away)) > GRAZING_COSINE)
    law.check("again", bad, again, where=alike, count=count)


def _from_near_by(law: Outcome, case: ShapeCase) -> None:
    """From near by, and from the other side, numbers are small, and points that are off show."""
    met = case.few(case.met, 2**12, 2**15)
    d = met.d
    reach = 1e-3 * case.size
    again = trace(case.target, met.p - reach * d, d)
    law.check("missed", ~again.met | (norm(again.p - met.p, axis=1) >= reach), again)
    same = again.met & near(met.p, again.p)
    largest = abs(met.p).max(axis=1) + reach
    # the same line the other way around, from as far behind
    back = trace(case.target, met.p + reach * d, -d)
    apart = norm(np.float64(back.p) - again.p, axis=1) * abs(dot(met.n, d))
    alike = same & back.met & (back.part == met.part) & (apart < 0.01 * case.size)
    alike &= case.behind.met.mean() > 0.5  # else rays pass it from behind
    law.check("near_by", _off_ray(again) / (ROUNDING * largest), again, where=same)
    law.check("behind", apart / (ROUNDING * largest), again, where=alike)


NEIGHBOUR = """aside = mi.Vector3f({aside})
si = scene.ray_intersect(mi.Ray3f(o, d))
near = scene.ray_intersect(mi.Ray3f(o + 1e-3 * {size} * aside, d))
step, uv = near.p - si.p, near.uv - si.uv
print("slope against the normal:", dr.dot(step, si.n) / dr.norm(step))
print("step", step, "by partial derivatives:", si.dp_du * uv.x + si.dp_dv * uv.y)
"""
PARTED = "extrapolated to no step; edges may part neighbours"


def tilted_frame(size, frame):
    return mi.Frame3f(tilted(size, frame.n))


def inwards(size, si, ray):
    turned = (si.p.x > 1 - 2 * size) & (si.n.x < 0.5)
    return put(si, n=dr.select(turned, -1, 1) * si.n)


@finds("outwards", "normals inwards on this share of most faces", 3e-3, ray_intersect=inwards)
@finds("length", "normals too long", 3e-5, ray_intersect=member("n", larger))
@finds("shading", "normals tilted, in radians", 3e-3, ray_intersect=member("n", tilted))
@finds("slope", "normals tilted as well as derivatives, in radians", 0.03, ray_intersect=member("n", tilted))
@finds("shading", "shading normals tilted, in radians", 3e-3, ray_intersect=member("sh_frame", tilted_frame))
@finds("step", "dp_du too long", 0.02, ray_intersect=member("dp_du", larger))
@measures(
    outwards=share_of(
        "share of rays from outside whose normal points the wrong way",
        1e-3,
        "a closed shape has an outside; what edges hide is left room for",
        RAY,
    ),
    length=most("length of a normal less 1", 1e-5, "a square root and a quotient", RAY),
    side=number_of(
        "shading normals on the other side than the geometric one", 0, "both belong to one surface", RAY
    ),
    shading=Criterion(
        0.9,
        "shading normal against the geometric one, except on smoothed meshes, 90th percentile",
        2e-3,
        "the same, within some roundings",
        RAY,
    ),
    turned=share_of(
        "share of normals that turn where the same point is met from behind",
        1e-3,
        "a surface has one normal; thin parts are left room for",
        RAY,
    ),
    slope=Criterion(
        0.95,
        "slope of the surface against its normal, by differences, 95th percentile",
        1e-2,
        PARTED,
        NEIGHBOUR,
    ),
    step=Criterion(
        0.95, "step along the surface less its partial derivatives, 95th percentile", 1e-2, PARTED, NEIGHBOUR
    ),
)
def normals(law: Outcome, case: ShapeCase) -> None:
    """Normals have unit length, point outwards, and agree with partial derivatives and differences."""
    if case.closed:
        judged, even = case.lines
        flipped = isinstance(case.plugin, mi.Shape) and case.plugin.has_flipped_normals()
        law.check("outwards", (case.seen.cos > 0) != flipped, case.seen, where=judged & even)
    else:
        law.notes.append("open: there is no outside for normals to point to")
    met = case.met
    length = norm(np.stack([met.n, met.shading]).astype(np.float64), axis=-1)
    law.check("length", abs(length - 1).max(axis=0), met)
    law.check("side", dot(met.n, met.shading) <= 0, met)
    smoothed = isinstance(case.plugin, mi.Mesh) and case.plugin.has_vertex_normals()
    if not smoothed and class_name(case.plugin) not in SMOOTHED:
        law.check("shading", norm(met.shading - met.n, axis=1), met)
    # the normal is the surface's, not the ray's: the same for a ray that comes back from behind
    back = case.behind
    same = back.met & near(met.p, back.p) & (back.part == met.part)
    if same.sum() > MIN_QUANTILE_ERRORS:
        law.check("turned", dot(back.n, met.n) < -0.5, met, where=same)
    _differences(law, case)
    if not law.holds:
        towards = met[met.d @ PLACE < -0.5]
        law.plot = partial(plots.normals, towards.p, towards.n, towards.shading)


def _differences(law: Outcome, case: ShapeCase) -> None:
    """Neighbouring hits against normal and partial derivatives; two widths separate curvature from error."""
    met = case.met
    aside = unit(np.cross(met.d, case.units(len(met.d))))
    slopes = []
    partials = []
    for h in (2e-3, 1e-3):
        other = trace(case.target, met.o + h * case.size * aside, met.d)
        step = (other.p - met.p).astype(np.float64)
        length = norm(step, axis=1)
        ok = other.met & (other.part == met.part) & (dot(other.n, met.n) > 0.9)
        ok &= (length < 40 * h * case.size) & (length > 0)
        uv = (other.uv - met.uv).astype(np.float64)
        slopes.append(np.where(ok, abs(dot(step, met.n)) / length, np.nan))
        off = norm(step - uv[:, :1] * met.du - uv[:, 1:] * met.dv, axis=1) / length
        ok &= (abs(uv).max(axis=1) < 0.2) & met.du.any()
        partials.append(np.where(ok, off, np.nan))
    for name, (wide, narrow) in (("slope", slopes), ("step", partials)):
        law.check(name, np.maximum(2 * narrow - wide, 0), met, aside=aside, size=case.size)


def slit(size, si, ray):
    return dr.abs(si.p.x - 0.3) < SIZE * size / 2


def slit_above(size, si, ray):
    return slit(size, si, ray) & (si.n.z > 0.5)


@finds("out", "a slit of this width, in sizes", 3e-5, quick=1e-4, ray_intersect=missed(slit))
@finds("odd", "a slit of this width in one face, in sizes", 6e-3, ray_intersect=missed(slit_above))
@measures(
    blind=share_of(
        "share of rays that pass the surface from behind", 1e-2, "it has two sides; edges have room", RAY
    ),
    odd=share_of(
        "share of lines, of {judged}, that cross the surface an odd number of times",
        1e-3,
        "near sharp edges, the offset of a ray that goes on leads out again; grazing lines are left out",
        RAY,
    ),
    out=most(
        "share of rays from inside, of {count}, that surely meet nothing",
        1e-5,
        "a closed surface; of a million rays at triangles, some pass along an edge",
        RAY,
    ),
)
def watertight(law: Outcome, case: ShapeCase) -> None:
    """Rays meet the surface from behind, lines cross it an even number of times, none escapes from inside."""
    met = case.met
    # else such a ray may fall off an edge, or its offset be larger than the shape
    steep = (abs(met.cos) > 0.5) & (offset(met.p) < 1e-3 * case.size)
    if steep.any() and (~case.behind.met)[steep].mean() > 1e-2:
        law.check("blind", ~case.behind.met, met, where=steep)
        return
    if not case.closed:
        raise Skip("the shape is open: lines do not leave it as often as they enter")
    judged, even = case.lines
    law.check("odd", ~even, case.seen, where=judged, judged=judged.sum())
    inside = _inside(case)
    if not len(inside):
        law.notes.append("no room inside to start rays in")
        return
    count = case.count(10**5, 10**6)
    hits = trace(case.target, case.rng.choice(inside, count), case.units(count))
    out = stats.binomtest(count - hits.met.sum(), count)
    surely = out.proportion_ci(1 - 2 * SIGNIFICANCE).low  # Clopper and Pearson
    law.check("out", surely, hits[hits.met.argmin()], count=count)


def _inside(case: ShapeCase) -> Array:
    """Points well inside: the middles of the longer first chords of lines. [N, 3]"""
    if len(case.crossings) < 2:
        return np.zeros((0, 3))
    (first, entries), (second, exits) = case.crossings[:2]
    entry = entries.p[np.searchsorted(first, second)]  # of the lines that go on
    chord = norm(entry - exits.p, axis=1)
    return ((entry + exits.p) / 2)[chord >= np.median(chord)]


MOVED = """print("as it is, t:", scene.ray_intersect(mi.Ray3f(o, d)).t)
scene = mi.load_dict({{"type": "scene", "shape": load(to_world=mi.ScalarTransform4f({matrix}))}})
si = scene.ray_intersect(mi.Ray3f(mi.Point3f({start}), mi.Vector3f({way})))
print("{how}, and the ray with it, t over the scale:", si.t / {factor})
"""
TURN = np.array([[0.8, -0.6, 0], [0.48, 0.64, -0.6], [0.36, 0.48, 0.8]])  # in steps of 37° about two axes
OFFSET = np.array([0.5, -1, 2])  # in sizes
POWERS = (-20, -10, 10, 20)  # of two, which round nothing


def _alike(law: Outcome, seen: Lanes, there: Lanes) -> None:
    """Check hits elsewhere against those that they should equal."""
    law.check("answer", there.met != seen.met, seen, where=seen.clear)
    distance = abs(there.t - seen.t) / (abs(there.o).max(axis=1) + seen.t)
    error = np.maximum(distance, 1 - dot(there.n, seen.n)) / ROUNDING
    law.check("off", error, seen, where=there.met & seen.steep)


@measures(
    answer=share_of(
        "share of rays answered otherwise where the shape and they are {how}",
        2e-3,
        "to_world applies to all of it; outlines hang on roundings",
        MOVED,
    ),
    off=most(
        "distance or normal where the shape and rays are {how}, off by roundings of the largest number",
        4 * MAX_HIT_ROUNDINGS,
        "some dozen operations each, and another cosine with the surface",
        MOVED,
    ),
)
def scale(law: Outcome, case: ShapeCase) -> None:
    """At a millionth and a million times the size, and turned and moved, hits are the same."""
    matrix = getattr(case.with_().get("to_world"), "values", np.eye(4))
    if class_name(case.plugin) in UNSCALED:
        raise Skip("to_world does not scale all of it (of curves, the radius stays)")
    seen = case.few(case.seen, 2**12, 2**14)
    places = {f"2^{power} times as large": np.diag([2.0**power] * 3 + [1]) for power in POWERS}
    places["turned and moved"] = np.eye(4)
    places["turned and moved"][:3] = np.column_stack([TURN, case.size * OFFSET])
    for how, place in places.items():
        factor = float(norm(place[:3, 0]))
        turn = place[:3, :3] / factor
        to_world = place @ matrix
        try:
            scene = case.scene(to_world=mi.ScalarTransform4f(to_world))
        except RuntimeError as problem:
            raise Skip("to_world is not accepted") from problem
        start = np.float32(seen.o @ place[:3, :3].T + place[:3, 3])
        way = unit(seen.d @ turn.T)
        there = trace(scene, start, way)
        there = there.having(t=there.t / factor, o=there.o / factor, n=there.n @ turn)
        names = {"how": how, "factor": factor, "matrix": to_world.tolist(), "start": start, "way": way}
        _alike(law, Lanes(**vars(seen), **names), there)


TWICE = """for o in (o, mi.Point3f({other})):
    dr.make_opaque(o)
    print("from", o, "it is met at", scene.ray_intersect(mi.Ray3f(o, d)).p)
"""


def off_from_afar(size, si, ray):
    return put(si, p=dr.select(si.t > 1000, si.p + size * si.t * si.n, si.p))


def afar(size, si, ray):
    return (si.t > 1000) & in_share(size, ray)


@finds("missed", "hits off by this part of a distance above a thousand", 1e-5, ray_intersect=off_from_afar)
@finds("missed", "misses from afar in this share of directions", 3e-3, ray_intersect=missed(afar))
@measures(
    missed=share_of(
        "share of rays from afar that miss what is met from nearby, or meet it "
        f"{MAX_HIT_ROUNDINGS} roundings off",
        1e-3,
        "the origin is rounded, and some dozen operations with it; next to edges, more hangs on them",
        TWICE,
    ),
)
def far(law: Outcome, case: ShapeCase) -> None:
    """Rays from ten thousand sizes away meet what the same lines meet from nearby, to some roundings."""
    met = case.few(case.met, 2**12, 2**15)
    distance = FAR_DISTANCE * case.size
    goal = np.float64(met.p)
    d = met.d
    exactly = np.float64(d)
    there = trace(case.target, goal - distance * exactly, d)
    here = trace(case.target, there.o + (FAR_DISTANCE - 1.5) * case.size * exactly, d)
    cos = abs(here.cos)
    apart = norm(np.float64(there.p) - here.p, axis=1)
    error = apart * cos / (ROUNDING * distance)
    judged = here.met & (cos > 4 * GRAZING_COSINE)
    # a rounded origin moves the line: only what all lines around it meet counts
    judged &= norm(here.p - goal, axis=1) < 20 * ROUNDING * distance
    across = unit(np.cross(d, case.units(len(d))))
    for side in (across, -across, np.cross(d, across), np.cross(across, d)):
        aside = trace(case.target, here.o + 4 * ROUNDING * distance * side, d)
        judged &= aside.met & (dot(aside.n, here.n) > 0.9)
    law.check("missed", ~there.met | (error > MAX_HIT_ROUNDINGS), there, where=judged, other=here.o)


def no_number_along_axis(size, si, ray):
    return put(si, uv=dr.select(dr.abs(ray.d.x) < size, dr.nan, si.uv))


def no_number_in_place(size, si, ray):
    """NaN for about a share of the rays, in one direction."""
    inside = (ray.d.x > 0.3) & (ray.d.x < 0.3 + 2 * size)
    return put(si, uv=dr.select(inside, dr.nan, si.uv))


@finds("bad", "NaN where a component of the direction is so small", 1e-12, ray_intersect=no_number_along_axis)
@finds("bad", "NaN for a share of the rays", 2e-6, quick=2e-5, ray_intersect=no_number_in_place)
@measures(
    reads=most(READS, 0, READS_WHY),
    bad=number_of("{results} with numbers that are not finite", 0, "one NaN spoils a picture", RAY),
)
def finite(law: Outcome, case: ShapeCase) -> None:
    """All results are finite: of rays along axes, from the surface, the middle, corners and very far away."""
    with reads_checked(law):
        for hits in (_extreme_rays(case), *(case.towards(WAVE) for _ in case.waves)):
            numbers = [hits.t, hits.p, hits.n, hits.shading, hits.uv, hits.du, hits.dv]
            bad = np.where(hits.met, _not_finite(numbers) | (hits.t < 0), np.isnan(hits.t))  # misses are inf
            if bad.any() or not law.parts:
                law.check("bad", bad, hits, results="hits")
    with suppress(Skip):
        s, _ = case.positions
        law.check("bad", _not_finite([s.p, s.n, s.pdf]).sum(), case.met[0], results="sampled positions")


def _not_finite(columns: Sequence[Array]) -> Array:
    """Where any of several numbers or vectors is not finite. [N], bool"""
    return ~np.isfinite(np.column_stack(columns)).all(axis=1)


def _extreme_rays(case: ShapeCase) -> Lanes:
    """Hits of rays from and towards extreme places, and along axes."""
    rng = case.rng
    count = case.count(2**12, 2**15)
    corners = np.where(rng.random((count, 3)) < 0.5, case.low, case.high)
    middles = np.broadcast_to(case.middle, (count, 3))
    afar = case.middle + case.size * 10.0 ** rng.uniform(0, 5, (count, 1)) * case.units(count)
    kinds = (corners, middles, afar, rng.choice(case.met.p, count), rng.choice(case.points, count))
    o = np.choose(rng.integers(len(kinds), size=count)[:, None], kinds).astype(np.float32)
    d = case.units(count) * rng.choice([0, 1e-30, 1], (count, 3), p=[0.3, 0.1, 0.6])
    to_middle = case.middle - o
    d = np.where(rng.random((count, 1)) < 0.3, to_middle, d)
    d = unit(np.where((d == 0).all(axis=1, keepdims=True), [0, 0, 1], d))
    return trace(case.target, o, d)


def lower_top(size, box):
    return mi.BoundingBox3f(box.min, (1 - 2 * size) * box.max)


def higher_bottom(size, box):
    return mi.BoundingBox3f((1 - 2 * size) * box.min, box.max)


@finds("outside", "a box too small above, in sizes", 3e-5, bbox=lower_top)
@finds("outside", "a box too small below, in sizes", 3e-5, bbox=higher_bottom)
@measures(
    outside=most("points outside the bounding box, in sizes", 1e-5, "some roundings", RAY),
)
def bbox(law: Outcome, case: ShapeCase) -> None:
    """Whatever is hit or sampled lies in the bounding box."""
    met = case.met
    points = [met.p, case.points]
    with suppress(Skip):
        points.append(case.positions[0].p)
    p = np.concatenate(points)
    out = np.maximum(case.box[0] - p, p - case.box[1]).max(axis=1) / case.size
    worst = min(out.argmax(), len(met.t) - 1)
    law.check("outside", out.max(), met[worst])


@measures(
    answer=share_of("share of rays answered otherwise in {other}", 2e-3, "outlines hang on roundings", RAY),
    off=most(
        "distance or normal in {other}, off by roundings of the largest number",
        4 * MAX_HIT_ROUNDINGS,
        "some dozen operations each, and another cosine with the surface",
        RAY,
    ),
)
def variants(law: Outcome, case: ShapeCase) -> None:
    """Hits in the scalar variant are those of the vectorised one."""
    case.with_()
    other = case.other_kind
    seen = case.few(case.seen, 500, 2000)
    there = case.elsewhere(other, lambda: trace(case.scene(), seen.o, seen.d))
    _alike(law, Lanes(**vars(seen), other=other), there)
