"""Single objects at all sizes and distances against float64; whole scenes scaled and moved.

The laws of ``check_shape`` hold what needs no other renderer; here, rays have a known truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Material, Mesh, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles import reference
from mrt_mitsuba.validation.studies.stability.cases import Cases
from mrt_mitsuba.validation.tools.scenery import rays, traced
from mrt_mitsuba.validation.tools.study import Study

ROUNDING = 2.0**-24
DECADES = 10.0 ** np.arange(-6, 7, 2)

# Beyond this ratio of distance to size, the roundings of the ray's origin are as large as the object
FARTHEST = 1e5
# In roundings of the largest coordinate, across the surface: what intersection and a ray's own t lose
ACROSS = 16
# A ray that passes the outline by less than this may hit or miss; and normals further apart than this within
# reach may be those of another part of the surface
OUTLINE, ANOTHER_PART = 64, 256
# Directions to a light flatter than this may meet their own surface
FLATTEST = 1e-3

SCALES = (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)
TRANSLATIONS = (1.0, 1e1, 1e2, 1e3, 1e4)
WIDTH, HEIGHT = 120, 90

# A pixel is another one if a channel differs by more than two steps of an 8-bit picture
VISIBLE = 2 / 255

# Share of pixels that may differ after scaling by powers of ten: those whose centre ray passes an outline
# or the edge of a shadow within the roundings of the scaled numbers, seen directly or through ten mirrors
SHARE_SCALED = 0.001
# After moving by n scene sizes, outlines and reflections move by n roundings, enlarged by every curved mirror
SHARE_MOVED = 1e-4  # for each of them, and no less than after scaling
HOLDS_TO = 100.0  # scene sizes


def run(study: Study, *, quick: bool) -> None:
    """Check single objects, then the report's scenes scaled and moved."""
    cases = Cases(study, "geometry", "Geometry")
    for solid in SOLIDS:
        sizes = DECADES[::3] if quick else DECADES
        found = [_measure(solid, size, 300 if quick else 3000) for size in sizes]
        limits = {"place": ACROSS, "normal": solid.normal}
        for figure, what, expected, fault in FIGURES:
            worst, made = (max(f.get(figure + word, 0) for f in found) for word in ("", ", fault"))
            seen = (fault, made) if fault else None
            limit = limits.get(figure, 0)
            cases.at_most(f"{solid.name}, {figure}", what, expected, worst, limit, fault=seen)
        hits = sum(f["hits"] for f in found)
        cases.at_least(f"{solid.name}, hits", WHERE, "the other figures mean something", hits, 500)
    _grazing(cases, 100_000 if quick else 1_000_000)
    _scenes(study, cases, quick=quick)
    cases.close("A rounding is 2⁻²⁴ = 6e-8. Truth: the same rays in float64.")


# --------------------------------------------- Single objects ----------------------------------------------

MATTE = Material(0.0, 1.0, (0, 0, 0), (1, 1, 1))
APEX, BASE, RADIUS = np.array([0.1, 0.6, -0.2]), np.array([-0.1, -0.4, 0.2]), 0.5
CORNERS = np.array([(-0.8, -0.5, 0.1), (0.9, -0.3, -0.2), (0.1, 0.9, 0.3)])
NORMAL_OF_PLANE, PLANE_DISTANCE = np.array([0.6, 0.64, 0.48]), 0.3


@dataclass(frozen=True)
class Solid:
    """An object of about the size 1 around the origin, to be scaled."""

    name: str
    to_dict: Callable[[float], dict[str, Any]]  # of this size
    exact: Callable[[float], Any]  # of this size, for the float64 tracer
    normal: float  # what its normals may be off by, in roundings
    alone: bool = False  # else another shape is in the scene, out of the way


def _triangle(size: float) -> dict[str, Any]:
    """Return the triangle, mirrored and of size 1, with what puts it right."""
    positions = mi.Bitmap((CORNERS * [1, 1, -1]).astype(np.float32)[np.newaxis])
    faces = mi.Bitmap(np.array([[[0, 2, 1]]], np.uint32))
    right = mi.ScalarTransform4f().scale([size, size, -size])
    return {"type": "mrt_mesh", "positions": positions, "faces": faces, "to_world": right}


