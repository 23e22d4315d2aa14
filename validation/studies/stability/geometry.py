"""Single objects at all sizes and distances against float64; whole scenes scaled and moved.

The laws of ``check_shape`` hold what needs no other renderer; here, rays have a known truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Mesh, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import nearest, unit

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
VISIBLE, SHARE_SCALED, SHARE_MOVED = 2 / 255, 0.001, 1e-4
# Of each place its name, a factor, a number of scene sizes, why, and the most that it holds to, if it can
STEPS = "coordinates have steps of {:.0e} scene sizes there: normals and outlines move"
PLACES: tuple[tuple[Any, ...], ...] = (
    *((f"times {s:g}", s, 0, "the same picture", SHARE_SCALED) for s in (1e-6, 1e-3, 1e3, 1e6)),
    *((f"moved by {n:g} sizes", 1, n, STEPS.format(n * 2**-23), max(SHARE_MOVED * n, SHARE_SCALED))
      for n in (1.0, 10.0, 100.0)),
    *((f"moved by {n:g} sizes", 1, n, STEPS.format(n * 2**-23)) for n in (1e3, 1e4)),
)  # fmt: skip

WHERE = f"sizes 1e-6 … 1e6, from 1e-6 to {FARTHEST:g} sizes away and from inside"
# What ``measure`` returns of an object, in this order: what it is, why it must be so, and the most
FIGURES = (
    ("place", f"{WHERE}: worst distance error across the surface, in roundings of the largest coordinate",
     "what intersection and a ray's own t lose", 16),
    ("hits", f"rays that hit or miss wrongly, {OUTLINE} roundings and more off the outline, or find a "
     "distance, normal or colour that is no finite number", "the same", 0),
    ("mirror rays", "mirror rays that meet the surface they leave", "they start off it", 0),
    ("shadow rays", "points that their own surface hides from a light above it", "the same", 0),
)  # fmt: skip

MIRROR = Material(1.5, 1.0, (1, 1, 1), (1, 1, 1))
CORNERS = np.array([(-0.8, -0.5, 0.1), (0.9, -0.3, -0.2), (0.1, 0.9, 0.3)])
# Objects of about a size around the origin, by the name that a scene has for their kind
SOLIDS: dict[str, Callable[[float], Any]] = {
    "spheres": lambda size: Sphere((0, 0, 0), size, MIRROR),
    "planes": lambda size: Plane((0.6, 0.64, 0.48), 0.3 * size, MIRROR),
    "meshes": lambda size: Mesh(np.float32(CORNERS * size), np.array([[0, 1, 2]], np.uint32), MIRROR),
    "cones": lambda size: Cone(*ends(size), 0.5 * size, MIRROR),
    "cylinders": lambda size: Cylinder(*ends(size), 0.5 * size, MIRROR),
}


def ends(size: float) -> tuple[Any, Any]:
    """Return the ends of an axis aslant."""
    return (0.1 * size, 0.6 * size, -0.2 * size), (-0.1 * size, -0.4 * size, 0.2 * size)


def cases(quick: bool) -> Iterator[tuple[Any, ...]]:
    """Yield single objects, then the report's scenes scaled and moved."""
    for kind in SOLIDS:
        sizes = DECADES[::3] if quick else DECADES
        worst = np.max([measure(kind, size, 300 if quick else 3000) for size in sizes], axis=0)
        for (figure, what, why, most), found in zip(FIGURES, worst, strict=True):
            yield f"{kind}, {figure}", what, why, found, most
    # Scene 2 shows the horizon, which a far plane can cut off
    for number in (0, 2, 3) if quick else range(5):
        scene = replace(report_scene(number), focal_distance=None)
        base = picture(scene)
        for name, factor, sizes, why, *held in PLACES:
            share = np.mean(~(np.abs(picture(placed(scene, factor, sizes)) - base).max(axis=-1) <= VISIBLE))
            yield f"scene {number} {name}", "share of pixels off by more than 2/255", why, share, *held


def picture(scene: Scene) -> np.ndarray:
    """Render with one ray per pixel; [H, W, 3]."""
    return render(scene, width=120, height=90, aa=1, aamode="none").image


