"""A second truth: the report's ray tracer in plain NumPy and float64, every ray against every object.

Nothing is shared with the plugins, nor with Dr.Jit or Mitsuba: the formulas are written from the papers, in
other forms where there are any, and the geometry is its own. Slow, and small enough to be read.

* Walter et al. 2007, "Microfacet models for refraction through rough surfaces": D (eq. 25), G₁ (eq. 27), and
  the Fresnel reflectance in Cook and Torrance's form (eq. 22).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import singledispatch
from itertools import chain
from typing import Any

import numpy as np
from numpy.linalg import norm
from numpy.polynomial import Polynomial
from PIL import Image

from mrt_mitsuba.scene.model import OBJECTS, Cone, Cylinder, Mesh, Plane, Scene, Sphere

# Secondary rays start this far off the surface, relative to the coordinates and distances that led to the
# point: far above the rounding of float64, far below anything a float32 picture can show
OFFSET = 1e-10
BATCH = 2**20  # pairs of a ray and a triangle at a time
NOTHING = (1, 1, 0, 0, 0)  # index, roughness and colour of what a ray meets that meets no object

Array = np.ndarray


def reference_render(
    scene: Scene,
    *,
    width: int,
    height: int,
    displacement: Sequence[float] = (0, 0),
    fresnel: str = "dielectric",
    clamp: bool = True,
) -> Array:
    """Render a scene with one ray through each pixel, exactly to the rounding of float64.

    Return the picture in linear RGB, float64 [H, W, 3], top row first.

    ``displacement``: of the rays, in pixels, y upwards. ``fresnel``: "dielectric" or "unity". ``clamp``: each
    light's part to [0, 1], as the report does. Textures are drawn on triangles only, as in the report.
    """
    camera = scene.camera
    # The first row is the lowest; the column grows along up × forward: mirrored against a right-handed
    # camera, as in the original
    pixel = np.arange(width * height)
    x = pixel % width + 0.5 + displacement[0]
    y = pixel // width + 0.5 + displacement[1]
    forward = unit(np.subtract(camera.target, camera.position))
    right = unit(np.cross(camera.up, forward))
    half_width = math.tan(math.radians(camera.hfov) / 2)
    u = (2 * x - width) / width * half_width
    v = (2 * y - height) / width * half_width
    d = unit(forward + u[:, None] * right + v[:, None] * np.cross(forward, right))
    o = np.broadcast_to(np.array(camera.position, float), d.shape)
    return _radiance(scene, o, d, fresnel, clamp).reshape(height, width, 3)[::-1]


@np.errstate(all="ignore")
def _radiance(scene: Scene, o: Array, d: Array, fresnel: str, clamp: bool) -> Array:
    """The light [N, 3] that comes back along rays."""
    things = [*chain.from_iterable(getattr(scene, f"{kind}s") for kind in OBJECTS), *scene.meshes]
    materials = [thing.material for thing in things]
    numbers = np.array([*((m.ior, m.alpha, *m.specular) for m in materials), NOTHING])
    light = np.zeros(d.shape)
    rays = [np.arange(len(d)), np.ones(d.shape), np.zeros(len(d), int), o, d]
    while len(rays[0]):
        ray, weight, spent, o, d = rays
        t, thing, n, diffuse = nearest(things, o, d)  # where nothing is met, n = 0 faces no light
        missed = thing < 0
        light[ray[missed]] += weight[missed] * scene.sky
        ior, alpha, *specular = numbers[thing].T
        p = o + t[:, None] * d
        cos = -dot(n, d)
        specular = np.transpose(specular)
        start = p + (OFFSET * (abs(o).max(axis=1) + t))[:, None] * n

        for lamp in scene.lights:
            to_light = unit(lamp.position - p)
            way = lamp.position - start
            facing = np.flatnonzero((dot(n, to_light) > 0) & (cos > 0))
            shadow = unit(way[facing])
            reach = norm(way[facing], axis=1)
            lit = facing[nearest(things, start[facing], shadow, reach)[1] < 0]
            lobe = specular_lobe(n[lit], to_light[lit], -d[lit], alpha[lit])
            lobe *= reflectance(fresnel, dot(unit(to_light - d), to_light)[lit], ior[lit])
            # The G₁ of a negative roughness can be negative; light cannot
            value = np.maximum(diffuse[lit] / math.pi + specular[lit] * lobe[:, None], 0)
            value = value * dot(n, to_light)[lit, None] * lamp.color
            light[ray[lit]] += weight[lit] * (np.clip(value, 0, 1) if clamp else value)

        weight = weight * specular * reflectance(fresnel, cos, ior)[:, None]
        spent += np.maximum(1, 10 - (10 * ior).astype(int))  # the report's budget of bounces
        on = (cos > 0) & (spent < 10) & (weight != 0).any(axis=1)
        d = unit(d + 2 * cos[:, None] * n)
        rays = [x[on] for x in (ray, weight, spent, start, d)]
    return light


def unit(v: Any) -> Array:
    """Vectors [..., 3] made one unit long."""
    return np.asarray(v / norm(v, axis=-1, keepdims=True))


def dot(a: Array, b: Array) -> Array:
    """The scalar products of vectors [..., 3]."""
    return np.einsum("...i,...i->...", a, b)


# ------------------------------------------------ Reflectance ----------------------------------------------


def reflectance(form: str, cos: Array, ior: Array) -> Array:
    """Fresnel's reflectance for a cosine of incidence in [0, 1], from outside of index 1."""
    if form == "unity":
        return np.ones_like(cos)
    g2 = ior**2 - 1 + cos**2
    g = np.sqrt(np.maximum(g2, 0))
    ratio = (cos * (g + cos) - 1) / (cos * (g - cos) + 1)
    return np.where(g2 < 0, 1.0, 0.5 * ((g - cos) / (g + cos)) ** 2 * (1 + ratio**2))