def _axial(kind: Any, first: str, second: str) -> Solid:
    """Return a cone or a cylinder, whose ends go by these names."""
    name = kind.__name__.lower()
    return Solid(
        name,
        lambda s: {
            "type": f"mrt_{name}",
            first: (APEX * s).tolist(),
            second: (BASE * s).tolist(),
            "radius": RADIUS * s,
        },
        lambda s: reference.Axial([kind(APEX * s, BASE * s, RADIUS * s, MATTE)]),
        30,
    )


SPHERE = Solid(
    "sphere",
    lambda s: {"type": "sphere", "radius": s},
    lambda s: reference.Spheres([Sphere((0, 0, 0), s, MATTE)]),
    12,
)
PLANE = Solid(
    "plane",
    lambda s: {"type": "mrt_plane", "normal": NORMAL_OF_PLANE.tolist(), "distance": PLANE_DISTANCE * s},
    lambda s: reference.Planes([Plane(tuple(NORMAL_OF_PLANE), PLANE_DISTANCE * s, MATTE)]),
    3,
)
TRIANGLE = Solid(
    "triangle",
    _triangle,
    lambda s: reference.Triangles(Mesh(CORNERS * s, np.array([[0, 1, 2]]), MATTE)),
    6,
)
CONE, CYLINDER = _axial(Cone, "apex", "base_center"), _axial(Cylinder, "p0", "p1")
SOLIDS = (replace(SPHERE, name="sphere alone", alone=True), SPHERE, PLANE, TRIANGLE, CONE, CYLINDER)


WHERE = f"sizes 1e-6 … 1e6, from 1e-6 to {FARTHEST:g} sizes away and from inside"
LARGEST = "roundings of the largest coordinate"
# What is measured of a solid: name, what it is, what is expected, and a fault that was made, in words
FIGURES = (
    ("place", f"{WHERE}: worst distance error across the surface, in {LARGEST}",
     "a few roundings", "hits 1 in 100,000 further away"),
    ("normal", f"its worst angle times the cosine of incidence, in {LARGEST} over the size",
     "a few roundings", "normals turned by 2 in 100,000"),
    ("hits and misses", f"rays that hit or miss wrongly, {OUTLINE} roundings and more off the outline",
     "none", ""),
    ("mirror rays", "mirror rays that meet the surface they leave", "none", ""),
    ("shadow rays", "points that their own surface hides from a light above it", "none", ""),
    ("finite", "distances, normals and colours that are no finite numbers", "none", ""),
)  # fmt: skip


