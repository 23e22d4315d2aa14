"""The report's ray tracer in float64, by brute force, as the truth for the float32 renders.

Independent of Mitsuba: own camera, every ray against every object, no acceleration structure, no float32.
Shared with the plugins are only the pure functions of ``plugins/fresnel.py``, ``microfacet.py`` and
``intersect.py``, which the unit tests hold against 50-digit values.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import numpy as np

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.plugins.fresnel import f0_from_ior, fresnel_dielectric, fresnel_schlick
from mrt_mitsuba.plugins.intersect import (
    Frame,
    SurfaceHit,
    SurfacePoint,
    cone_frame,
    cone_surface,
    cylinder_frame,
    cylinder_surface,
    intersect_cone,
    intersect_cylinder,
    intersect_plane,
    intersect_sphere,
)
from mrt_mitsuba.plugins.microfacet import half_vector_angles, microfacet_specular, tan2_theta
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Plane, Scene, Sphere, Vector
from mrt_mitsuba.validation.tools.arrays import Backend, Vector3, backend, numbers

CHOICES = {
    "lattice": ("report", "centered"),
    "fresnel": ("dielectric", "schlick", "unity"),
    "bounce_budget": ("report", "plain"),
    "self_intersection": ("robust", "original"),
}

# Robust secondary rays start this far off the surface, relative to the coordinates and distances that led to
# the point: far above the rounding of float64, far below anything a float32 picture can show
OFFSET = 1e-10

# The original's absolute constants
ORIGINAL_SHADOW_START, ORIGINAL_MIRROR_START, ORIGINAL_REACH = 1e-4, 1e-3, 1e5

# With LLVM, objects per kernel: few kernels, and short enough to compile at once
OBJECTS_PER_KERNEL = 32

_HASH = np.uint64(0x9E3779B97F4A7C15)  # odd, so that no step of the hash loses information


@dataclass(frozen=True)
class ReferenceResult:
    """A picture in linear RGB, top row first, and what the first sample of each pixel met.

    ``path`` and ``lights`` are hashes of decisions. Two renders of a scene have the same ``path`` in a pixel
    if all rays met the same objects in the same order, and the same ``lights`` if at each of them the same
    lights were in front, and of these the same in sight. ``terminator`` is the smallest |cos| of the angle
    between a normal and a light, over all that the sample met: near 0, whether the light reaches the surface
    hangs on rounding.
    """

    image: np.ndarray  # float64 [H, W, 3]
    depth: np.ndarray  # float64 [H, W], distance from the camera; inf where nothing was hit
    object_id: np.ndarray  # int32 [H, W], index in (*spheres, *planes, *cones, *cylinders); -1: nothing
    normal: np.ndarray  # float64 [H, W, 3], unit; 0 where nothing was hit
    bounces: np.ndarray  # int32 [H, W], mirror rays that met something
    path: np.ndarray  # uint64 [H, W]
    lights: np.ndarray  # uint64 [H, W]
    terminator: np.ndarray  # float64 [H, W], in [0, 1]


@dataclass(frozen=True)
class Settings:
    """Everything but the scene and the picture's size; the arguments of ``reference_render``."""

    aa: int = 1
    lattice: str = "report"
    fresnel: str = "dielectric"
    clamp: bool = True
    max_depth: int = 10
    bounce_budget: str = "report"
    self_intersection: str = "robust"
    displacement: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise UsageError(f"{name}={getattr(self, name)!r}: choose one of {', '.join(allowed)}")
        if self.aa < 1 or self.max_depth < 1:
            raise UsageError(f"aa={self.aa} and max_depth={self.max_depth} must be at least 1")

    def offsets(self) -> np.ndarray:
        """Places [aa², 2] of a pixel's samples relative to its centre, in pixels, y upwards."""
        step = np.arange(self.aa) / self.aa
        if self.lattice == "centered":
            step = step + 0.5 / self.aa - 0.5
        x, y = np.meshgrid(step, step)
        return np.stack([x.ravel(), y.ravel()], axis=-1) + self.displacement


