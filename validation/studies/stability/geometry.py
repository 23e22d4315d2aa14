"""Single objects at all sizes and distances against float64; whole scenes scaled and moved.

The laws of ``check_shape`` hold what needs no other renderer; here, rays have a known truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.linalg import norm

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Mesh, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import Array, dot, nearest, unit
from mrt_mitsuba.validation.studies.stability.case import Case
from mrt_mitsuba.validation.study import Values

Point = tuple[float, float, float]

ROUNDING = 2.0**-24
DECADES = 10.0 ** np.arange(-6, 7, 2)
# Beyond this ratio of distance to size, the roundings of the ray's origin are as large as the object
FARTHEST = 1e5
# A ray that passes the outline by fewer roundings may hit or miss
OUTLINE = 64
# Directions to a light flatter than this may meet their own surface
FLATTEST = 1e-3

# A pixel is another one if a channel differs by more than two steps of an 8-bit picture. After scaling by
# powers of ten, so many may be: those whose centre ray passes an outline or the edge of a shadow within the
# roundings of the scaled numbers, seen directly or through ten mirrors. After moving by n scene sizes, they
# move by n roundings, enlarged by every curved mirror
VISIBLE = 2 / 255
SHARE_SCALED = 0.001
SHARE_MOVED = 1e-4


WHERE = f"sizes 1e-6 … 1e6, from 1e-6 to {FARTHEST:g} sizes away and from inside"
FIGURES = (  # of the rays at a size, in the order of ``measure``
    Case(
        "place",
        f"{WHERE}: worst distance error across the surface, in roundings of the largest coordinate",
        "what intersection and a ray's own t lose",
        limit=16,
    ),
    Case(
        "hits",
        f"rays that hit or miss wrongly, {OUTLINE} roundings and more off the outline, or find a distance, "
        "normal or colour that is no finite number",
        "the same",
        limit=0,
    ),
    Case("mirror rays", "mirror rays that meet the surface they leave", "they start off it", limit=0),
    Case("shadow rays", "points that their own surface hides from a light above it", "the same", limit=0),
)

MIRROR = Material(1.5, 1.0, (1, 1, 1), (1, 1, 1))
CORNERS = np.array([(-0.8, -0.5, 0.1), (0.9, -0.3, -0.2), (0.1, 0.9, 0.3)])


def solids(size: float) -> Values:
    """Objects of about a size around the origin, by the name that a scene has for their kind."""
    triangle = np.array([[0, 1, 2]], np.uint32)
    return {
        "spheres": Sphere((0, 0, 0), size, MIRROR),
        "planes": Plane((0.6, 0.64, 0.48), 0.3 * size, MIRROR),
        "meshes": Mesh(np.float32(CORNERS * size), triangle, MIRROR),
        "cones": Cone(*ends(size), 0.5 * size, MIRROR),
        "cylinders": Cylinder(*ends(size), 0.5 * size, MIRROR),
    }


def ends(size: float) -> tuple[Point, Point]:
    """The ends of a slanted axis."""
    return (0.1 * size, 0.6 * size, -0.2 * size), (-0.1 * size, -0.4 * size, 0.2 * size)


def cases(quick: bool) -> Iterator[Case]:
    """Yield single objects, then the report's scenes scaled and moved."""
    count = 300 if quick else 3000
    for kind in solids(1):
        sizes = DECADES[::3] if quick else DECADES
        worst = np.max([measure(kind, size, count) for size in sizes], axis=0)
        for case, figure in zip(FIGURES, worst, strict=True):
            yield replace(case, name=f"{kind}, {case.name}", measured=figure)
    # Scene 2 shows the horizon, which a far plane can cut off
    for number in (0, 2, 3) if quick else range(5):
        scene = replace(report_scene(number), focal_distance=None)
        yield from scaled_and_moved(scene, f"scene {number}")


def scaled_and_moved(scene: Scene, name: str) -> Iterator[Case]:
    """Yield the share of pixels that change where a scene is scaled, and moved by multiples of its size."""

    def picture(scene: Scene) -> Array:
        return render(scene, width=120, height=90, aa=1, aamode="none").image  # [H, W, 3]

    base = picture(scene)

    def changed(factor: float, sizes: float) -> float:
        off = abs(picture(placed(scene, factor, sizes)) - base).max(axis=-1)
        return float(np.mean(~(off <= VISIBLE)))  # NaN is off

    what = "share of pixels off by more than 2/255"
    for factor in (1e-6, 1e-3, 1e3, 1e6):
        yield Case(f"{name} times {factor:g}", what, "the same picture", changed(factor, 0), SHARE_SCALED)
    for sizes in (1.0, 10.0, 100.0, 1e3, 1e4):
        step = sizes * 2**-23
        why = f"coordinates have steps of {step:.0e} scene sizes there: normals and outlines move"
        # Very far away, float32 has no digits left for the scene
        most = max(SHARE_MOVED * sizes, SHARE_SCALED) if sizes <= 100 else None
        yield Case(f"{name} moved by {sizes:g} sizes", what, why, changed(1, sizes), most)


