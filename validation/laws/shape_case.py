"""A shape under test, rays towards it and what they meet."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import mitsuba as mi
import numpy as np
from numpy.linalg import norm

from .case import Case, Given, class_name
from .law import MIN_QUANTILE_ERRORS, Skip, UsageError
from .noise import ROUNDING
from .probe import (
    Array,
    Lanes,
    corners,
    lanes,
    named,
    unit,
)

SPAWN_OFFSET = 1500 * ROUNDING  # of the origin of a spawned ray from its surface, over 1 + max |p|
GRAZING_COSINE = 0.05  # cosine below which a ray grazes: what it meets hangs on roundings
MAX_CROSSINGS = 16  # along a line
MAX_HIT_ROUNDINGS = 64  # of the largest number in a ray: some dozen operations
MAX_MEDIAN_ROUNDINGS = 16  # roundings: twice the most that was measured of sound shapes
FAR_DISTANCE = 1e4  # sizes away
UNSCALED = ("BSplineCurve", "LinearCurve", "Ellipsoids", "EllipsoidsMesh")  # to_world leaves their radii
SMOOTHED = ("SDFGrid", "BSplineCurve", "LinearCurve")

RAY = """si = scene.ray_intersect(mi.Ray3f(o, d))
print(si)
back = scene.ray_intersect(mi.Ray3f(si.spawn_ray(d).o, -d))
print("from just behind:", back.n, "at", back.t)
"""


def trace(target: mi.Scene, o: Array, d: Array) -> Lanes:
    """Trace rays from points [N, 3] in directions [N, 3], both rounded to float32.

    The hits have the rays themselves (``o``, ``d``), whether a ray met anything (``met``), the distance
    ``t``, the points and vectors ``p``, ``n``, ``shading``, ``du``, ``dv`` [N, 3], ``uv`` [N, 2], the index
    of the triangle or the like (``part``), the cosine with the normal (``cos``), whether the surface is
    ``steep``: met, and not in passing; and whether a ray is ``clear``: it does not graze.
    """

    def call(origin: mi.Point3f, direction: mi.Vector3f) -> list[mi.Float]:
        si = target.ray_intersect(mi.Ray3f(origin, direction))
        return [si.is_valid(), si.t, si.p, si.n, si.sh_frame.n, si.dp_du, si.dp_dv, si.uv, si.prim_index]

    ray = Lanes(o=np.float32(o), d=np.float32(d))
    found = lanes(call, ("Point3f", ray.o), ("Vector3f", ray.d))
    hits = named("met t p n shading du dv uv part", found).having(**vars(ray))
    hits.cos = dot(hits.n, hits.d)
    hits.steep = hits.met & (abs(hits.cos) > GRAZING_COSINE)
    hits.clear = hits.steep | ~hits.met
    return hits


def dot(a: Array, b: Array) -> Array:
    """The dot products of vectors [N, 3]."""
    return (a * b).sum(axis=-1)


def walk(target: mi.Scene, hits: Lanes) -> Iterator[tuple[Array, Lanes]]:
    """Follow N lines on from their first hits; yield hit by hit which lines meet something, and what."""
    line = np.arange(len(hits.t))
    for _ in range(MAX_CROSSINGS):
        line = line[hits.met]
        hits = hits[hits.met]
        if not len(line):
            return
        yield line, hits
        hits = trace(target, leave(hits, hits.d), hits.d)


def alone(shape: mi.Shape) -> mi.Scene:
    """A scene with one shape, which keeps its id."""
    name = shape.id()
    scene = mi.load_dict({"type": "scene", "shape": shape})
    shape.set_id(name)
    return scene


# a sphere around a box, from 1.5 times its diagonal away: the sine of its half angle is a third
COSINE = float(np.sqrt(1 - 1 / 9))
CONE = 2 * np.pi * (1 - COSINE)  # its solid angle


class View:
    """Points all around a box [2, 3], and the cones from them that hold it."""

    def __init__(self, box: Array) -> None:
        self.middle = box.mean(axis=0)
        self.size = float(norm(box[1] - box[0]))

    def around(self, case: Case, count: int) -> Array:
        """Points that look at the box, from 1.5 sizes away. [count, 3]"""
        return np.float32(self.middle + 1.5 * self.size * case.units(count))

    def into_cone(self, o: Array, rng: np.random.Generator) -> Array:
        """Uniform directions from points [N, 3] into the cone that holds the box. [N, 3]"""

        def direction(axis: mi.Vector3f, u: mi.Point2f) -> mi.Vector3f:
            return mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(u, COSINE))

        u = rng.random((len(o), 2), np.float32)
        return lanes(direction, ("Vector3f", unit(self.middle - o)), ("Point2f", u))[0]


class ShapeCase(Case):
    """A shape under test, rays towards it and what they meet."""

    word = "shape"

    def __init__(self, given: Given, quick: bool, seed: int) -> None:
        super().__init__(given, quick, seed)
        fits = [hasattr(self.plugin, name) for name in ("ray_intersect", "ray_test", "bbox")]
        self.need("a shape", all(fits))
        self.target = self.plugin
        if class_name(self.plugin) == "Instance":
            raise UsageError("an instance has no surface of its own: check the shapes of its group")
        if isinstance(self.plugin, mi.Shape):
            self.target = alone(self.plugin)
        self.box = corners(self.plugin)
        if not np.isfinite(self.box).all() or (self.box[1] < self.box[0]).any():
            raise UsageError(f"the bounding box of the shape is {self.box}: it must be finite")
        self.points = self.box  # and of a mesh the vertices
        params = mi.traverse(self.plugin) if isinstance(self.plugin, mi.Mesh) else {}
        if "vertex_positions" in params:  # a rectangle hides that it is a mesh
            self.points = np.concatenate([self.box, np.array(params["vertex_positions"]).reshape(-1, 3)])
        self.low = self.points.min(axis=0)  # the box itself may be wrong
        self.high = self.points.max(axis=0)
        self.view = View(np.array([self.low, self.high]))
        self.middle = self.view.middle
        self.size = self.view.size
        self.extent = np.maximum(self.high - self.low, 0.01 * self.size)

    def around(self, count: int) -> Array:
        """Points that look at the shape. [count, 3]"""
        return self.view.around(self, count)

    @cached_property
    def seen(self) -> Lanes:
        """Rays from all around to points in the box, and what they meet."""
        return self.towards(self.count(2**14, 2**17))

    def towards(self, count: int) -> Lanes:
        """The hits of random rays from all around to points in the box."""
        o = self.around(count)
        d = unit(self.middle + self.extent * self.rng.uniform(-0.55, 0.55, o.shape) - o)
        return trace(self.target, o, d)

    @cached_property
    def met(self) -> Lanes:
        """The rays that meet the surface and do not graze it, and their hits."""
        steep = self.seen.steep
        if steep.sum() < MIN_QUANTILE_ERRORS:
            raise Skip("hardly any ray towards its bounding box meets the shape")
        return self.seen[steep]

    @cached_property
    def behind(self) -> Lanes:
        """The hits of rays that come back from just behind ``met``."""
        d = self.met.d
        return trace(self.target, leave(self.met, d), -d)

    @cached_property
    def positions(self) -> tuple[Lanes, float]:
        """Sampled positions ``p`` with ``n``, ``pdf`` as stated and ``again`` as asked for; and the area."""
        u = self.uniform(self.count(2**16, 2**19), 2)

        def sample(second: mi.Point2f) -> list[mi.Float]:
            ps = self.plugin.sample_position(0, second)
            return [ps.p, ps.n, ps.pdf, self.plugin.pdf_position(ps)]

        try:
            area = float(np.ravel(np.array(self.plugin.surface_area()))[0])
            return named("p n pdf again", lanes(sample, ("Point2f", u))), area
        except (AttributeError, RuntimeError) as problem:
            raise Skip("positions cannot be sampled") from problem

    @cached_property
    def crossings(self) -> list[tuple[Array, Lanes]]:
        """Whole lines: hit by hit, which line, and what it meets."""
        return list(walk(self.target, self.seen))

    @cached_property
    def closed(self) -> bool:
        """True if most lines cross the surface an even number of times: closed, perhaps with holes."""
        judged, even = self.lines
        return bool(judged.sum() > MIN_QUANTILE_ERRORS and even[judged].mean() > 0.75)

    @cached_property
    def lines(self) -> tuple[Array, Array]:
        """Masks of lines that can be judged, and that cross the surface an even number of times. [N], [N]"""
        clear = self.seen.met.copy()
        even = np.ones(len(clear), bool)
        last = np.full((len(clear), 3), np.inf)
        for line, hits in self.crossings:
            clear[line] &= (abs(hits.cos) > 4 * GRAZING_COSINE) & ~near(hits.p, last[line])
            even[line] ^= True
            last[line] = hits.p
        return clear, even


def offset(p: Array) -> Array:
    """Offset of the origins of ``spawn_ray`` at points [N, 3]."""
    return SPAWN_OFFSET * (1 + abs(p).max(axis=1))


def near(p: Array, q: Array) -> Array:
    """True where points [N, 3] coincide within the offset of spawned rays. [N]"""
    return norm(p - q, axis=1) < 4 * offset(p)


def leave(hits: Lanes, d: Array) -> Array:
    """Origins [N, 3] off points ``p`` with normals ``n``, on the side of ``d``, as ``spawn_ray`` has them."""
    outwards = np.sign(dot(hits.n, d))[:, None] * hits.n
    return hits.p + outwards * offset(hits.p)[:, None]