def reference_render(
    scene: Scene, *, width: int, height: int, device: str | None = None, **settings: Any
) -> ReferenceResult:
    """Render one of the report's scenes exactly, but for the rounding of float64.

    ``settings``: ``aa`` (aa² samples per pixel), ``lattice`` ("report", "centered"), ``fresnel``
    ("dielectric", "schlick", "unity"), ``clamp`` (each light's part to [0, 1]), ``max_depth``,
    ``bounce_budget`` ("report", "plain"), ``self_intersection`` ("original": the original's absolute
    distances and reach; "robust": an offset of 1e-10 of the size of the coordinates, no limit) and
    ``displacement`` (moves all samples, in pixels, y upwards). ``device`` is "llvm" or "scalar", by default
    the faster one that works here; both give the same picture.

    Raises ``UsageError`` for a setting that does not exist, and ``SceneError`` for a scene with meshes or
    textures.
    """
    try:
        chosen = Settings(**settings)
    except TypeError as error:
        raise UsageError(f"no such setting: {error}") from error
    if width < 1 or height < 1:
        raise UsageError(f"width={width} and height={height} must be at least 1")
    if scene.meshes or any(thing.material.texture for thing in _objects(scene)):
        raise SceneError("the float64 reference draws no meshes and no textures: leave them out of the scene")
    return _Tracer(scene, chosen, backend(device)).render(width, height)