def specular_lobe(n: Array, to_light: Array, to_eye: Array, alpha: Array) -> Array:
    """D G / (4 cos cos) for unit vectors above the surface."""
    h = unit(to_light + to_eye)
    cos2 = dot(n, h) ** 2
    sin2 = np.square(np.cross(n, h)).sum(axis=-1)
    lobe = np.exp(-sin2 / cos2 / alpha**2) / (math.pi * alpha**2 * cos2**2)
    for way in (to_light, to_eye):
        lobe = lobe * smith_g1(dot(n, way) / (alpha * norm(np.cross(n, way), axis=-1)))
    return lobe / (4 * dot(n, to_light) * dot(n, to_eye))


def smith_g1(a: Array) -> Array:
    """The rational fit of G₁ by 1 / (alpha tan θ)."""
    fit = a * (3.535 + 2.181 * a) / (1 + a * (2.276 + 2.577 * a))
    return np.where(a < 1.6, fit, 1.0)


# ------------------------------------------------- Objects -------------------------------------------------

# For rays (o, d) [N, 3], how far along them an object is [N], inf where it is missed; and a function that
# gives the normals [K, 3] of the rays k, and of a textured mesh their colours
Met = tuple[Array, Callable[[Array], tuple[Array, Any]]]


@np.errstate(all="ignore")
def nearest(things: Sequence[Any], o: Array, d: Array, reach: Any = np.inf) -> tuple[Array, ...]:
    """The first hits of rays (origins [N, 3], unit directions [N, 3]) within ``reach``.

    They have the distance [N], inf for none; the number of the object [N], -1 for none; its unit normal
    [N, 3]; and its diffuse colour [N, 3].
    """
    t = np.full(len(o), np.inf)
    thing = np.full(len(o), -1)
    n, diffuse = np.zeros((2, len(o), 3))
    for number, one in enumerate(things):
        met, surface = meet(one, o, d)
        k = np.flatnonzero((met < t) & (met < reach))
        if len(k):
            normal, color = surface(k)
            t[k] = met[k]
            thing[k] = number
            n[k] = normal
            diffuse[k] = one.material.diffuse if color is None else color
    return t, thing, n, diffuse


def _ahead(t: Array) -> Array:
    return np.where(t > 0, t, np.inf)


@singledispatch
def meet(thing: Any, o: Array, d: Array) -> Met:
    """Where rays meet an object."""
    raise TypeError(f"no rays meet a {type(thing).__name__}")


@meet.register
def _(sphere: Sphere, o: Array, d: Array) -> Met:
    off = o - sphere.center
    passed = -dot(off, d)
    half = np.sqrt(sphere.radius**2 - dot(off, off) + passed**2)
    t = np.minimum(_ahead(passed - half), _ahead(passed + half))

    def surface(k: Array) -> tuple[Array, None]:
        return unit(off[k] + t[k, None] * d[k]), None

    return t, surface


