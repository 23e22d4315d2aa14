"""Cones as meshes, which stock integrators see, against exact ones; and what a thousand exact ones cost.

A mesh of n sides is inscribed in the cone; its distance to the surface falls with n⁻². The exact one costs
no triangles and is as good as float32: ``stability`` and ``scenes`` judge it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.plugins.intersect import Frame, intersect_cone
from mrt_mitsuba.scene.model import Cone, Scene
from mrt_mitsuba.scene.report import scene_of_spheres
from mrt_mitsuba.validation.tools.gallery import curves
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import measure, ratio

TITLE = "Objects: mesh cones of more and more sides, and a thousand exact ones"

SEGMENTS = (64, 128, 256, 512, 1024)
MIDDLE = np.array([0.35, 0.95, 0.1])  # of the cone
CONE: dict[str, Any] = {
    "type": "mrt_cone",
    "apex": [0.2, 1.5, -0.1],
    "base_center": [0.5, 0.4, 0.3],
    "radius": 0.65,
}
# The mean takes in rays near rims and the apex, where the error is not that of a smooth surface, and at 1024
# sides float32 adds to it
SLOPE = 0.15
SAME_PART = 1e-2  # relative; beyond, near the rim, one ray met the side and the other the base


def run(study: Study, *, quick: bool) -> None:
    """Measure the mesh's error over its sides, and, if not quick, the time of a thousand exact cones."""
    runtime.use(runtime.FAST)
    study.text(
        "Other integrators than mrt_whitted see a cone as a mesh. Random rays meet the mesh and the exact "
        "cone; the error is the difference of their distances, relative. Times are medians without "
        "compilation, for the search of the nearest hit alone."
    )
    _mesh_errors(study, 100_000 if quick else 1_000_000)
    if not quick:
        compare_with_spheres(study, width=800, height=600, samples=(1, 2, 4))


def crowd(count: int) -> tuple[Scene, Scene]:
    """Return scene 4 with so many spheres, and with cones as high and wide as those in their places."""
    room = scene_of_spheres(count)
    cones = []
    for sphere, axis in zip(room.spheres, np.random.default_rng(5).normal(size=(count, 3)), strict=True):
        half = axis * (sphere.radius / np.linalg.norm(axis))
        apex, base = (tuple((np.array(sphere.center) + side * half).tolist()) for side in (1, -1))
        cones.append(Cone(apex, base, sphere.radius, sphere.material))
    return room, replace(room, spheres=(), cones=tuple(cones))


def compare_with_spheres(study: Study, *, width: int, height: int, samples: tuple[int, ...]) -> None:
    """Time a thousand cones against a thousand of Mitsuba's spheres, by samples along an edge of a pixel."""
    # A thousand spheres are shapes of Mitsuba's each; one more, and they would be searched as cones are
    spheres, cones = (load(scene.to_dict(width=width, height=height)) for scene in crowd(1000))
    rows = []
    for aa in study.each("Thousand cones", samples):
        t = ratio(*(partial(mrt.render, scene, aa=aa) for scene in (cones, spheres)), repeats=3)
        rows.append([aa, t.seconds, t.other_seconds, t.median, f"{t.low:.2f} to {t.high:.2f}"])
    title = "A thousand cones against a thousand spheres, seconds of a whole picture"
    note = (
        "Spheres are searched and intersected by Embree, cones by this project's tree in Dr.Jit; shadow rays "
        "look both up in lists around the lights, camera rays cones in lists around the eye."
    )
    study.table("thousand_cones", title, ["aa", "cones", "spheres", "ratio", "quartiles"], rows, note)


def _mesh_errors(study: Study, count: int) -> None:
    ray = _rays(count)
    exact = _exact(ray, mi.load_dict(CONE).frame())
    warm = measure({n: search({**CONE, "segments": n}, ray) for n in SEGMENTS})
    errors = {n: mesh_error(run.result, exact) for n, run in warm.items()}
    slope = -float(np.polyfit(np.log(SEGMENTS), np.log(list(errors.values())), 1)[0])
    rows = [[n, 2 * n, error, 1e3 * warm[n].seconds] for n, error in errors.items()]
    study.table("mesh_cones", f"Mesh cones, {count} rays", ["sides", "triangles", "mean error", "ms"], rows)
    why = "theory: 2, and rims and the apex; a mesh wider by a thousandth is beyond"
    study.at_most("slope of the error of a mesh cone: |exponent - 2|", abs(slope - 2), SLOPE, why)
    # The height of a chord of 2π/n over an arc of radius r is r (π/n)²/2; rays are 3 to 5 long
    chord = CONE["radius"] * (np.pi / 256) ** 2 / 2 / 3
    why = "the chord's height over the distance; half as many sides leave four times as much"
    study.at_most("mean error at 256 sides, the default", errors[256], chord, why)
    what = "rays that meet another part, or nothing, at 256 sides"
    why = "a share: silhouette, rim and apex within a chord's height, a few times 7.5e-5; a leak adds to it"
    study.at_most(what, other_hits(warm[256].result, exact), 1e-3, why)
    caption = "Both axes logarithmic; the dashed line has slope 2."
    sides, means = np.array(list(errors), float), list(errors.values())
    lines = {"mean error": (sides, means), "slope 2": (sides, means[0] * (sides / sides[0]) ** -2)}
    figure = curves(lines, "sides", "relative error of distance", dashed=["slope 2"])
    study.plot("mesh_cones", "Error of a mesh cone over its sides", figure, caption)


def mesh_error(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the mean relative error of distances [N] where both meet the cone on the same side."""
    error = _relative_error(found, exact)
    return float(np.mean(error[error < SAME_PART]))


def other_hits(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the share of all rays that meet another part of the cone, or the cone in one form only."""
    missed = np.mean(np.isfinite(found) != np.isfinite(exact))
    return float(missed + np.sum(_relative_error(found, exact) >= SAME_PART) / len(exact))


def _relative_error(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    both = np.isfinite(found) & np.isfinite(exact)
    return np.abs(found[both] / exact[both] - 1)


def search(cone: dict[str, Any], ray: Any) -> Callable[[], np.ndarray]:
    """Return a function that returns the distances [N] of rays to a mesh cone, inf for none."""
    scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "cone": cone})
    return lambda: np.array(scene.ray_intersect_preliminary(ray).t)


def _rays(count: int) -> Any:
    """Return rays from a sphere around the cone towards points near its axis."""
    rng = np.random.default_rng(3)
    o = rng.normal(size=(count, 3))
    o = 4 * o / np.linalg.norm(o, axis=1, keepdims=True) + MIDDLE
    d = MIDDLE + rng.uniform(-0.4, 0.4, size=(count, 3)) - o
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f((d / np.linalg.norm(d, axis=1, keepdims=True)).T))
    dr.eval(ray)
    return ray


def _exact(ray: Any, frame: Any) -> np.ndarray:
    """Return distances of the quadric in float64, inf for none."""
    from drjit.llvm.ad import Array3f64

    wide = Frame(Array3f64(frame.origin), *(Array3f64(row) for row in (frame.x, frame.y, frame.z)))
    return np.array(intersect_cone(Array3f64(ray.o), Array3f64(ray.d), wide).t)
