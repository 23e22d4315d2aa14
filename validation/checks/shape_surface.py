"""Laws of what rays meet on a shape: one answer, points on the surface, normals, no holes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from scipy import stats

from mrt_mitsuba.validation.checks import noise
from mrt_mitsuba.validation.checks.law import LEVEL, Law, Skip
from mrt_mitsuba.validation.checks.noise import ROUNDING
from mrt_mitsuba.validation.checks.probe import Array, lanes, unit
from mrt_mitsuba.validation.checks.shape_case import (
    FLAT,
    HIT_ROUNDINGS,
    Case,
    Hits,
    corners,
    leave,
    near,
    offset,
    trace,
)

TYPICAL = 16  # roundings: twice the most that was measured of sound shapes
TILTED = 2e-3
NORMAL = 1e-5  # a few roundings of a square root and a quotient

MAXT = """ray
ray = mi.Ray3f(o, d)
print("meets the surface at", scene.ray_intersect(ray).t)
ray.maxt = float("{maxt}")
print("up to", ray.maxt, "ray_test():", scene.ray_test(ray), "ray_intersect():", scene.ray_intersect(ray).t)
"""
BEHIND = """ray
si = scene.ray_intersect(mi.Ray3f(o, d))
back = scene.ray_intersect(mi.Ray3f(si.spawn_ray(d).o, -d))
print("from the front:", si.n, "and from just behind:", back.n, "at", back.t)
"""
NEIGHBOUR = """ray
aside = mi.Vector3f({aside})
si = scene.ray_intersect(mi.Ray3f(o, d))
near = scene.ray_intersect(mi.Ray3f(o + 1e-3 * {size} * aside, d))
step, uv = near.p - si.p, near.uv - si.uv
print("slope against the normal:", dr.dot(step, si.n) / dr.norm(step))
print("step", step, "by partial derivatives:", si.dp_du * uv.x + si.dp_dv * uv.y)
"""


def hits(law: Law, case: Case) -> None:
    """``ray_test`` and ``ray_intersect`` agree, and heed ``maxt``, from outside and from the surface."""
    _agree(law, case, *case.seen, "without a limit", None)
    o, d, met = case.met
    before, behind = ((met.t * factor).astype(np.float32) for factor in (1 - 1e-3, 1 + 1e-3))
    _agree(law, case, o, d, met, "up to just before the hit", before, met=False)
    _agree(law, case, o, d, met, "up to just behind the hit", behind)
    away = case.units(len(met.t))
    start = leave(met.p, met.n, away)
    _agree(law, case, start, away, trace(case.target, start, away), "that leave the surface", None)


def _agree(
    law: Law, case: Case, o: Array, d: Array, seen: Hits, what: str, maxt: Array | None, *, met: bool = True
) -> None:
    """Hold both ways to ask for a hit to what ``ray_intersect`` met without a limit, or to nothing."""
    limit = np.full(len(o), np.inf, np.float32) if maxt is None else maxt

    def call(mi: Any, origin: Any, direction: Any, most: Any) -> list[Any]:
        ray = mi.Ray3f(origin, direction)
        if maxt is not None:
            ray.maxt = most
        return [case.target.ray_test(ray), case.target.ray_intersect(ray).is_valid()]

    found = lanes(call, ("Point3f", o), ("Vector3f", d), ("Float", limit))
    steep = ~seen.found | (np.abs((seen.n * d).sum(axis=1)) > FLAT)
    for name, answer in zip(("ray_test()", "ray_intersect()"), found, strict=True):
        wrong = steep & (answer[:, 0].astype(bool) != (seen.found & met))
        why = "one question, one answer; rays that graze are left out, but for those that just miss"
        show = case.at(o, d, MAXT, maxt=limit)
        law.share(
            f"share of rays {what} on which {name} is wrong", wrong, 5e-4 if maxt is None else 0, why, show
        )


def surface(law: Law, case: Case) -> None:
    """Hit points lie on the ray, spawned rays do not meet the surface where they start, digits are kept."""
    o, d, met = case.met
    largest = np.maximum(np.abs(o).max(axis=1), np.abs(met.p).max(axis=1)) + met.t
    along = o.astype(np.float64) + met.t[:, None].astype(np.float64) * d
    error = np.abs(along - met.p).max(axis=1) / (ROUNDING * largest)
    what = "hit point off the ray at its distance, in roundings of the largest number"
    law.most(what, error, HIT_ROUNDINGS, "some dozen operations", case.at(o, d))
    # from near by, and from the other side, numbers are small; a shape whose points are off is off by as much
    few = met.only(slice(0, case.count(2**12, 2**15)))
    close, along = (few.p - 0.05 * case.size * d[: len(few.t)]).astype(np.float32), d[: len(few.t)]
    again = trace(case.target, close, along)
    same = again.found & near(few.p, again.p)
    largest = np.abs(few.p).max(axis=1) + 0.05 * case.size
    off = np.abs(close + again.t[:, None].astype(np.float64) * along - again.p).max(axis=1)
    # the same line the other way around, from as far behind
    back = trace(case.target, (few.p + 0.05 * case.size * along).astype(np.float32), -along)
    apart = np.linalg.norm(back.p.astype(np.float64) - again.p, axis=1) * np.abs((few.n * along).sum(axis=1))
    alike = same & back.found & (back.part == few.part) & (apart < 0.01 * case.size)
    alike &= case.behind.found.mean() > 0.5  # else rays pass it from behind
    for what, error, known in (
        ("hit point off a ray of a twentieth of the size", off, same),
        ("hit points from in front and from behind, across the surface", apart, alike),
    ):
        if known.sum() > 20:
            rounded = np.where(known, error / (ROUNDING * largest), np.nan)
            show = case.at(close, along)
            title = f"{what}, in roundings of the largest coordinate, median"
            law.quantile(title, rounded, 0.5, TYPICAL, "a few operations", show)
    count = case.count(10**5, 10**6)
    few = met.only(case.rng.integers(len(met.t), size=count))
    away = case.units(count)
    cos = (few.n * away).sum(axis=1)
    start = leave(few.p, few.n, away)
    again = trace(case.target, start, away)
    turn = np.abs((again.n * few.n).sum(axis=1))
    # another part may truly be that near, in a hollow edge
    same = near(few.p, again.p) & (turn > np.where(again.part == few.part, 0.9, 0.9999))
    bad = again.found & same & (np.abs(cos) > FLAT)
    what = f"rays from the surface, of {count}, that meet it where they start"
    law.none(what, bad, "self-intersections are dark spots; grazing rays are left out", case.at(start, away))
    before = met.p - 1e-3 * case.size * d
    from_near = trace(case.target, before.astype(np.float32), d)
    law.share(
        "share of rays from a thousandth of the size before the surface that do not meet it there",
        ~(from_near.found & (np.linalg.norm(from_near.p - met.p, axis=1) < 1e-3 * case.size)),
        2e-3,
        "no absolute limits; outlines hang on roundings",
        case.at(before.astype(np.float32), d),
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

        found = noise.measure(function, inputs, size=size, strides=(64,), seed=case.seed)
        lost = np.nan_to_num(found.lost(noise.ALLOWANCE), posinf=0)
        title = f"noise of the {what} over that of {noise.ALLOWANCE:g} roundings with a rounded ray, 9 in 10"
        why = "digits are lost inside that could be kept"
        law.quantile(title, lost, 0.9, noise.LOST, why, case.at(o, d))


def normals(law: Law, case: Case) -> None:
    """Unit length, outwards, as the partial derivatives and differences have it."""
    o, d, met = case.met
    length = np.abs(np.linalg.norm(np.stack([met.n, met.shading]).astype(np.float64), axis=-1) - 1).max(
        axis=0
    )
    law.most("length of a normal less 1", length, NORMAL, "a square root and a quotient", case.at(o, d))
    if case.closed:
        o, d, seen = case.seen
        judged, even = case.lines
        flipped = isinstance(case.plugin, mi.Shape) and case.plugin.has_flipped_normals()
        what = f"share of rays from outside whose normal points {'outwards' if flipped else 'inwards'}"
        why = "a closed shape has an outside; what edges hide is left room for"
        law.share(what, judged & even & (((seen.n * d).sum(axis=1) > 0) != flipped), 1e-3, why, case.at(o, d))
    else:
        law.notes.append("open: there is no outside for normals to point to")
    o, d, met = case.met
    apart = (met.n * met.shading).sum(axis=1) <= 0
    law.none("shading normals on the other side than the geometric one", apart, "one surface", case.at(o, d))
    expected = _interpolated(case, met)
    if expected is not None:
        apart = np.linalg.norm(met.shading - expected, axis=1)
        what = "shading normal against the geometric one, or the interpolated one of a mesh, 9 in 10"
        law.quantile(what, apart, 0.9, TILTED, "the same, but for some roundings", case.at(o, d))
    # the normal is the surface's, not the ray's: the same for a ray that comes back from behind
    back = case.behind
    same = back.found & near(met.p, back.p) & (back.part == met.part)
    if same.sum() > 20:
        what = "share of normals that turn where the same point is met from behind"
        turned = same & ((back.n * met.n).sum(axis=1) < -0.5)
        why = "a surface has one normal; thin parts are left room for"
        law.share(what, turned, 1e-3, why, case.at(o, d, BEHIND))
    usable = (np.linalg.norm(met.du, axis=1) > 0) & (np.linalg.norm(met.dv, axis=1) > 0)
    if usable.any():
        slant = np.maximum(*(np.abs((unit(v) * met.n).sum(axis=1)) for v in (met.du, met.dv)))
        slant = np.where(usable & np.isfinite(slant), slant, 0)
        what = "cosine between the normal and a partial derivative of the point"
        why = "both are known to a few roundings; near a pole the derivatives are short"
        law.most(what, slant, 1e-3, why, case.at(o, d))
    _differences(law, case)


def _interpolated(case: Case, met: Hits) -> Array | None:
    """Return what shading normals should be; None where the shape is smoothed in a way of its own."""
    shape = case.plugin
    if isinstance(shape, mi.Shape) and shape.class_name() in SMOOTHED:
        return None
    if not isinstance(shape, mi.Mesh) or not shape.has_vertex_normals():
        return met.n
    params = mi.traverse(shape)
    if not {"vertex_positions", "vertex_normals", "faces"} <= set(params.keys()):
        return None
    faces = np.array(params["faces"]).reshape(-1, 3)[met.part.astype(int)]
    a, b, c = (np.array(params["vertex_positions"], np.float64).reshape(-1, 3)[faces[:, k]] for k in range(3))
    normals = np.array(params["vertex_normals"], np.float64).reshape(-1, 3)[faces]  # [N, corner, 3]
    across = np.cross(b - a, c - a)
    area = (across**2).sum(axis=1)
    v, w = ((np.cross(x, y) * across).sum(axis=1) / area for x, y in ((met.p - a, c - a), (b - a, met.p - a)))
    mixed = np.einsum("nk,nkx->nx", np.stack([1 - v - w, v, w], axis=1), normals)
    return (-1 if shape.has_flipped_normals() else 1) * mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


SMOOTHED = ("SDFGrid", "BSplineCurve", "LinearCurve", "Instance")


def _differences(law: Law, case: Case) -> None:
    """Neighbouring hits against normal and partial derivatives; two widths separate curvature from error."""
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
        why = "extrapolated to no step; edges may part neighbours"
        show = case.at(o, d, NEIGHBOUR, aside=aside, size=case.size)
        law.quantile(f"{what}, 95 in 100", error, 0.95, 1e-2, why, show)


def watertight(law: Law, case: Case) -> None:
    """Lines enter and leave in turn, and no ray from inside gets out without a hit."""
    o, d, met = case.met
    # else such a ray may fall off an edge, or its offset be larger than the shape
    steep = (np.abs((met.n * d).sum(axis=1)) > 0.5) & (offset(met.p) < 1e-3 * case.size)
    blind = steep & ~case.behind.found
    if blind.mean() > 1e-2:
        what = "share of rays that pass the surface from behind"
        law.share(what, blind, 1e-2, "it has two sides; edges have room", case.at(o, d, BEHIND))
        return
    if not case.closed:
        raise Skip("the shape is open: lines do not leave it as often as they enter")
    judged, even = case.lines
    what = f"share of lines, of {judged.sum()}, that cross the surface an odd number of times"
    why = "near sharp edges, the offset of a ray that goes on leads out again; grazing lines are left out"
    law.share(what, judged & ~even, 1e-3, why, case.at(*case.seen[:2]))
    inside = _inside(case)
    if inside is None:
        law.notes.append("no room inside to start rays in")
        return
    count = case.count(10**5, 10**6)
    o = inside[case.rng.integers(len(inside), size=count)]
    d = case.units(count)
    bad = ~trace(case.target, o, d).found
    law.at_most(
        f"share of rays from inside, of {count}, that surely meet nothing",
        stats.beta.ppf(LEVEL, bad.sum(), count - bad.sum() + 1) if bad.any() else 0,  # Clopper and Pearson
        1e-5,
        "a closed surface; of a million rays at triangles, some pass along an edge. One false alarm in a "
        "million",
        case.snippet(o[bad.argmax()], d[bad.argmax()]),
    )
    ends = corners(case.plugin)
    if ends is not None:  # the ray tracer's doing, whatever the mesh
        out = ~trace(case.target, o, unit(ends[case.rng.integers(len(ends), size=count)] - o)).found
        if out.any():
            law.notes.append(
                f"of rays aimed at vertices and edges exactly, {out.mean():.2g} pass between triangles"
            )


def _inside(case: Case) -> Array | None:
    """Return points well inside: middles of the longer first chords."""
    if len(case.crossings) < 2:
        return None
    (first, p, _), (second, q, _) = case.crossings[:2]
    _, i, j = np.intersect1d(first, second, return_indices=True)
    chord = np.linalg.norm(p[i] - q[j], axis=1)
    return ((p[i] + q[j]) / 2)[chord >= np.median(chord)].astype(np.float32) if len(chord) else None