def placed(scene: Scene, factor: float, sizes: float) -> Scene:
    """The scene with all lengths multiplied, or shifted by a multiple of its size, along no axis.

    Its size: the distance from the camera to what it looks at.
    """
    camera = scene.camera
    size = norm(np.subtract(camera.position, camera.target))
    way = np.array([0.48, -0.6, 0.64]) * sizes * size

    def by(p: Point) -> Point:
        x, y, z = (np.array(p) * factor + way).tolist()
        return (x, y, z)

    planes = [(p, float(p.distance * factor - unit(np.array(p.normal)) @ way)) for p in scene.planes]
    return replace(
        scene,
        camera=replace(camera, position=by(camera.position), target=by(camera.target)),
        lights=tuple(replace(light, position=by(light.position)) for light in scene.lights),
        spheres=tuple(replace(s, center=by(s.center), radius=s.radius * factor) for s in scene.spheres),
        planes=tuple(replace(plane, distance=distance) for plane, distance in planes),
    )


def measure(kind: str, size: float, count: int) -> list[float]:
    """The figures of rays at one size, from all distances: the worst place, and three counts of rays."""
    # None is on the surface
    distances = [1.5 * x if x == size else x for x in DECADES if x <= FARTHEST * size]
    o, d = np.concatenate([_rays(size, x, count) for x in distances], axis=1)  # [N, 3] each
    scale = np.maximum(np.repeat(distances, count), size)
    rounding = ROUNDING * scale / size  # of the largest coordinate, in sizes
    thing = solids(size)[kind]
    light = np.array([3.0, 5.0, 4.0]) * size
    # and another thing so small and far off that no ray meets it
    aside = {"type": "sphere", "center": [1.7 * size] * 3, "radius": 1e-3 * size, "flip_normals": True}
    scene = mi.load_dict(lit(kind, thing, light.tolist()) | {"aside": aside})
    trace = trace_of(scene, o, d)  # arrays that are read below, from a scene that must still be there
    hit = np.array(trace.hit.found)
    direct = np.array(trace.direct[0])
    t = np.array(trace.hit.si.t, np.float64)

    truth, normal = first_hits(thing, o, d)
    # an object enlarged is the same as rays from nearer by
    reach = OUTLINE * rounding
    nearer, farther = (first_hits(thing, o / (1 + r)[:, None], d)[0] for r in (reach, -reach))
    exists = np.isfinite(truth)
    both = hit & exists
    cosine = np.where(both, dot(normal, d), 1)
    away = np.where(both, truth, 0)
    p = o + away[:, None] * d
    front = both & (cosine < -FLATTEST)
    height = dot(unit(light - p), normal)
    largest = np.maximum(scale, abs(p).max(axis=1))
    across = abs((np.where(both, t, 0) - away) * cosine) / largest
    finite = np.isfinite(direct) & (~hit | np.isfinite(trace.hit.si.n).all(axis=0) & np.isfinite(t))
    wrong = (hit != exists) & (np.isfinite(nearer) == np.isfinite(farther))
    above = height > FLATTEST + reach
    return [
        across.max() / ROUNDING if both.sum() >= 100 else np.inf,  # else it means nothing
        (wrong | ~finite).sum(),
        (front & (np.array(trace.bounces) > 1)).sum(),
        (front & above & ~(direct > 0)).sum(),
    ]


def first_hits(thing: Any, o: Array, d: Array) -> tuple[Array, Array]:
    """The first hits of rays (o + t d) with an object in float64: t [N], inf for none, and normals [N, 3]."""
    length = norm(np.float64(d), axis=1)
    distance, _, normal, *_ = nearest([thing], o, d / length[:, None])
    return distance / length, normal


def lit(kind: str, thing: Any, light: Sequence[float]) -> Values:
    """The nodes of a scene with one solid, of a kind of ``solids``, under a light."""
    x, y, z = light
    camera = Camera((0, 0, 9), (0, 0, 0))
    things: Values = {kind: (thing,)}
    return Scene(camera, (0, 0, 0), (Light((x, y, z), (1, 1, 1)),), **things).to_dict(fresnel="unity")


def trace_of(scene: mi.Scene, o: Array, d: Array) -> Any:
    """The trace of ``mrt_whitted`` along rays (o, d [N, 3])."""
    whitted = mi.load_dict({"type": "mrt_whitted", "min_contribution": 0.0, "bounce_budget": "plain"})
    return whitted.trace(scene, None, mi.Ray3f(o.T, d.T))


def _rays(size: float, distance: float, count: int) -> tuple[Array, Array]:
    """Rays (o [N, 3], d [N, 3]) from a distance to all parts of an object, a third to its outline."""
    rng = np.random.default_rng(7)
    towards, across, anywhere = unit(rng.normal(size=(3, count, 3)))
    o = np.float32(distance * towards)
    outline = 1 + 1e-3 * rng.normal(size=count)
    offset = np.where(rng.random(count) < 1 / 3, outline, rng.uniform(0, 1.2, count))
    aimed = unit(unit(np.cross(towards, across)) * (size * offset)[:, None] - o)
    return o, np.float32(anywhere if distance < 0.05 * size else aimed)