def _measure(solid: Solid, size: float, count: int) -> dict[str, float]:
    """Return the figures of rays at one size, from all distances."""
    # None is on the surface
    distances = [1.5 * x if x == size else x for x in DECADES if x <= FARTHEST * size]
    bundles = [_rays(size, distance, count) for distance in distances]
    o, d = (np.concatenate(part) for part in zip(*bundles, strict=True))
    scale = np.maximum(np.repeat(distances, count), size)
    rounding = ROUNDING * scale / size  # of the largest coordinate, in sizes
    light = np.array([3.0, 5.0, 4.0]) * size
    mirror = {"type": "mrt_bsdf", "fresnel": "unity", "alpha": 1.0, "diffuse_reflectance": 1.0}
    nodes: dict[str, Any] = {"solid": {**solid.to_dict(size), "bsdf": mirror}}
    if not solid.alone:  # another kind of shape, so small and far off that no ray meets it
        aside = {"center": [1.7 * size] * 3, "radius": 1e-3 * size, "flip_normals": True}
        nodes["other"] = {"type": "sphere", **aside}
    nodes["light"] = {"type": "mrt_light", "position": light.tolist()}
    scene = mi.load_dict({"type": "scene", **nodes})
    trace = traced(scene, rays(o, d), min_contribution=0.0, bounce_budget="plain")
    found, direct, n = np.array(trace.hit.found), np.array(trace.direct[0]), np.array(trace.hit.si.n).T
    exact = solid.exact(size)
    # a solid enlarged is the same as rays from nearer by
    truth, larger, smaller = (_hit(exact, o / (1 + k * OUTLINE * rounding)[:, None], d) for k in (0, 1, -1))
    exists, near_outline = np.isfinite(truth[0]), np.isfinite(larger[0]) != np.isfinite(smaller[0])
    both = found & exists
    cosine = np.where(both, (truth[1] * d).sum(axis=1), 1)
    p = o + np.where(both, truth[0], 0)[:, None] * d
    smooth = both & np.isfinite(larger[0]) & np.isfinite(smaller[0])
    spread = np.linalg.norm(larger[1] - smaller[1], axis=1) * np.abs(cosine)
    smooth &= spread < ANOTHER_PART * rounding
    front = both & (cosine < -FLATTEST)
    height = ((light - p) * truth[1]).sum(axis=1) / np.linalg.norm(light - p, axis=1)
    t = np.array(trace.hit.si.t, np.float64)
    finite = np.isfinite(direct) & (~found | np.isfinite(n).all(axis=1) & np.isfinite(t))
    figures: dict[str, float] = {
        "hits": both.sum(),
        "hits and misses": ((found != exists) & ~near_outline).sum(),
        "mirror rays": (front & (np.array(trace.bounces) > 1)).sum(),
        "shadow rays": (front & (height > FLATTEST + OUTLINE * rounding) & ~(direct > 0)).sum(),
        "finite": (~finite).sum(),
    }
    for suffix, further, turn in (("", 1.0, 0.0), (", fault", 1 + 1e-5, 2e-5)):
        across = np.abs((further * np.where(both, t, 0) - np.where(both, truth[0], 0)) * cosine)
        across /= ROUNDING * np.maximum(scale, np.abs(p).max(axis=1))
        turned = n + turn * np.cross(n, [0.36, 0.48, 0.8])
        angle = np.linalg.norm(turned - truth[1], axis=1) * np.abs(cosine) / rounding
        figures[f"place{suffix}"] = across.max()
        figures[f"normal{suffix}"] = np.max(angle, where=smooth, initial=0)
    return figures


