"""Cones: the exact surface against float64, and the mesh that stock integrators see against the exact one.

A mesh of n sides is inscribed in the cone; its distance to the surface falls with n⁻². The exact surface
costs no triangles and is as good as float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.scene.model import Cone, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import measure, ratio

TITLE = "Objects: mesh cones of more and more sides, and the exact cone of scene 9"

SEGMENTS = (64, 128, 256, 512, 1024)
CONE: dict[str, Any] = {
    "type": "mrt_cone",
    "apex": [0.2, 1.5, -0.1],
    "base_center": [0.5, 0.4, 0.3],
    "radius": 0.65,
}
MIDDLE = np.array([0.35, 0.95, 0.1])  # of the cone

# The mean takes in rays near rims and the apex, where the error is not that of a smooth surface, and at 1024
# sides float32 adds to it
SLOPE = 0.15
SAME_PART = 1e-2  # relative; beyond, near the rim, one ray met the side and the other the base
DEPTH = 2e-6  # relative; float32 has steps of 1.2e-7
SILHOUETTE = 1e-3  # relative; nothing but another surface is so far off


@dataclass(frozen=True)
class DepthErrors:
    """Shares of the pixels of a picture whose distance is within ``DEPTH``, or off by over ``SILHOUETTE``."""

    close: float
    astray: float


def run(study: Study, *, quick: bool) -> None:
    """Measure the mesh's error over its sides, the exact cone's depth, and, if not quick, times."""
    runtime.use(runtime.FAST)
    study.text(
        "Other integrators than mrt_whitted see a cone as a mesh. Random rays meet the mesh and the exact "
        "cone; the error is the difference of their distances, relative. Times are medians without "
        "compilation, for the search of the nearest hit alone."
    )
    _mesh_errors(study, 100_000 if quick else 1_000_000)
    if not quick:
        compare_with_spheres(study, width=800, height=600, samples=(1, 2, 4))
    width, height = (400, 300) if quick else (800, 600)
    ours = mrt.render(9, width=width, height=height, aa=1, layers=["depth"]).layers["depth.Z"]
    errors = depth_errors(ours, reference_render(report_scene(9), width=width, height=height).depth)
    study.at_least(
        f"scene 9: pixels with a depth within {DEPTH:g} of float64",
        errors.close,
        0.995,
        "a share of all pixels; depths too large by 1e-5 of them leave few",
    )
    study.at_most(
        f"scene 9: pixels with a depth off by more than {SILHOUETTE:g}",
        errors.astray,
        2e-4,
        "a share; on a silhouette, rounding decides what a ray meets; a picture a pixel aside has more",
    )


def crowd(count: int) -> tuple[Scene, Scene]:
    """Scene 4's room with random spheres, and with cones as high and wide as those in their places."""
    room, rng = report_scene(4), np.random.default_rng(5)
    places = rng.uniform((1, 0, 1), (7.5, 6.5, 7.5), (2 * count, 3))
    clear = np.linalg.norm(places - room.camera.position, axis=1) > 1  # of the eye
    spheres, cones = [], []
    for place, radius, half_axis, like in zip(
        places[clear][:count],
        rng.uniform(0.05, 0.25, count),
        rng.normal(size=(count, 3)),
        rng.integers(0, len(room.spheres), count),
        strict=True,
    ):
        half_axis *= radius / np.linalg.norm(half_axis)
        material, middle = room.spheres[like].material, tuple(place.tolist())
        apex, base = (tuple(p.tolist()) for p in (place + half_axis, place - half_axis))
        spheres.append(Sphere(middle, float(radius), material))
        cones.append(Cone(apex, base, float(radius), material))
    return replace(room, spheres=tuple(spheres)), replace(room, spheres=(), cones=tuple(cones))


def compare_with_spheres(study: Study, *, width: int, height: int, samples: tuple[int, ...]) -> None:
    """Time a thousand cones against a thousand of Mitsuba's spheres, by samples along an edge of a pixel."""
    import mitsuba as mi

    spheres, cones = (
        mi.load_dict(scene.to_dict(width=width, height=height)) for scene in crowd(1000)
    )  # a thousand spheres are shapes of Mitsuba's each; one more, and they would be searched as cones are
    rows = []
    with study.stage("Thousand cones", len(samples)) as advance:
        for aa in samples:
            pair = (partial(mrt.render, scene, aa=aa) for scene in (cones, spheres))
            t = ratio(*pair, repeats=3)
            rows.append([aa, t.seconds, t.other_seconds, t.median, f"{t.low:.2f} to {t.high:.2f}"])
            advance(1)
    study.table(
        "thousand_cones",
        "A thousand cones against a thousand spheres, seconds of a whole picture",
        ["aa", "cones", "spheres", "ratio", "quartiles"],
        rows,
        "Spheres are searched and intersected by Embree, cones by this project's tree in Dr.Jit.",
    )


