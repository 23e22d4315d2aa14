"""With and without an acceleration structure: Mitsuba's BVH and this project's tree against a loop over all
objects.

The report has this table for its kd-tree, in seconds a picture. Here it is rays per second over the number of
objects, for random rays through random spheres, so that nothing but the search for the nearest hit is timed.
The loop is also the independent check of what both structures find.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import measure

TITLE = "Acceleration: a BVH and a tree of boxes against a loop over all objects"

COUNTS = (10, 32, 100, 316, 1_000, 3_162, 10_000, 31_623, 100_000)
MOST_RAYS = 2**18
TESTS = 3e8  # ray-object tests of the loop in a run; with many objects it gets fewer rays
MOST_NATIVE = 10_000  # native spheres: Mitsuba loads ten thousand of them in a second
MISS = 1e30

# Distances by formulas of different roundings, in float32, of hits that are not grazing
SAME_DISTANCE = 1e-4
METHODS = {"loop": "loop over all", "tree": "tree of boxes", "bvh": "Mitsuba's BVH"}


@dataclass(frozen=True)
class Spheres:
    """Random spheres in the cube [−1, 1]³ that fill a hundredth of it, however many they are."""

    centers: np.ndarray  # float32 [n, 3]
    radius: float

    @classmethod
    def of(cls, count: int) -> Spheres:
        centers = np.random.default_rng(count).uniform(-1, 1, (count, 3)).astype(np.float32)
        return cls(centers, float((0.08 / count * 3 / (4 * np.pi)) ** (1 / 3)))


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
    rows, worst = [], {"tree": 0.0, "bvh": 0.0}
    with study.stage("Acceleration", len(counts)) as advance:
        for count in counts:
            runs, rays = _methods(Spheres.of(count))
            warm = measure(runs)
            for name, result in warm.items():
                rates[name][count] = rays[name] / result.seconds
            for name in worst.keys() & warm.keys():
                worst[name] = max(worst[name], _disagreement(warm[name].result, warm["loop"].result))
            rows.append([count, *(_rate(rates[name].get(count)) for name in METHODS)])
            advance(1)
    study.table("rays", "Million rays a second", ["objects", *METHODS.values()], rows)
    for name in worst:
        title = f"{METHODS[name]}: rays with another nearest hit than the loop's"
        study.at_most(title, worst[name], 1e-4, "a share; grazing rays may go either way in float32")
    for name in ("tree", "bvh"):
        study.record(f"{name}_pays_from_objects", _crossing(rates["loop"], rates[name]))
    largest = max(rates["tree"])
    gain = rates["tree"][largest] / rates["loop"][largest]
    study.at_least(
        f"gain of the tree over the loop at {largest} objects", gain, 10.0, "times; a broken tree gains none"
    )
    study.plot(
        "rays", "Rays a second over objects", _figure(rates), "Both axes logarithmic; a loop falls as 1/n."
    )


def _methods(spheres: Spheres) -> tuple[dict[str, Callable[[], np.ndarray]], dict[str, int]]:
    """What to time, each a function that returns distances, and how many rays each traces."""
    import mitsuba as mi

    count = len(spheres.centers)
    few = int(np.clip(TESTS / count, 4096, MOST_RAYS))
    rays = {"loop": few, "tree": MOST_RAYS}
    runs = {"loop": _loop(spheres, _rays(few)), "tree": _tree(spheres, _rays(MOST_RAYS))}
    if count <= MOST_NATIVE:
        nodes = {f"s{i}": {"type": "sphere", "center": c, "radius": spheres.radius}
                 for i, c in enumerate(spheres.centers.tolist())}  # fmt: skip
        scene, ray = mi.load_dict({"type": "scene", **nodes}), _rays(MOST_RAYS)
        rays["bvh"] = MOST_RAYS
        runs["bvh"] = lambda: _finite(scene.ray_intersect_preliminary(ray).t)
    return runs, rays


def _rays(count: int) -> Any:
    """The first ``count`` of a fixed sequence of rays."""
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(7)
    numbers = rng.normal(size=(MOST_RAYS, 3)), rng.uniform(-1, 1, (MOST_RAYS, 3))
    origin, target = (n[:count] for n in numbers)
    origin = 3 * origin / np.linalg.norm(origin, axis=1, keepdims=True)
    d = (target - origin) / np.linalg.norm(target - origin, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(d.T), dr.opaque(mi.Float, MISS, count), 0, [])
    dr.eval(ray)
    return ray


def _loop(spheres: Spheres, ray: Any) -> Callable[[], np.ndarray]:
    import drjit as dr
    import mitsuba as mi

    from mrt_mitsuba.plugins.intersect import intersect_sphere

    centers = mi.Float(spheres.centers.ravel())
    count, radius = dr.opaque(mi.UInt32, len(spheres.centers)), dr.opaque(mi.Float, spheres.radius)

    def step(k: Any, best: Any) -> tuple[Any, Any]:
        t = intersect_sphere(ray.o, ray.d, dr.gather(mi.Point3f, centers, k), radius)
        return k + 1, dr.minimum(best, t)

    def trace() -> np.ndarray:
        return _finite(dr.while_loop((mi.UInt32(0), mi.Float(ray.maxt)), lambda k, best: k < count, step)[1])

    return trace


def _tree(spheres: Spheres, ray: Any) -> Callable[[], np.ndarray]:
    import mitsuba as mi

    from mrt_mitsuba.plugins.quadrics import Quadrics

    radii = np.full((len(spheres.centers), 1), spheres.radius, np.float32)
    numbers = np.concatenate([spheres.centers, radii], axis=1)
    quadrics = Quadrics(
        [mi.load_dict({"type": "mrt_group", "kind": "sphere", "numbers": mi.Bitmap(numbers)})]
    )
    return lambda: _finite(quadrics.intersect(ray, mi.Bool(True))[0])


def _finite(t: Any) -> np.ndarray:
    """Distances as numpy has them, ``MISS`` for none."""
    return np.minimum(np.array(t), np.float32(MISS))


def _disagreement(found: np.ndarray, looped: np.ndarray) -> float:
    """The share of rays, of those that the loop traced, whose distance differs."""
    found = found[: len(looped)]
    return float(np.mean(np.abs(found - looped) > SAME_DISTANCE * looped))


def _rate(rays_per_second: float | None) -> str:
    return "-" if rays_per_second is None else f"{rays_per_second / 1e6:.3g}"


def _crossing(loop: dict[int, float], other: dict[int, float]) -> float:
    """The number of objects from which the other is faster; between measured ones, lines in logarithms."""
    counts = sorted(loop.keys() & other.keys())
    lead = [np.log(other[n] / loop[n]) for n in counts]
    for (few, before), (many, after) in zip(
        zip(counts, lead, strict=True), zip(counts[1:], lead[1:], strict=True), strict=False
    ):
        if before < 0 <= after:
            return float(np.exp(np.interp(0, [before, after], np.log([few, many]))))
    return float(counts[0]) if lead[0] >= 0 else float("inf")


def _figure(rates: dict[str, dict[int, float]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, title in METHODS.items():
        axes.loglog(list(rates[name]), list(rates[name].values()), "o-", label=title)
    axes.set(xlabel="objects", ylabel="rays per second")
    axes.legend()
    return figure