@meet.register
def _(plane: Plane, o: Array, d: Array) -> Met:
    normal = unit(plane.normal)

    def surface(k: Array) -> tuple[Array, None]:
        return normal, None

    return _ahead(-(o @ normal + plane.distance) / (d @ normal)), surface


# Solids of revolution from a first point, the apex of a cone, to another: at the height h of their axis, from
# 0 to 1, their radius is sqrt(c₀ + c₁ h + c₂ h²) times that at h = 1
PROFILES = {Cone: (0, 0, 1), Cylinder: (1, 0, 0)}


def revolved(thing: Any, o: Array, d: Array) -> Met:
    """Where rays meet a solid of ``PROFILES``, closed by a disc at each end that is no apex."""
    first, other, radius, _ = vars(thing).values()
    length = norm(np.subtract(other, first))
    axis = np.subtract(other, first) / length
    squared_radius = Polynomial(radius**2 * np.array(PROFILES[type(thing)]) / length ** np.arange(3))
    widening = squared_radius.deriv() / 2
    passed = -dot(o - first, d)  # from where the ray is nearest to the first end
    off = o - first + passed[:, None] * d
    height = off @ axis
    rise = d @ axis
    across = off - height[:, None] * axis
    drift = d - rise[:, None] * axis
    # |across + t drift|² = squared_radius(height + t rise)
    a = dot(drift, drift) - squared_radius.coef[2] * rise**2
    b = dot(across, drift) - rise * widening(height)
    c = dot(across, across) - squared_radius(height)
    larger = -(b + np.copysign(np.sqrt(b * b - a * c), b))
    side = np.stack([larger / a, c / larger])
    h = height + side * rise
    side[~((h >= 0) & (h <= length))] = np.inf
    discs = np.stack([(length - height) / rise, -height / rise])
    discs[norm(across + discs[..., None] * drift, axis=-1) > radius] = np.inf
    parts = _ahead(passed + np.concatenate([side, discs if PROFILES[type(thing)][0] else discs[:1]]))
    part = parts.argmin(axis=0)
    t = parts.min(axis=0)

    def surface(k: Array) -> tuple[Array, None]:
        along = (t - passed)[k]
        steepness = widening(height[k] + along * rise[k])
        outwards = across[k] + along[:, None] * drift[k] - steepness[:, None] * axis
        normals = [outwards, axis, -axis]
        return unit(np.choose(np.maximum(part[k] - 1, 0)[:, None], normals)), None

    return t, surface


for _solid in PROFILES:
    meet.register(_solid, revolved)


@meet.register
def _(mesh: Mesh, o: Array, d: Array) -> Met:
    corners = np.asarray(mesh.vertices, float)[mesh.faces]
    corner = corners[:, 0]
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    whole = np.cross(first, second)
    t, u, v = np.zeros((3, len(o)))
    face = np.zeros(len(o), int)
    step = max(1, BATCH // len(corner))
    for part in (slice(i, i + step) for i in range(0, len(o), step)):
        moment = np.cross(o[part], d[part])
        scale = -1 / (d[part] @ whole.T)
        along_first = (moment @ second.T - d[part] @ np.cross(second, corner).T) * scale
        along_second = -(moment @ first.T + d[part] @ np.cross(corner, first).T) * scale
        far = _ahead((o[part] @ whole.T - dot(whole, corner)) * scale)
        far[~((along_first >= 0) & (along_second >= 0) & (along_first + along_second <= 1))] = np.inf
        face[part] = far.argmin(axis=1)
        hit = np.arange(len(far)), face[part]
        t[part] = far[hit]
        u[part] = along_first[hit]
        v[part] = along_second[hit]

    def surface(k: Array) -> tuple[Array, Any]:
        """Normals, and the texels nearest to the points, as stored."""
        normal = unit(whole[face[k]])
        if not mesh.material.texture:
            return normal, None
        weights = [1 - u[k] - v[k], u[k], v[k]]
        uvs = np.asarray(mesh.uvs, float)[mesh.faces[face[k]]]
        across, down = np.clip(np.einsum("cn,nci->in", weights, uvs), 0, 1)
        with Image.open(str(mesh.material.texture)) as picture:
            texels = np.asarray(picture.convert("RGB")) / 255
        rows, columns = texels.shape[:2]
        row = (down * (rows - 1) + 0.5).astype(int)
        column = (across * (columns - 1) + 0.5).astype(int)
        return normal, texels[row % rows, column % columns]

    return t, surface