def camera_directions(camera: Camera, width: int, height: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Unit directions [N, 3] through the points (x, y) of the picture, in pixels from its lower left corner.

    The column grows along up × forward: mirrored against a right-handed camera, as in the original.
    """
    forward = _unit(np.subtract(camera.target, camera.position))
    right = _unit(np.cross(camera.up, forward))
    up = np.cross(forward, right)
    half_width = math.tan(math.radians(camera.hfov) / 2)
    u = (2 * x / width - 1) * half_width
    v = (2 * y / height - 1) * half_width * height / width
    return _unit(forward + u[:, None] * right + v[:, None] * up)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


# ------------------------------------------------- Objects --------------------------------------------------


def _objects(scene: Scene) -> list[Any]:
    return [*scene.spheres, *scene.planes, *scene.cones, *scene.cylinders]


class _World:
    """All objects of a scene: distances along rays, and tables of what a hit needs to know."""

    def __init__(self, scene: Scene, arrays: Backend):
        self.arrays = arrays
        self.objects = _objects(scene)
        self.distances = [self._distance(thing) for thing in self.objects]
        self.extent = np.array([_extent(thing) for thing in self.objects])
        materials = [thing.material for thing in self.objects]
        self.ior = np.array([m.ior for m in materials])
        self.alpha = np.array([m.alpha for m in materials])
        self.specular = np.array([m.specular for m in materials])
        self.diffuse = np.array([m.diffuse for m in materials])

    def _distance(self, thing: Any) -> Callable[[Vector3, Vector3], Any]:
        """The function (o, d) -> t of one object."""
        parameter, vector = self.arrays.parameter, self.arrays.vector_parameter
        if isinstance(thing, Sphere):
            center, radius = vector(thing.center), parameter(thing.radius)
            return lambda o, d: intersect_sphere(o, d, center, radius)
        if isinstance(thing, Plane):
            normal, distance = vector(_unit(np.array(thing.normal))), parameter(thing.distance)
            return lambda o, d: intersect_plane(o, d, normal, distance)
        frame, intersect = self._frame(thing), _QUADRICS[type(thing)].intersect
        return lambda o, d: intersect(o, d, frame).t

    def _frame(self, thing: Cone | Cylinder) -> Frame:
        start, end = map(self.arrays.vector_parameter, _axis(thing))
        return _QUADRICS[type(thing)].frame(start, end, self.arrays.parameter(thing.radius))

    def nearest(self, o: np.ndarray, d: np.ndarray, reach: Any) -> tuple[np.ndarray, np.ndarray]:
        """(distance [N], index [N]) of each ray's first object within ``reach``; (reach, -1) for none."""
        origin, direction = self.arrays.vectors(o), self.arrays.vectors(d)
        t = self.arrays.floats(np.broadcast_to(reach, len(o)))
        index = self.arrays.indices(np.full(len(o), -1))
        for i, distance in enumerate(self.distances):
            ti = distance(origin, direction)
            closer = ti < t
            t, index = dr.select(closer, ti, t), dr.select(closer, self.arrays.parameter_index(i), index)
            if i % OBJECTS_PER_KERNEL == OBJECTS_PER_KERNEL - 1:
                dr.eval(t, index)
        return numbers(t), numbers(index)

    def normals(self, o: np.ndarray, d: np.ndarray, p: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Unit normals [N, 3] at the points ``p`` where the rays meet the objects ``index``."""
        n = np.zeros_like(p)
        for i in np.unique(index):
            thing, here = self.objects[i], index == i
            if isinstance(thing, Sphere):
                n[here] = p[here] - thing.center
            elif isinstance(thing, Plane):
                n[here] = thing.normal
            else:
                n[here] = self._quadric_normals(thing, o[here], d[here], p[here])
        return _unit(n)

    def _quadric_normals(
        self, thing: Cone | Cylinder, o: np.ndarray, d: np.ndarray, p: np.ndarray
    ) -> np.ndarray:
        frame, quadric, vectors = self._frame(thing), _QUADRICS[type(thing)], self.arrays.vectors
        part = quadric.intersect(vectors(o), vectors(d), frame).part
        return numbers(quadric.surface(vectors(p), part, frame).n)


@dataclass(frozen=True)
class _Quadric:
    """The functions of ``plugins/intersect.py`` for one kind of object."""

    frame: Callable[..., Frame]
    intersect: Callable[..., SurfaceHit]
    surface: Callable[..., SurfacePoint]


_QUADRICS = {
    Cone: _Quadric(cone_frame, intersect_cone, cone_surface),
    Cylinder: _Quadric(cylinder_frame, intersect_cylinder, cylinder_surface),
}


def _axis(thing: Cone | Cylinder) -> tuple[Vector, Vector]:
    return (thing.apex, thing.base_center) if isinstance(thing, Cone) else (thing.p0, thing.p1)


def _extent(thing: Any) -> float:
    """Size of the numbers that say where an object is."""
    if isinstance(thing, Plane):
        return abs(thing.distance)
    places = (thing.center,) if isinstance(thing, Sphere) else _axis(thing)
    return max(abs(x) for place in places for x in place) + thing.radius


# ------------------------------------------------- Tracing --------------------------------------------------


class _Rows:
    """A data class of arrays with one row per path."""

    def only(self, keep: np.ndarray) -> Any:
        return type(self)(*(getattr(self, f.name)[keep] for f in fields(self)))  # type: ignore[arg-type]


@dataclass
class _Paths(_Rows):
    pixel: np.ndarray  # [N]
    o: np.ndarray  # [N, 3]
    d: np.ndarray  # [N, 3], unit
    throughput: np.ndarray  # [N, 3]
    depth: np.ndarray  # [N]


@dataclass
class _Surface(_Rows):
    """Where paths meet objects, in a local frame with the normal along z."""

    index: np.ndarray  # [N], of the object
    p: np.ndarray  # [N, 3]
    scale: np.ndarray  # [N], size of the numbers that ``p`` was computed from
    frame: np.ndarray  # [N, 3, 3], rows: tangent, tangent, normal
    wi: np.ndarray  # [N, 3], local direction to where the path comes from

    @property
    def n(self) -> np.ndarray:
        return self.frame[:, 2]

    def local(self, v: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", self.frame, v)


@dataclass
class _Lighting:
    """What all lights together do to surfaces."""

    radiance: np.ndarray  # [N, 3]
    seen: np.ndarray  # [N], a number for which lights are in front, and which of these in sight
    grazing: np.ndarray  # [N], least |cos| of the angles between normal and light


class _Tracer:
    def __init__(self, scene: Scene, settings: Settings, arrays: Backend):
        self.scene, self.settings, self.arrays = scene, settings, arrays
        self.world = _World(scene, arrays)
        self.original = settings.self_intersection == "original"
        self.cost = np.array([self._bounce_cost(ior) for ior in self.world.ior])

    def _bounce_cost(self, ior: float) -> int:
        return 1 if self.settings.bounce_budget == "plain" else max(1, 10 - int(10 * ior))

    # ---------------------------------------- Pixels ----------------------------------------

    def render(self, width: int, height: int) -> ReferenceResult:
        first, *others = (self._one_sample(width, height, offset) for offset in self.settings.offsets())
        first.image = sum((film.image for film in others), first.image) / self.settings.aa**2
        layers = {f.name: getattr(first, f.name) for f in fields(first)}
        # The first row is the lowest
        return ReferenceResult(**{k: v.reshape(height, width, *v.shape[1:])[::-1] for k, v in layers.items()})

    def _one_sample(self, width: int, height: int, offset: np.ndarray) -> _Film:
        film = _Film.empty(width * height)
        for start in range(0, width * height, self.arrays.batch):
            pixel = np.arange(start, min(start + self.arrays.batch, width * height))
            x, y = pixel % width + 0.5 + offset[0], pixel // width + 0.5 + offset[1]
            d = camera_directions(self.scene.camera, width, height, x, y)
            o = np.broadcast_to(np.array(self.scene.camera.position, dtype=np.float64), d.shape)
            self._follow(_Paths(pixel, o, d, np.ones_like(d), np.zeros(len(d), dtype=int)), film)
        return film

    def _follow(self, paths: _Paths, film: _Film) -> None:
        """Trace paths to their ends and add up what they carry."""
        reach = ORIGINAL_REACH if self.original else np.inf
        for bounce in range(self.settings.max_depth):
            t, index = self.world.nearest(paths.o, paths.d, reach)
            film.path[paths.pixel] = _mix(film.path[paths.pixel], index)
            found = index >= 0
            missed = paths.only(~found)
            film.image[missed.pixel] += missed.throughput * np.array(self.scene.sky)
            paths = paths.only(found)
            if not len(paths.pixel):
                return
            surface = self._surface(paths, t[found], index[found])
            if bounce == 0:
                film.record(paths, surface, t[found])
            film.bounces[paths.pixel] = bounce
            film.add(paths, self._direct(surface))
            paths = self._reflect(paths, surface)
            if not len(paths.pixel):
                return

    def _surface(self, paths: _Paths, t: np.ndarray, index: np.ndarray) -> _Surface:
        p = paths.o + t[:, None] * paths.d
        normals = self.world.normals(paths.o, paths.d, p, index)
        scale = np.abs(paths.o).max(axis=-1) + t + self.world.extent[index]
        surface = _Surface(index, p, scale, _frames(normals), np.empty_like(p))
        surface.wi = surface.local(-paths.d)
        return surface

    def _reflect(self, paths: _Paths, surface: _Surface) -> _Paths:
        """The mirror rays of the paths that go on."""
        n, cos_theta = surface.n, surface.wi[:, 2]
        sin2_theta = surface.wi[:, 0] ** 2 + surface.wi[:, 1] ** 2
        d = _unit(paths.d + 2 * cos_theta[:, None] * n)
        o = surface.p + ORIGINAL_MIRROR_START * d if self.original else _off_surface(surface)
        fresnel = self._fresnel(cos_theta, sin2_theta, surface.index)
        throughput = paths.throughput * self.world.specular[surface.index] * fresnel[:, None]
        depth = paths.depth + self.cost[surface.index]
        goes_on = (cos_theta > 0) & (depth < self.settings.max_depth) & (throughput != 0).any(axis=-1)
        return _Paths(paths.pixel, o, d, throughput, depth).only(goes_on)

    # ---------------------------------------- Shading ----------------------------------------

    def _direct(self, surface: _Surface) -> _Lighting:
        count = len(surface.p)
        lighting = _Lighting(np.zeros((count, 3)), np.zeros(count, dtype=int), np.ones(count))
        for light in self.scene.lights:
            wo = surface.local(_unit(np.array(light.position) - surface.p))
            lighting.grazing = np.minimum(lighting.grazing, np.abs(wo[:, 2]))
            lighting.seen *= 3
            facing = np.flatnonzero((surface.wi[:, 2] > 0) & (wo[:, 2] > 0))
            if not len(facing):
                continue
            visible = ~self._blocked(surface.only(facing), light)
            lighting.seen[facing] += 1 + visible
            lit = facing[visible]
            if len(lit):
                value = np.array(light.color) * self._bsdf_cos(surface.only(lit), wo[lit])
                lighting.radiance[lit] += np.clip(value, 0, 1) if self.settings.clamp else value
        return lighting

    def _blocked(self, surface: _Surface, light: Light) -> np.ndarray:
        """Is there anything between the surface and the light? [N]"""
        to_light = np.array(light.position) - surface.p
        if self.original:
            distance = np.linalg.norm(to_light, axis=-1)
            d = to_light / distance[:, None]
            o, reach = surface.p + ORIGINAL_SHADOW_START * d, distance - ORIGINAL_SHADOW_START
        else:
            o, reach = _off_surface(surface), 1.0
            d = np.array(light.position) - o
        return self.world.nearest(o, d, reach)[1] >= 0

    def _bsdf_cos(self, surface: _Surface, wo: np.ndarray) -> np.ndarray:
        """BSDF times cosine [N, 3] towards the local directions ``wo``; both cosines positive."""
        i, o = self.arrays.vectors(surface.wi), self.arrays.vectors(wo)
        alpha = self.arrays.floats(self.world.alpha[surface.index])
        lobe = numbers(microfacet_specular(i, o, tan2_theta(i + o), alpha))
        cos_theta, sin2_theta = map(numbers, half_vector_angles(i, o))
        lobe = lobe * self._fresnel(cos_theta, sin2_theta, surface.index)
        diffuse = self.world.diffuse[surface.index] * (wo[:, 2:] / math.pi)
        # The G₁ of a negative roughness can be negative; light cannot
        return np.maximum(diffuse + self.world.specular[surface.index] * lobe[:, None], 0)

    def _fresnel(self, cos_theta: np.ndarray, sin2_theta: np.ndarray, index: np.ndarray) -> np.ndarray:
        """F [N] of the objects ``index``, whose surroundings have index 1."""
        form = self.settings.fresnel
        if form == "unity":
            return np.ones(len(index))
        c, s2, ior = map(self.arrays.floats, (cos_theta, sin2_theta, self.world.ior[index]))
        if form == "dielectric":
            return numbers(fresnel_dielectric(c, 1.0, ior, s2))
        return numbers(fresnel_schlick(c, f0_from_ior(1.0, ior), s2))


def _off_surface(surface: _Surface) -> np.ndarray:
    """Points just outside a surface."""
    return surface.p + OFFSET * surface.scale[:, None] * surface.n


def _frames(n: np.ndarray) -> np.ndarray:
    """Orthonormal frames [N, 3, 3] with the unit vectors ``n`` [N, 3] in the last row."""
    axis = np.eye(3)[np.abs(n).argmin(axis=-1)]
    s = _unit(np.cross(axis, n))
    return np.stack([s, np.cross(n, s), n], axis=1)


def _mix(hashed: np.ndarray, value: np.ndarray) -> np.ndarray:
    """A hash continued by one more number."""
    return (hashed ^ (value + 2).astype(np.uint64)) * _HASH


@dataclass
class _Film:
    """The layers of ``ReferenceResult``, pixels in one row, the lowest line of the picture first."""

    image: np.ndarray
    depth: np.ndarray
    object_id: np.ndarray
    normal: np.ndarray
    bounces: np.ndarray
    path: np.ndarray
    lights: np.ndarray
    terminator: np.ndarray

    @staticmethod
    def empty(count: int) -> _Film:
        return _Film(
            image=np.zeros((count, 3)),
            depth=np.full(count, np.inf),
            object_id=np.full(count, -1, dtype=np.int32),
            normal=np.zeros((count, 3)),
            bounces=np.zeros(count, dtype=np.int32),
            path=np.ones(count, dtype=np.uint64),
            lights=np.ones(count, dtype=np.uint64),
            terminator=np.ones(count),
        )

    def record(self, paths: _Paths, surface: _Surface, t: np.ndarray) -> None:
        self.depth[paths.pixel] = t
        self.object_id[paths.pixel] = surface.index
        self.normal[paths.pixel] = surface.n

    def add(self, paths: _Paths, lighting: _Lighting) -> None:
        self.image[paths.pixel] += paths.throughput * lighting.radiance
        self.lights[paths.pixel] = _mix(self.lights[paths.pixel], lighting.seen)
        self.terminator[paths.pixel] = np.minimum(self.terminator[paths.pixel], lighting.grazing)