def placed(scene: Scene, factor: float, sizes: float) -> Scene:
    """Return the scene with all lengths multiplied, or shifted by a multiple of its size, along no axis.

    Its size: the distance from the camera to what it looks at.
    """
    camera = scene.camera
    size = np.linalg.norm(np.subtract(camera.position, camera.target))
    way = np.array([0.48, -0.6, 0.64]) * sizes * size

    def by(p: Any) -> tuple[float, float, float]:
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


def measure(kind: str, size: float, count: int) -> tuple[float, ...]:
    """Return the figures of rays at one size, from all distances."""
    # None is on the surface
    distances = [1.5 * x if x == size else x for x in DECADES if x <= FARTHEST * size]
    o, d = map(np.concatenate, zip(*(_rays(size, x, count) for x in distances), strict=True))
    scale = np.maximum(np.repeat(distances, count), size)
    rounding = ROUNDING * scale / size  # of the largest coordinate, in sizes
    thing, light = SOLIDS[kind](size), np.array([3.0, 5.0, 4.0]) * size
    whole: Any = Scene(Camera((0, 0, 9), (0, 0, 0)), (0, 0, 0), (Light(tuple(light.tolist()), (1, 1, 1)),))
    nodes = replace(whole, **{kind: (thing,)}).to_dict(fresnel="unity")
    # another kind of shape, so small and far off that no ray meets it
    aside = {"type": "sphere", "center": [1.7 * size] * 3, "radius": 1e-3 * size, "flip_normals": True}
    scene = mi.load_dict(nodes | {"aside": aside})
    whitted = mi.load_dict({"type": "mrt_whitted", "min_contribution": 0.0, "bounce_budget": "plain"})
    trace = whitted.trace(scene, None, mi.Ray3f(o.T, d.T))
    found, direct, n = np.array(trace.hit.found), np.array(trace.direct[0]), np.array(trace.hit.si.n).T
    t = np.array(trace.hit.si.t, np.float64)

    length = np.linalg.norm(np.float64(d), axis=1)
    # an object enlarged is the same as rays from nearer by
    nearer = [o / (1 + k * OUTLINE * rounding)[:, None] for k in (0, 1, -1)]
    truth, larger, smaller = (nearest([thing], start, d / length[:, None]) for start in nearer)
    exact, normal = truth[0] / length, truth[2]
    exists, near_outline = np.isfinite(exact), np.isfinite(larger[0]) != np.isfinite(smaller[0])
    both = found & exists
    cosine = np.where(both, (normal * d).sum(axis=1), 1)
    away = np.where(both, exact, 0)
    p = o + away[:, None] * d
    front = both & (cosine < -FLATTEST)
    height = ((light - p) * normal).sum(axis=1) / np.linalg.norm(light - p, axis=1)
    across = np.abs((np.where(both, t, 0) - away) * cosine) / np.maximum(scale, np.abs(p).max(axis=1))
    finite = np.isfinite(direct) & (~found | np.isfinite(n).all(axis=1) & np.isfinite(t))
    return (
        across.max() / ROUNDING if both.sum() >= 100 else np.inf,  # else it means nothing
        ((found != exists) & ~near_outline | ~finite).sum(),
        (front & (np.array(trace.bounces) > 1)).sum(),
        (front & (height > FLATTEST + OUTLINE * rounding) & ~(direct > 0)).sum(),
    )


def _rays(size: float, distance: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (o [N, 3], d [N, 3]) from a distance to all parts of an object, a third to its outline."""
    rng = np.random.default_rng(7)
    towards, across, anywhere = (unit(rng.normal(size=(count, 3))) for _ in range(3))
    o = (distance * towards).astype(np.float32)
    outline = 1 + 1e-3 * rng.normal(size=count)
    offset = np.where(rng.random(count) < 1 / 3, outline, rng.uniform(0, 1.2, count))
    aimed = unit(unit(np.cross(towards, across)) * (size * offset)[:, None] - o)
    return o, (anywhere if distance < 0.05 * size else aimed).astype(np.float32)
