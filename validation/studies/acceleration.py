"""Mitsuba's BVH and this project's tree against a loop over all objects.

The report has this table for its kd-tree, in seconds a picture. Here it is rays per second over the number of
objects, for random rays through random spheres, so that nothing but the search for the nearest hit is timed.
The loop is also the independent check of what both structures find.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.plugins.intersect import intersect_sphere
from mrt_mitsuba.validation.tools.gallery import curves
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import measure

TITLE = "Acceleration: a BVH and a tree of boxes against a loop over all objects"

COUNTS = (10, 32, 100, 316, 1_000, 3_162, 10_000, 31_623, 100_000)
MOST_RAYS = 2**18
TESTS = 3e8  # ray-object tests of the loop in a run; with many objects it gets fewer rays
MOST_NATIVE = 10_000  # native spheres: Mitsuba loads ten thousand of them in a second
MISS = 1e30
SAME_DISTANCE = 1e-4  # of distances by formulas of other roundings, in float32, of hits that are not grazing
METHODS = {"loop": "loop over all", "tree": "tree of boxes", "bvh": "Mitsuba's BVH"}

Rates = Mapping[str, Mapping[int, float]]


def run(study: Study, *, quick: bool) -> None:
    """Time each method for each number of objects; compare what they find."""
    runtime.use(runtime.FAST)
    study.text(
        "Random rays start on a sphere around random small ones and aim at random points among them. A loop "
        "tests every sphere; Mitsuba's BVH (Embree) and this project's tree of boxes, which mrt_whitted uses "
        "for cones, cylinders and groups, test few. Seconds are medians without compilation."
    )
    counts = COUNTS[::2][:4] if quick else COUNTS
    rates: dict[str, dict[int, float]] = {name: {} for name in METHODS}
    worst = {"tree": 0.0, "bvh": 0.0}
    for count in study.each("Acceleration", counts):
        runs, rays = methods(count)
        warm = measure(runs)
        for name, result in warm.items():
            rates[name][count] = rays[name] / result.seconds
        for name in worst.keys() & warm.keys():
            worst[name] = max(worst[name], disagreement(warm[name].result, warm["loop"].result))
    rows = [
        [n, *(f"{rates[name][n] / 1e6:.3g}" if n in rates[name] else "-" for name in METHODS)] for n in counts
    ]
    study.table("rays", "Million rays a second", ["objects", *METHODS.values()], rows)
    for name, share in worst.items():
        why = "a share; grazing rays may go either way in float32. One box in a thousand lost shows"
        study.at_most(f"{METHODS[name]}: rays with another nearest hit than the loop's", share, 1e-4, why)
    for name in () if quick else ("tree", "bvh"):
        study.record(f"{name}_pays_from_objects", crossing(rates["loop"], rates[name]))
    lines = {title: (list(rates[name]), list(rates[name].values())) for name, title in METHODS.items()}
    figure = curves(lines, "objects", "rays per second")
    study.plot("rays", "Rays a second over objects", figure, "Both axes logarithmic; a loop falls as 1/n.")


def methods(count: int) -> tuple[dict[str, Callable[[], np.ndarray]], dict[str, int]]:
    """Return what to time, each a function that returns distances, and how many rays each traces.

    The spheres are random ones in the cube [−1, 1]³ that fill a hundredth of it, however many they are.
    """
    centers = np.random.default_rng(count).uniform(-1, 1, (count, 3)).astype(np.float32)
    radius = float((0.08 / count * 3 / (4 * np.pi)) ** (1 / 3))
    few = int(np.clip(TESTS / count, 4096, MOST_RAYS))
    every = _rays(MOST_RAYS)
    rays = {"loop": few, "tree": MOST_RAYS}
    runs = {"loop": _loop(centers, radius, _rays(few)), "tree": _tree(centers, radius, every)}
    if count <= MOST_NATIVE:
        nodes = {f"s{i}": {"type": "sphere", "center": c, "radius": radius}
                 for i, c in enumerate(centers.tolist())}  # fmt: skip
        scene = mi.load_dict({"type": "scene", **nodes})
        rays["bvh"] = MOST_RAYS
        runs["bvh"] = lambda: _finite(scene.ray_intersect_preliminary(every).t)
    return runs, rays


def _rays(count: int) -> Any:
    """Return the first ``count`` of a fixed sequence of rays."""
    rng = np.random.default_rng(7)
    numbers = rng.normal(size=(MOST_RAYS, 3)), rng.uniform(-1, 1, (MOST_RAYS, 3))
    origin, target = (n[:count] for n in numbers)
    origin = 3 * origin / np.linalg.norm(origin, axis=1, keepdims=True)
    d = (target - origin) / np.linalg.norm(target - origin, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(d.T), dr.opaque(mi.Float, MISS, count), 0, [])
    dr.eval(ray)
    return ray


def _loop(centers: np.ndarray, radius: float, ray: Any) -> Callable[[], np.ndarray]:

    flat = mi.Float(centers.ravel())
    count, size = dr.opaque(mi.UInt32, len(centers)), dr.opaque(mi.Float, radius)

    def step(k: Any, best: Any) -> tuple[Any, Any]:
        return k + 1, dr.minimum(best, intersect_sphere(ray.o, ray.d, dr.gather(mi.Point3f, flat, k), size))

    def trace() -> np.ndarray:
        return _finite(dr.while_loop((mi.UInt32(0), mi.Float(ray.maxt)), lambda k, best: k < count, step)[1])

    return trace


def _tree(centers: np.ndarray, radius: float, ray: Any) -> Callable[[], np.ndarray]:

    from mrt_mitsuba.plugins.quadrics import Quadrics

    numbers = np.concatenate([centers, np.full((len(centers), 1), radius, np.float32)], axis=1)
    group = mi.load_dict({"type": "mrt_group", "kind": "sphere", "numbers": mi.Bitmap(numbers)})
    quadrics = Quadrics([group])
    return lambda: _finite(quadrics.intersect(ray, mi.Bool(True))[0])


def _finite(t: Any) -> np.ndarray:
    """Return distances as numpy has them, ``MISS`` for none."""
    return np.minimum(np.array(t), np.float32(MISS))


def disagreement(found: np.ndarray, looped: np.ndarray) -> float:
    """Return the share of rays, of those that the loop traced, whose distance differs."""
    return float(np.mean(np.abs(found[: len(looped)] - looped) > SAME_DISTANCE * looped))


def crossing(loop: Mapping[int, float], other: Mapping[int, float]) -> float:
    """Return the number of objects from which the other is faster, straight in logarithms."""
    counts = sorted(loop.keys() & other.keys())
    lead = [np.log(other[n] / loop[n]) for n in counts]
    for i in range(1, len(counts)):
        if lead[i - 1] < 0 <= lead[i]:
            return float(np.exp(np.interp(0, lead[i - 1 : i + 1], np.log(counts[i - 1 : i + 1]))))
    return float(counts[0]) if lead[0] >= 0 else float("inf")
