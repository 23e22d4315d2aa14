"""A second truth: the report's ray tracer in plain NumPy and float64, every ray against every object.

Nothing is shared with the plugins, nor with Dr.Jit or Mitsuba: the formulas are written from the papers, in
other forms where there are any, and the geometry is its own. Slow, and small enough to be read.

* Walter et al. 2007, "Microfacet models for refraction through rough surfaces": D (eq. 25), G₁ (eq. 27), and
  the Fresnel reflectance in Cook and Torrance's form (eq. 22).
* Schlick 1994, "An inexpensive BRDF model for physically-based rendering": eq. 15.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Mesh, Plane, Scene, Sphere

# Robust secondary rays start this far off the surface, relative to the coordinates and distances that led to
# the point: far above the rounding of float64, far below anything a float32 picture can show
OFFSET = 1e-10
# The original's absolute constants
ORIGINAL_SHADOW_START, ORIGINAL_MIRROR_START, ORIGINAL_REACH = 1e-4, 1e-3, 1e5
BATCH = 2**20  # pairs of a ray and an object at a time
HASH = np.uint64(0x9E3779B97F4A7C15)  # odd, so that no step of the hash loses information


class ReferenceResult(NamedTuple):
    """A picture in linear RGB, top row first, and what the ray through each pixel met.

    ``path`` and ``lights`` are hashes of decisions. Two renders of a scene have the same ``path`` in a pixel
    if all rays met the same objects in the same order, and the same ``lights`` if at each of them the same
    lights were in front, and of these the same in sight.
    """

    image: np.ndarray  # float64 [H, W, 3]
    depth: np.ndarray  # float64 [H, W], distance from the camera; inf where nothing was hit
    object_id: np.ndarray  # int [H, W], in (*spheres, *planes, *cones, *cylinders, *meshes); -1: nothing
    normal: np.ndarray  # float64 [H, W, 3], unit; 0 where nothing was hit
    path: np.ndarray  # uint64 [H, W]
    lights: np.ndarray  # uint64 [H, W]


def reference_render(
    scene: Scene, *, width: int, height: int, displacement: Sequence[float] = (0, 0), **settings: Any
) -> ReferenceResult:
    """Render a scene with one ray through each pixel, exactly but for the rounding of float64.

    ``displacement``: of the rays, in pixels, y upwards. ``settings``: ``fresnel`` ("dielectric", "schlick" or
    "unity"), ``clamp``, ``max_depth``, ``bounce_budget`` ("report" or "plain"), and ``start`` of secondary
    rays ("robust", or "original": that program's distances and reach). Raises ``SceneError`` for a
    texture on anything but triangles, and for one that is not looked up as in the report.
    """
    pixel = np.arange(width * height)
    x, y = pixel % width + 0.5 + displacement[0], pixel // width + 0.5 + displacement[1]
    d = camera_directions(scene.camera, width, height, x, y)
    o = np.broadcast_to(np.array(scene.camera.position, float), d.shape)
    with np.errstate(all="ignore"):
        layers = _Tracer(scene, **settings).film(o, d)
    # The first row is the lowest
    return ReferenceResult(*(layer.reshape(height, width, *layer.shape[1:])[::-1] for layer in layers))


class Sensitivity(NamedTuple):
    """The changes in a pixel when its ray is moved by a small part of a pixel; all [H, W].

    Every pixel is of at most one kind: ``silhouette`` where the rays meet other objects, else ``shadow``
    where a light appears or vanishes (the edge of a shadow, or a terminator). ``spread`` is the largest
    difference in a channel.
    """

    reference: ReferenceResult
    silhouette: np.ndarray  # bool
    shadow: np.ndarray  # bool
    spread: np.ndarray  # float64


def sensitivity(scene: Scene, *, displacement: float = 1e-2, **settings: Any) -> Sensitivity:
    """Compare the reference with four displaced by ``displacement`` pixels, left, right, down and up.

    ``settings`` are those of ``reference_render``.
    """
    steps = [(displacement, 0), (-displacement, 0), (0, displacement), (0, -displacement)]
    reference = reference_render(scene, **settings)
    others = [reference_render(scene, displacement=step, **settings) for step in steps]
    silhouette = np.any([other.path != reference.path for other in others], axis=0)
    shadow = np.any([other.lights != reference.lights for other in others], axis=0) & ~silhouette
    spread = np.max([np.abs(other.image - reference.image).max(axis=-1) for other in others], axis=0)
    return Sensitivity(reference, silhouette, shadow, spread)


def camera_directions(camera: Camera, width: int, height: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return unit directions [N, 3] through the points (x, y) of the picture, in pixels from its lower left.

    The column grows along up × forward: mirrored against a right-handed camera, as in the original.
    """
    forward = unit(np.subtract(camera.target, camera.position))
    right = unit(np.cross(camera.up, forward))
    half_width = math.tan(math.radians(camera.hfov) / 2)
    u, v = (2 * x - width) / width * half_width, (2 * y - height) / width * half_width
    return unit(forward + u[:, None] * right + v[:, None] * np.cross(forward, right))


def unit(v: np.ndarray) -> np.ndarray:
    """Return vectors [..., 3] made one unit long."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the scalar products of vectors [..., 3]."""
    return np.einsum("...i,...i->...", a, b)


# ------------------------------------------------ Reflectance ----------------------------------------------


def fresnel(form: str, cos: np.ndarray, ior: np.ndarray) -> np.ndarray:
    """Return the reflectance for a cosine of incidence in [0, 1], from outside of index 1."""
    if form == "unity":
        return np.ones_like(cos)
    if form == "schlick":
        at_normal = np.square((ior - 1) / (ior + 1))
        return at_normal + (1 - at_normal) * (1 - cos) ** 5
    g2 = ior**2 - 1 + cos**2
    g = np.sqrt(np.maximum(g2, 0))
    ratio = (cos * (g + cos) - 1) / (cos * (g - cos) + 1)
    return np.where(g2 < 0, 1.0, 0.5 * ((g - cos) / (g + cos)) ** 2 * (1 + ratio**2))


def specular_lobe(n: np.ndarray, to_light: np.ndarray, to_eye: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return D G / (4 cos cos) for unit vectors above the surface."""
    h = unit(to_light + to_eye)
    cos2, sin2 = dot(n, h) ** 2, np.square(np.cross(n, h)).sum(axis=-1)
    lobe = np.exp(-sin2 / cos2 / alpha**2) / (math.pi * alpha**2 * cos2**2)
    for way in (to_light, to_eye):
        a = np.minimum(dot(n, way) / (alpha * np.linalg.norm(np.cross(n, way), axis=-1)), 1.6)
        fit = a * (3.535 + 2.181 * a) / (1 + a * (2.276 + 2.577 * a))
        lobe = lobe * np.where(a < 1.6, fit, 1.0)
    return lobe / (4 * dot(n, to_light) * dot(n, to_eye))


# ------------------------------------------------- Objects -------------------------------------------------


class Spheres:
    """Spheres as rows of numbers, and where rays meet them; ``extent``: the largest of their numbers."""

    def __init__(self, things: Sequence[Sphere]) -> None:
        self.center = np.array([s.center for s in things], float)
        self.radius = np.array([s.radius for s in things], float)
        self.extent = np.abs(self.center).max(axis=1) + self.radius

    def distances(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return [N, objects]: how far along the unit directions [N, 3] each is; inf where it is missed."""
        passed = d @ self.center.T - dot(o, d)[:, None]
        away2 = dot(o, o)[:, None] - 2 * o @ self.center.T + dot(self.center, self.center)
        half = np.sqrt(self.radius**2 - away2 + passed**2)
        return _first_ahead(passed - half, passed + half)

    def normals(self, p: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return unit normals [N, 3] at points on the objects k [N]."""
        return unit(p - self.center[k])


class Planes:
    """Planes, as ``Spheres`` are."""

    def __init__(self, things: Sequence[Plane]) -> None:
        self.normal = unit(np.array([p.normal for p in things], float))
        self.extent = self.distance = np.array([p.distance for p in things], float)

    def distances(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        return _first_ahead(-(o @ self.normal.T + self.distance) / (d @ self.normal.T))

    def normals(self, p: np.ndarray, k: np.ndarray) -> np.ndarray:
        return self.normal[k]


class Axial:
    """Closed cones (from the apex to the base) and cylinders (from p0 to p1), as ``Spheres`` are.

    At the height h above the first end the radius is ``start + slope h``.
    """

    def __init__(self, things: Sequence[Cone | Cylinder]) -> None:
        self.cone = np.array([isinstance(t, Cone) for t in things])
        ends = [(t.apex, t.base_center) if isinstance(t, Cone) else (t.p0, t.p1) for t in things]
        self.end, other = np.array(ends, float).swapaxes(0, 1)
        self.length = np.linalg.norm(other - self.end, axis=1)
        self.axis = unit(other - self.end)
        self.radius = np.array([t.radius for t in things], float)
        self.start = np.where(self.cone, 0, self.radius)
        self.slope = (self.radius - self.start) / self.length
        self.extent = np.abs([self.end, other]).max(axis=(0, 2)) + self.radius

    def distances(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        off = o[:, None] - self.end
        passed = -np.einsum("nki,ni->nk", off, d)  # from where the ray is nearest to the first end
        off = off + passed[..., None] * d[:, None]
        height, rise = dot(off, self.axis), d @ self.axis.T
        across, drift = off - height[..., None] * self.axis, d[:, None] - rise[..., None] * self.axis
        wide, widening = self.start + self.slope * height, self.slope * rise
        # |across + t drift|² = (wide + t widening)²
        a, b = dot(drift, drift) - widening**2, dot(across, drift) - wide * widening
        c = dot(across, across) - wide**2
        larger = -(b + np.copysign(np.sqrt(b * b - a * c), b))
        side = np.stack([larger / a, c / larger])
        h = height + side * rise
        side = np.where((h >= 0) & (h <= self.length), side, np.nan)
        discs = np.stack([-height / rise, (self.length - height) / rise])
        off = across + discs[..., None] * drift
        on_disc = dot(off, off) <= self.radius**2
        on_disc[0] &= ~self.cone
        return _first_ahead(*(passed + side), *(passed + np.where(on_disc, discs, np.nan)))

    def normals(self, p: np.ndarray, k: np.ndarray) -> np.ndarray:
        axis, length = self.axis[k], self.length[k]
        height = dot(p - self.end[k], axis)
        across = p - self.end[k] - height[:, None] * axis
        radius = np.linalg.norm(across, axis=1)
        side = across / radius[:, None] - self.slope[k][:, None] * axis
        off = [np.abs(radius - self.start[k] - self.slope[k] * height), np.abs(height - length)]
        off.append(np.where(self.cone[k], np.inf, np.abs(height)))
        part = np.argmin(off, axis=0)
        return unit(np.choose(part[:, None], [side, axis, -axis]))


class Triangles:
    """The triangles of a mesh, as ``Spheres`` are."""

    def __init__(self, mesh: Mesh) -> None:
        corners = np.asarray(mesh.vertices, float)[mesh.faces]
        self.corner, self.edges = corners[:, 0], (corners[:, 1:] - corners[:, :1]).swapaxes(0, 1)
        self.normal = unit(np.cross(*self.edges))
        self.extent = np.abs(corners).max(axis=(1, 2))
        self.picture: Any = None  # [rows, columns, 3], as stored
        if mesh.material.texture:
            with Image.open(str(mesh.material.texture)) as picture:
                self.picture = np.asarray(picture.convert("RGB")) / 255
            self.uv = np.asarray(mesh.uvs, float)[mesh.faces]

    def distances(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        first, second = self.edges
        moment, whole = np.cross(o, d), np.cross(first, second)
        scale = -1 / (d @ whole.T)
        u = (moment @ second.T - d @ np.cross(second, self.corner).T) * scale
        v = -(moment @ first.T + d @ np.cross(self.corner, first).T) * scale
        t = (o @ whole.T - dot(whole, self.corner)) * scale
        return _first_ahead(np.where((u >= 0) & (v >= 0) & (u + v <= 1), t, np.nan))

    def normals(self, p: np.ndarray, k: np.ndarray) -> np.ndarray:
        return self.normal[k]

    def texels(self, p: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the colours [N, 3] of the texels nearest to points on the triangles k."""
        first, second = self.edges[:, k]
        off, whole = p - self.corner[k], np.cross(first, second)
        area = dot(whole, whole)
        weights = [dot(np.cross(off, second), whole) / area, dot(np.cross(first, off), whole) / area]
        shares = np.stack([1 - sum(weights), *weights], axis=1)
        u, v = np.clip(np.einsum("nc,nci->in", shares, self.uv[k]), 0, 1)
        rows, columns = self.picture.shape[:2]
        row, column = (v * (rows - 1) + 0.5).astype(int), (u * (columns - 1) + 0.5).astype(int)
        return self.picture[row % rows, column % columns]


def _first_ahead(*distances: np.ndarray) -> np.ndarray:
    return np.min([np.where(t > 0, t, np.inf) for t in distances], axis=0)


# ------------------------------------------------- Tracing -------------------------------------------------


class _Hits(NamedTuple):
    """N rays that met something: where, on what, and from where."""

    pixel: np.ndarray  # [N]
    d: np.ndarray  # [N, 3], of the ray
    throughput: np.ndarray  # [N, 3]
    budget: np.ndarray  # [N], of bounces, spent
    t: np.ndarray  # [N]
    thing: np.ndarray  # [N], number of the object
    p: np.ndarray  # [N, 3]
    n: np.ndarray  # [N, 3]
    scale: np.ndarray  # [N], size of the numbers that p was computed from
    diffuse: np.ndarray  # [N, 3]

    def only(self, keep: np.ndarray) -> _Hits:
        return _Hits(*(values[keep] for values in self))


class _Tracer:
    def __init__(
        self,
        scene: Scene,
        *,
        fresnel: str = "dielectric",
        clamp: bool = True,
        max_depth: int = 10,
        bounce_budget: str = "report",
        start: str = "robust",
    ) -> None:
        self.scene, self.fresnel, self.clamp, self.start = scene, fresnel, clamp, start
        self.max_depth, self.bounce_budget = max_depth, bounce_budget
        axial = (*scene.cones, *scene.cylinders)
        self.things: list[Any] = [*scene.spheres, *scene.planes, *axial, *scene.meshes]
        for thing in self.things:
            drawn = isinstance(thing, Mesh) and thing.uvs is not None and scene.texturing == "report"
            if thing.material.texture and not drawn:
                raise SceneError("float64 draws textures on triangles only, looked up as in the report")
        # Objects of a kind, each with its number; all triangles of a mesh are one object
        self.groups: list[tuple[Any, np.ndarray]] = []
        first = 0
        for kind, members in ((Spheres, scene.spheres), (Planes, scene.planes), (Axial, axial)):
            if members:
                self.groups.append((kind(members), first + np.arange(len(members))))  # type: ignore[arg-type]
            first += len(members)
        self.groups += [(Triangles(m), np.full(len(m.faces), i)) for i, m in enumerate(scene.meshes, first)]

    def of_material(self, name: str, things: np.ndarray) -> np.ndarray:
        """Return a parameter of the materials of objects [N]."""
        return np.array([getattr(thing.material, name) for thing in self.things], float)[things]

    def film(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the layers of ``ReferenceResult`` for rays, in their order."""
        count = len(o)
        image, normal = np.zeros((2, count, 3))
        depth, object_id = np.full(count, np.inf), np.full(count, -1)
        path, lights = np.ones((2, count), np.uint64)
        pixel, throughput, budget = np.arange(count), np.ones((count, 3)), np.zeros(count, int)
        for bounce in range(self.max_depth):
            met = self.hits(pixel, o, d, throughput, budget)
            path[pixel] = _mix(path[pixel], met.thing)
            missed = met.thing < 0
            image[pixel[missed]] += throughput[missed] * np.array(self.scene.sky)
            hits = met.only(~missed)
            if missed.all():
                break
            if bounce == 0:
                depth[hits.pixel], object_id[hits.pixel], normal[hits.pixel] = hits.t, hits.thing, hits.n
            radiance, seen = self.direct(hits)
            image[hits.pixel] += hits.throughput * radiance
            lights[hits.pixel] = _mix(lights[hits.pixel], seen)
            pixel, o, d, throughput, budget = self.reflected(hits)
        return image, depth, object_id, normal, path, lights

    def nearest(self, o: np.ndarray, d: np.ndarray, reach: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return of each ray's first object within reach: distance, group (-1 for none), and row in it."""
        t = np.broadcast_to(reach, len(o)).copy()
        group, row = np.full(len(o), -1), np.zeros(len(o), int)
        for g, (shapes, numbers) in enumerate(self.groups):
            step = max(1, BATCH // len(numbers))
            for start in range(0, len(o), step):
                part = slice(start, start + step)
                found = shapes.distances(o[part], d[part])
                k = found.argmin(axis=1)
                closest = found[np.arange(len(k)), k]
                closer = start + np.flatnonzero(closest < t[part])
                t[closer], group[closer], row[closer] = closest[closer - start], g, k[closer - start]
        return t, group, row

    def hits(self, pixel: Any, o: Any, d: Any, throughput: Any, budget: Any) -> _Hits:
        """Return what rays meet; the number of the object is -1 where that is nothing."""
        t, group, row = self.nearest(o, d, ORIGINAL_REACH if self.start == "original" else np.inf)
        p = o + np.where(group >= 0, t, 0)[:, None] * d
        n, thing, extent = np.zeros_like(p), np.full(len(p), -1), np.zeros(len(p))
        diffuse = np.zeros_like(p)
        for g, (shapes, numbers) in enumerate(self.groups):
            here = np.flatnonzero(group == g)
            k = row[here]
            thing[here], extent[here], n[here] = (
                numbers[k],
                np.abs(shapes.extent[k]),
                shapes.normals(p[here], k),
            )
            textured = isinstance(shapes, Triangles) and shapes.picture is not None
            diffuse[here] = (
                shapes.texels(p[here], k) if textured else self.of_material("diffuse", thing[here])
            )
        scale = np.abs(o).max(axis=1) + t + extent
        return _Hits(pixel, d, throughput, budget, t, thing, p, n, scale, diffuse)

    def direct(self, hits: _Hits) -> tuple[np.ndarray, np.ndarray]:
        """Return the light sent back along the rays, and a code of which lights are seen."""
        radiance, seen = np.zeros_like(hits.p), np.zeros(len(hits.p), int)
        for light in self.scene.lights:
            position = np.array(light.position)
            cos = dot(hits.n, unit(position - hits.p))
            facing = np.flatnonzero((cos > 0) & (dot(hits.n, hits.d) < 0))
            before = hits.only(facing)
            o = self.lifted(before, unit(position - before.p), ORIGINAL_SHADOW_START)
            way = position - o
            lit = facing[self.nearest(o, unit(way), np.linalg.norm(way, axis=1))[1] < 0]
            seen *= 3
            seen[facing] += 1
            seen[lit] += 1
            value = self.reflectance(hits.only(lit), position) * cos[lit, None] * light.color
            radiance[lit] += np.clip(value, 0, 1) if self.clamp else value
        return radiance, seen

    def lifted(self, hits: _Hits, d: np.ndarray, original: float) -> np.ndarray:
        """Return where rays that leave in the directions d start."""
        if self.start == "original":
            return hits.p + original * d
        return hits.p + (OFFSET * hits.scale)[:, None] * hits.n

    def reflectance(self, hits: _Hits, light: np.ndarray) -> np.ndarray:
        """Return the BSDF [N, 3] for light from a point; both directions are above the surface."""
        to_light = unit(light - hits.p)
        lobe = specular_lobe(hits.n, to_light, -hits.d, self.of_material("alpha", hits.thing))
        cos = dot(unit(to_light - hits.d), to_light)
        lobe = lobe * fresnel(self.fresnel, cos, self.of_material("ior", hits.thing))
        # The G₁ of a negative roughness can be negative; light cannot
        specular = self.of_material("specular", hits.thing) * lobe[:, None]
        return np.maximum(hits.diffuse / math.pi + specular, 0)

    def reflected(self, hits: _Hits) -> tuple[np.ndarray, ...]:
        """Return the mirror rays that go on: pixel, o, d, throughput, budget spent."""
        ior, cos = self.of_material("ior", hits.thing), -dot(hits.n, hits.d)
        d = unit(hits.d + 2 * cos[:, None] * hits.n)
        o = self.lifted(hits, d, ORIGINAL_MIRROR_START)
        mirrored = self.of_material("specular", hits.thing) * fresnel(self.fresnel, cos, ior)[:, None]
        throughput = hits.throughput * mirrored
        cost = 1 if self.bounce_budget == "plain" else np.maximum(1, 10 - (10 * ior).astype(int))
        budget = hits.budget + cost
        on = (cos > 0) & (budget < self.max_depth) & (throughput != 0).any(axis=1)
        return hits.pixel[on], o[on], d[on], throughput[on], budget[on]


def _mix(hashed: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Continue a hash by one more number."""
    return (hashed ^ (value + 2).astype(np.uint64)) * HASH