def _rays(size: float, distance: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (o [N, 3], d [N, 3]) from a distance to all parts of an object, a third to its outline."""
    rng = np.random.default_rng(7)
    towards, across, anywhere = (_unit(rng.normal(size=(count, 3))) for _ in range(3))
    o = (distance * towards).astype(np.float32)
    outline = 1 + 1e-3 * rng.normal(size=count)
    offset = np.where(rng.random(count) < 1 / 3, outline, rng.uniform(0, 1.2, count))
    aimed = _unit(_unit(np.cross(towards, across)) * (size * offset)[:, None] - o)
    return o, (anywhere if distance < 0.05 * size else aimed).astype(np.float32)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _hit(shape: Any, o: np.ndarray, d: np.ndarray, which: Any = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [N] (inf: a miss) and normal [N, 3] of one object for each ray, in float64."""
    which = np.broadcast_to(which, len(o))
    with np.errstate(all="ignore"):
        length = np.linalg.norm(np.float64(d), axis=1)
        t = shape.distances(np.float64(o), d / length[:, None])[np.arange(len(o)), which] / length
        return t, shape.normals(o + np.where(np.isfinite(t), t, 0)[:, None] * d, which)


def _grazing(cases: Cases, count: int) -> None:
    """Rays along the sides of twenty upright objects in a group, where boxes and surfaces touch."""
    for kind, make in (("cone", Cone), ("cylinder", Cylinder)):
        rng = np.random.default_rng(3)
        base = np.arange(20)[:, None] * np.array([1.7, 0.3, 0])
        numbers = np.float32(np.hstack([base + np.array([0, 0, 1]), base, rng.uniform(0.2, 0.6, (20, 1))]))
        which = rng.integers(0, 20, count)
        side = rng.choice([-1.0, 1.0], count) * (
            numbers[which, 6] * (1 - 10.0 ** rng.uniform(-6.3, -5, count))
        )
        along_x = (rng.random(count) < 0.5)[:, None]
        height, away = rng.uniform(0, 2e-7 if kind == "cone" else 1, count), np.full(count, -3.0)
        start = np.where(along_x, np.stack([away, side, height], 1), np.stack([side, away, height], 1))
        o, d = np.float32(numbers[which, 3:6] + start), np.float32(np.where(along_x, [1, 0, 0], [0, 1, 0]))
        exact = reference.Axial([make(row[:3], row[3:6], row[6], MATTE) for row in np.float64(numbers)])
        parts = np.array_split(np.arange(count), count // 5000)
        met = np.concatenate([np.isfinite(_hit(exact, o[k], d[k], which[k])[0]) for k in parts])
        group = {"type": "mrt_group", "kind": kind, "numbers": mi.Bitmap(numbers)}
        found = np.array(traced(mi.load_dict({"type": "scene", "group": group}), rays(o, d)).hit.found)
        what = (
            f"of {count} rays along the sides of upright objects, a few roundings deep: those that are lost"
        )
        cases.at_most(f"{kind}, grazing rays", what, "none", (met & ~found).sum(), 0)


# ---------------------------------------------- Whole scenes -----------------------------------------------


def _scenes(study: Study, cases: Cases, *, quick: bool) -> None:
    rows, what = [], "share of pixels that differ by more than 2/255"
    numbers = (0, 2, 3) if quick else range(5)  # scene 2 shows the horizon, which a far plane can cut off
    for number in numbers:
        scene = report_scene(number)
        base = picture(scene)
        for factor in SCALES[::5] if quick else SCALES:
            share = _differing(picture(placed(scene, factor)), base)
            cases.at_most(f"scene {number} times {factor:g}", what, "the same picture", share, SHARE_SCALED)
        shares = [_differing(picture(placed(scene, sizes=n)), base) for n in TRANSLATIONS]
        rows.append((str(number), size(scene), *shares))
        for n, share in zip(TRANSLATIONS, shares, strict=True):
            title = f"scene {number} moved by {n:g} sizes"
            if n <= HOLDS_TO:
                cases.at_most(title, what, "the same picture", share, max(SHARE_MOVED * n, SHARE_SCALED))
            else:
                step = f"{n * 2**-23:.0e} scene sizes"
                why = f"coordinates have steps of {step} there: normals, highlights and outlines move"
                cases.beyond_float32(title, what, share, why)
    heading = "Share of pixels that differ after the scene was moved by so many scene sizes"
    note = "float32 gives out gradually: a scene belongs within a few of its sizes around the origin."
    study.table("translation", heading, ("scene", "size", *(f"{n:g}" for n in TRANSLATIONS)), rows, note)


def placed(scene: Scene, factor: float = 1.0, sizes: float = 0.0) -> Scene:
    """Return the scene with all lengths multiplied, or shifted by a multiple of its size, along no axis."""
    way = np.array([0.48, -0.6, 0.64]) * sizes * size(scene)

    def by(p: Any) -> tuple[float, float, float]:
        x, y, z = (np.array(p) * factor + way).tolist()
        return (x, y, z)

    def distance(plane: Any) -> float:
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        return float(plane.distance * factor - normal @ way)

    camera = scene.camera
    return replace(
        scene,
        camera=Camera(by(camera.position), by(camera.target), camera.up, camera.hfov),
        lights=tuple(replace(light, position=by(light.position)) for light in scene.lights),
        spheres=tuple(replace(s, center=by(s.center), radius=s.radius * factor) for s in scene.spheres),
        planes=tuple(replace(p, distance=distance(p)) for p in scene.planes),
    )


def size(scene: Scene) -> float:
    """Return the distance from the camera to what it looks at."""
    return float(np.linalg.norm(np.subtract(scene.camera.position, scene.camera.target)))


def picture(scene: Scene) -> np.ndarray:
    """Render with one ray per pixel; [H, W, 3]."""
    return render(replace(scene, focal_distance=None), width=WIDTH, height=HEIGHT, aa=1, aamode="none").image


def _differing(image: np.ndarray, base: np.ndarray) -> float:
    return float((~(np.abs(image - base).max(axis=-1) <= VISIBLE)).mean())