def depth_errors(ours: np.ndarray, exact: np.ndarray) -> DepthErrors:
    """Compare distances [H, W], inf for none."""
    same_miss = np.isinf(ours) & np.isinf(exact)
    with np.errstate(invalid="ignore"):
        error = np.where(same_miss, 0, np.abs(ours / exact - 1))
    error = np.where(np.isnan(error), np.inf, error)
    return DepthErrors(float(np.mean(error <= DEPTH)), float(np.mean(error > SILHOUETTE)))


def _mesh_errors(study: Study, count: int) -> None:
    import mitsuba as mi

    ray = _rays(count)
    exact = _exact(ray, mi.load_dict(CONE).frame())
    with study.stage("Mesh cones", 1) as advance:
        warm = measure({n: search({**CONE, "segments": n}, ray) for n in SEGMENTS})
        advance(1)
    errors = {n: mesh_error(run.result, exact) for n, run in warm.items()}
    slope = -float(np.polyfit(np.log(SEGMENTS), np.log(list(errors.values())), 1)[0])
    rows = [[n, 2 * n, error, 1e3 * warm[n].seconds] for n, error in errors.items()]
    study.table("mesh_cones", f"Mesh cones, {count} rays", ["sides", "triangles", "mean error", "ms"], rows)
    study.at_most(
        "slope of the error of a mesh cone: |exponent - 2|",
        abs(slope - 2),
        SLOPE,
        "theory: 2, and rims and the apex; a mesh wider by a thousandth is beyond",
    )
    study.at_most(
        "mean error at 256 sides, the default",
        errors[256],
        # The height of a chord of 2π/n over an arc of radius r is r (π/n)²/2; rays are 3 to 5 long
        CONE["radius"] * (np.pi / 256) ** 2 / 2 / 3,
        "the chord's height over the distance; with 180 sides it would be twice that",
    )
    study.at_most(
        "rays that meet another part, or nothing, at 256 sides",
        other_hits(warm[256].result, exact),
        1e-3,
        "a share: silhouette, rim and apex within a chord's height, a few times 7.5e-5; a leak adds to it",
    )
    study.plot(
        "mesh_cones",
        "Error of a mesh cone over its sides",
        _figure(errors),
        "Both axes logarithmic; the dashed line has slope 2.",
    )


def mesh_error(found: np.ndarray, exact: np.ndarray) -> float:
    """The mean relative error of distances [N] where both meet the cone on the same side."""
    error = _relative_error(found, exact)
    return float(np.mean(error[error < SAME_PART]))


def other_hits(found: np.ndarray, exact: np.ndarray) -> float:
    """The share of all rays that meet another part of the cone, or the cone in one form only."""
    missed = np.mean(np.isfinite(found) != np.isfinite(exact))
    return float(missed + np.sum(_relative_error(found, exact) >= SAME_PART) / len(exact))


def _relative_error(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    both = np.isfinite(found) & np.isfinite(exact)
    return np.abs(found[both] / exact[both] - 1)


def search(cone: dict[str, Any], ray: Any) -> Callable[[], np.ndarray]:
    """Return a function that returns the distances [N] of rays to a mesh cone, inf for none."""
    import mitsuba as mi

    scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "cone": cone})
    return lambda: np.array(scene.ray_intersect_preliminary(ray).t)


def _rays(count: int) -> Any:
    """Rays from a sphere around the cone towards points near its axis."""
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(3)
    o = rng.normal(size=(count, 3))
    o = 4 * o / np.linalg.norm(o, axis=1, keepdims=True) + MIDDLE
    d = MIDDLE + rng.uniform(-0.4, 0.4, size=(count, 3)) - o
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f((d / np.linalg.norm(d, axis=1, keepdims=True)).T))
    dr.eval(ray)
    return ray


def _exact(ray: Any, frame: Any) -> np.ndarray:
    """Distances of the quadric in float64, inf for none."""
    from drjit.llvm.ad import Array3f64

    from mrt_mitsuba.plugins.intersect import Frame, intersect_cone

    wide = Frame(Array3f64(frame.origin), *(Array3f64(row) for row in (frame.x, frame.y, frame.z)))
    return np.array(intersect_cone(Array3f64(ray.o), Array3f64(ray.d), wide).t)


def _figure(errors: dict[int, float]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    sides, values = np.array(list(errors), float), list(errors.values())
    axes.loglog(sides, values, "o-", label="mean error")
    axes.loglog(sides, values[0] * (sides / sides[0]) ** -2, "--", color="grey", label="slope 2")
    axes.set(xlabel="sides", ylabel="relative error of distance")
    axes.legend()
    return figure
