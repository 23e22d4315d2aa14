"""Rays on the edge of meeting an object: along its sides, level with its base, and from very far away."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.scene.model import Cone, Cylinder, Material
from mrt_mitsuba.validation.oracles import reference
from mrt_mitsuba.validation.studies.stability.cases import Cases
from mrt_mitsuba.validation.tools import scenery

ROUNDING = 2.0**-24
MATTE = Material(0.0, 1.0, (0, 0, 0), (1, 1, 1))
KINDS: dict[str, Any] = {"cone": Cone, "cylinder": Cylinder}


def grazing_cases(cases: Cases, *, quick: bool) -> None:
    """Grazing and level rays at groups of upright objects, and rays from 1e5 radii away at a cone."""
    count = 100_000 if quick else 1_000_000
    for kind in KINDS:
        found, exact = _along_sides(kind, count)
        what = f"of {count} rays along the sides of upright objects, a few roundings deep"
        fault = found & (np.arange(count) % 1000 != 0)
        lost, made = (float(np.count_nonzero(exact & ~seen)) for seen in (found, fault))
        least = ("one in a thousand lost", made)
        cases.at_most(f"{kind}, grazing rays", f"{what}: those that are lost", "none", lost, 0, fault=least)
        found, exact = _level(kind, 20_000)
        wrong = found != exact
        what = "of 20000 rays across the axis, above and below both ends: those that hit or miss wrongly"
        least = ("one in a thousand", (~wrong[::1000]).sum())
        cases.at_most(f"{kind}, level rays", what, "none", wrong.sum(), 0, fault=least)
    across, made = _from_afar(200_000)
    what = (
        "distance error across the surface of 99.9 % of 200000 rays, in roundings of the way; "
        "points of lines that are made orthogonal to them once, not twice, leave 4.0"
    )
    least = ("hits 2 in a million further away", made)
    cases.at_most("cone, from 1e5 radii away", what, "3.4 to 3.5", across, 3.75, fault=least)


def _upright(kind: str, rng: np.random.Generator) -> tuple[list[Any], np.ndarray, dict[str, Any]]:
    """Return twenty objects apart from each other, as such, as numbers [20, 7], and as a group."""
    things, make = [], KINDS[kind]
    for x in range(20):
        base, radius = np.array([1.7 * x, 0.3 * x, 0], np.float32), np.float32(rng.uniform(0.2, 0.6))
        ends: Any = (base + np.array([0, 0, 1], np.float32)).tolist(), base.tolist()
        things.append(make(*ends, float(radius), MATTE))
    rows = [[*a, *b, r] for a, b, r in (tuple(vars(t).values())[:3] for t in things)]
    numbers = np.array(rows, np.float32)
    return things, numbers, {"type": "mrt_group", "kind": kind, "numbers": mi.Bitmap(numbers)}


def _along_sides(kind: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which rays meet something, and which should: along the axes, where boxes and surfaces touch."""
    rng = np.random.default_rng(3)
    things, numbers, group = _upright(kind, rng)
    which = rng.integers(0, 20, count)
    side = rng.choice([-1.0, 1.0], count) * (numbers[which, 6] * (1 - 10.0 ** rng.uniform(-6.3, -5, count)))
    along_x = rng.random(count) < 0.5
    height = rng.uniform(0, 2e-7 if kind == "cone" else 1, count)
    away = np.full(count, -3.0)
    o = np.float32(numbers[which, 3:6] + np.where(along_x, [away, side, height], [side, away, height]).T)
    d = np.float32(np.where(along_x[:, None], [1.0, 0, 0], [0, 1.0, 0]))
    return traced(group, o, d)[0], np.isfinite(_exact(things, which, o, d))


def _level(kind: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the same of level rays at all heights, a little off the ends."""
    rng = np.random.default_rng(5)
    things, numbers, group = _upright(kind, rng)
    which = rng.integers(0, 20, count)
    side = rng.uniform(-0.99, 0.99, count) * numbers[which, 6]
    height = np.concatenate([rng.uniform(-2, 3, count // 2), 1e-4 * rng.uniform(-1, 1, count - count // 2)])
    o = np.float32(numbers[which, 3:6] + np.stack([side, np.full(count, -3.0), height], axis=1))
    d = np.tile(np.array([0, 1, 0], np.float32), (count, 1))
    exact = np.isfinite(_exact(things, which, o, d))
    near = np.isfinite(_exact(things, which, o + np.array([1e-5, 0, 1e-6], np.float32), d))
    found = traced(group, o, d)[0]
    return np.where(near == exact, found, exact), exact  # at an outline, it may go either way


def _from_afar(count: int) -> tuple[float, float]:
    """Return the error of a cone's place, and what it would be with hits too far away."""
    rng, away = np.random.default_rng(4), 1e5
    apex, base, radius = (0.3, 0.1, 1.0), (-0.2, 0.2, -1.0), 0.5
    d = rng.normal(size=(count, 3))
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    o = np.float32(rng.uniform(-0.6, 0.6, (count, 3)) - away * d)
    cone = Cone(apex, base, radius, MATTE)
    exact = _exact([cone], np.zeros(count, int), o, d)
    shape = {"type": "mrt_cone", "apex": apex, "base_center": base, "radius": radius}
    found, t = traced(shape, o, d)
    both = found & np.isfinite(exact)
    with np.errstate(invalid="ignore"):
        n = reference.Axial([cone]).normals(o + exact[:, None] * np.float64(d), np.zeros(count, int))
    cosine = np.abs((n * d).sum(axis=1))[both] / (ROUNDING * away)
    return tuple(np.quantile(np.abs(far * t[both] - exact[both]) * cosine, 0.999) for far in (1, 1 + 2e-6))


def _exact(things: list[Any], which: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the distance [N] of the object that each ray is for, in units of its direction; inf for none."""
    length = np.linalg.norm(np.float64(d), axis=1)
    shapes, parts = reference.Axial(things), np.array_split(np.arange(len(o)), len(o) // 5000)
    with np.errstate(all="ignore"):
        found = [shapes.distances(np.float64(o[k]), d[k] / length[k, None]) for k in parts]
    return np.concatenate(found)[np.arange(len(o)), which] / length


def traced(shape: dict[str, Any], o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which rays [N, 3] ``mrt_whitted`` finds to meet a shape, and how far away."""
    scene = mi.load_dict({"type": "scene", "shape": shape})
    hit = scenery.traced(scene, scenery.rays(o, d)).hit
    return np.array(hit.found), np.array(hit.si.t, np.float64)
