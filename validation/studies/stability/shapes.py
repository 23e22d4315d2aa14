"""Single objects hit by float32 rays at all sizes and distances, against float64 at the same numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.scene.model import Cone, Cylinder, Material, Mesh, Plane, Sphere
from mrt_mitsuba.validation.checks.probe import Lanes
from mrt_mitsuba.validation.oracles import reference
from mrt_mitsuba.validation.studies.stability.cases import Cases, hexadecimal
from mrt_mitsuba.validation.tools.scenery import rays, traced

ROUNDING = 2.0**-24
DECADES = 10.0 ** np.arange(-6, 7, 2)

# Beyond this ratio of distance to size, the roundings of the ray's origin are as large as the object
FARTHEST = 1e5

# In roundings of the largest coordinate, across the surface: what intersection and a ray's own t lose
# together
ACROSS = 16
# A ray that passes the outline by less than this may hit or miss
OUTLINE = 64
# Angle between the normals, in roundings of the largest coordinate over the size, where another part of the
# surface may be met; elsewhere, each solid is held to four times what was measured
NORMAL = 64

# Directions to a light flatter than this may meet their own surface
FLATTEST = 1e-3


@dataclass(frozen=True)
class Truth:
    """First hits in float64: distance [N], inf for a miss, and unit normal [N, 3]."""

    t: np.ndarray
    n: np.ndarray


@dataclass(frozen=True)
class Solid:
    """An object of about the size 1 around the origin, to be scaled."""

    name: str
    to_dict: Callable[[float], dict[str, Any]]  # of this size
    exact: Callable[[float], Any]  # of this size, for the float64 tracer
    closed: bool  # does every ray from the inside meet it
    normal: float  # what its normals may be off by, in roundings: see ``NORMAL``
    among_others: bool = False  # is another shape in the scene, out of the way

    def hit(self, o: np.ndarray, d: np.ndarray, size: float) -> Truth:
        """Return the first hits of rays [N, 3] with the solid of a size."""
        with np.errstate(all="ignore"):
            shape, o, d = self.exact(size), np.float64(o), np.float64(d)
            t = shape.distances(o, d / np.linalg.norm(d, axis=1, keepdims=True))[:, 0]
            t = t / np.linalg.norm(d, axis=1)
            p = o + np.where(np.isfinite(t), t, 0)[:, None] * d
            return Truth(t, shape.normals(p, np.zeros(len(p), int)))


APEX, BASE, CONE_RADIUS = (0.1, 0.6, -0.2), (-0.1, -0.4, 0.2), 0.5
CORNERS = np.array([(-0.8, -0.5, 0.1), (0.9, -0.3, -0.2), (0.1, 0.9, 0.3)])
NORMAL_OF_PLANE = np.array([0.6, 0.64, 0.48])
PLANE_DISTANCE = 0.3


def _single(value: float) -> float:
    return float(np.float32(value))


def _scaled(point: Any, size: float) -> list[float]:
    return [_single(c * size) for c in point]


MATTE = Material(0.0, 1.0, (0, 0, 0), (1, 1, 1))


def _triangle_dict(size: float) -> dict[str, Any]:
    """Return the triangle, mirrored and of size 1, with what puts it right."""
    positions = mi.Bitmap((CORNERS * [1, 1, -1]).astype(np.float32)[np.newaxis])
    faces = mi.Bitmap(np.array([[[0, 2, 1]]], np.uint32))
    right = mi.ScalarTransform4f().scale([size, size, -size])
    return {"type": "mrt_mesh", "positions": positions, "faces": faces, "to_world": right}


def _axial(kind: Any, first: str, second: str) -> Solid:
    """Return a cone or a cylinder, whose ends go by these names."""
    name = kind.__name__.lower()

    def nodes(size: float) -> dict[str, Any]:
        ends = {first: _scaled(APEX, size), second: _scaled(BASE, size)}
        return {"type": f"mrt_{name}", **ends, "radius": _single(CONE_RADIUS * size)}

    def exact(size: float) -> Any:
        ends = np.multiply(APEX, size), np.multiply(BASE, size)
        return reference.Axial([kind(*ends, CONE_RADIUS * size, MATTE)])

    return Solid(name, nodes, exact, True, 30)


SPHERE = Solid(
    "sphere",
    lambda s: {"type": "sphere", "radius": _single(s)},
    lambda s: reference.Spheres([Sphere((0, 0, 0), s, MATTE)]),
    True,
    12,
)
PLANE = Solid(
    "plane",
    lambda s: {"type": "mrt_plane", "normal": NORMAL_OF_PLANE.tolist(), "distance": PLANE_DISTANCE * s},
    lambda s: reference.Planes([Plane(tuple(NORMAL_OF_PLANE), PLANE_DISTANCE * s, MATTE)]),
    False,
    3,
)
TRIANGLE = Solid(
    "triangle",
    _triangle_dict,
    lambda s: reference.Triangles(Mesh(CORNERS * s, np.array([[0, 1, 2]]), MATTE)),
    False,
    6,
)
CONE, CYLINDER = _axial(Cone, "apex", "base_center"), _axial(Cylinder, "p0", "p1")
AMONG_OTHERS = replace(SPHERE, name="sphere among others", among_others=True)
SOLIDS = (SPHERE, AMONG_OTHERS, PLANE, TRIANGLE, CONE, CYLINDER)


def shape_cases(cases: Cases, worst: list[tuple[str, str, float, str]], *, quick: bool) -> None:
    """Check distance, normal and self-intersection of every solid at every size and distance."""
    sizes = DECADES[::3] if quick else DECADES
    for solid in SOLIDS:
        cells = [cell for size in sizes for cell in _measure(solid, size, rays=300 if quick else 3000)]
        _hold(cases, solid, cells)
        widest = max(cells, key=lambda cell: cell.across)
        worst.append((solid.name, "distance", widest.across, widest.inputs))


def _hold(cases: Cases, solid: Solid, cells: Sequence[_Cell]) -> None:
    name, where = solid.name, f"sizes 1e-6 … 1e6, from 1e-6 to {FARTHEST:g} sizes away and from inside"
    hits, why = sum(c.hits for c in cells), "the figures below mean something"
    cases.at_least(f"{name}, rays that hit", where, why, hits, 500)
    largest = "roundings of the largest coordinate"
    for title, member, what, limit, fault in (
        ("place", "across", f"{where}: worst distance error across the surface, in float32 {largest}",
         ACROSS, "hits 1 in 100,000 further away"),
        ("normal", "normal", f"its worst angle times the cosine of incidence, in {largest} over the size",
         solid.normal, "normals turned by 2 in 100,000"),
    ):  # fmt: skip
        found, made = (max(getattr(c, member) for c in of) for of in (cells, [c.fault for c in cells]))
        cases.at_most(f"{name}, {title}", what, "a few roundings", found, limit, fault=(fault, made))
    astray = f"rays that hit nothing or miss, further than {OUTLINE} roundings off the outline"
    for title, member, what in (
        ("hits and misses", "wrong", astray),
        ("leaks", "leaks", "rays from inside that meet nothing"),
        ("mirror rays", "self_hits", "mirror rays that meet the surface they leave"),
        ("shadow rays", "self_shadows", "points that their own surface hides from a light above it"),
        ("finite", "not_finite", "distances and normals that are no finite numbers"),
    ):
        bad, faults = (sum(getattr(c, member) for c in of) for of in (cells, [c.fault for c in cells]))
        seen = None if member == "leaks" and not solid.closed else ("one ray in ten", faults)
        cases.at_most(f"{name}, {title}", what, "none", bad, 0, fault=seen)


def start_cases(cases: Cases, *, quick: bool) -> None:
    """Check rays that start on a surface or at the apex of the cone."""
    count = 1000 if quick else 20000
    rng = np.random.default_rng(8)
    for solid in (s for s in SOLIDS if s.closed):
        lost = not_finite = 0
        for size in DECADES[::3]:
            o, _ = _rays(size, 3 * size, count)
            inwards = (-o / np.linalg.norm(o, axis=1, keepdims=True)).astype(np.float32)
            truth = solid.hit(o, inwards, size)
            hit = np.isfinite(truth.t)
            p = (o + np.where(hit, truth.t, 0)[:, None] * inwards)[hit].astype(np.float32)
            d = _units(rng, len(p))
            d -= np.maximum((d * truth.n[hit]).sum(axis=1) + 0.1, 0)[:, None] * truth.n[hit]
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            traced = _trace(solid, size, p, d.astype(np.float32))
            lost += int((~traced.found).sum())
            not_finite += int((~np.isfinite(traced.n)).any(axis=1).sum())
        what = f"{count} points rounded to float32, at sizes 1e-6, 1 and 1e6"
        name = f"{solid.name}, from its surface inwards"
        cases.at_most(name, f"{what}: rays that meet nothing", "none", lost, 0)
        cases.at_most(f"{name}, finite", what, "finite normals", not_finite, 0)
    _apex_cases(cases, count, rng)


def _apex_cases(cases: Cases, count: int, rng: np.random.Generator) -> None:
    apex, base = (np.array(end, np.float32) for end in (APEX, BASE))
    axis = np.float64(base) - apex
    height = np.linalg.norm(axis)
    aside = np.cross(axis / height, _units(rng, count))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    tangent = CONE_RADIUS / height
    o = np.broadcast_to(apex, (count, 3))

    def traced(slopes: np.ndarray) -> tuple[_Traced, np.ndarray, np.ndarray]:
        """Return what is met, where it is away from the apex, and how far the base is."""
        d = axis / height + aside * (tangent * slopes)[:, None]
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        found = _trace(CONE, 1.0, o, d.astype(np.float32))
        return found, found.found & (found.t > OUTLINE * ROUNDING), height / (d @ (axis / height))

    found, far, to_base = traced(rng.uniform(0, 0.99, count))
    error = np.abs(np.where(far, found.t, np.inf) - to_base).max() / ROUNDING
    what = "distance to the base, error in roundings; inf: not met"
    cases.at_most("cone, from its apex inwards", what, "the base", error, ACROSS)
    _, far, _ = traced(rng.uniform(1.01, 30, count))
    what = "rays that meet the cone away from the apex"
    cases.at_most("cone, from its apex outwards", what, "none", far.sum(), 0)


SIDES = 256  # of a stand-in mesh, its default


def stand_in_cases(cases: Cases) -> None:
    """Check the meshes that stock integrators see for cones and cylinders: inscribed, outwards, closed.

    A side is a turn of 2π / 256 wide: the mesh lies within r (π / 256)² / 2 of the surface, and its normals
    and texture coordinates are off by half a side at most, where a triangle ends in the apex.
    """
    o, d = _rays(1.0, 4.0, 20_000)
    for solid in (CONE, CYLINDER):
        single = {**solid.to_dict(1.0), "segments": SIDES}
        numbers = mi.Bitmap(np.array([[*np.add(APEX, 1), *np.add(BASE, 1), CONE_RADIUS]], np.float32))
        group = {"type": "mrt_group", "kind": solid.name, "numbers": numbers, "segments": SIDES}
        group["to_world"] = mi.ScalarTransform4f().translate([-1, -1, -1])
        _stand_in(cases, solid, f"{solid.name}, stand-in", single, o, d)
        _stand_in(cases, solid, f"{solid.name}, stand-in in a group", group, o, d)
        _around(cases, solid, single, o, d)


def _stand_in(cases: Cases, solid: Solid, name: str, shape: dict[str, Any], o: Any, d: Any) -> None:
    """Place, normals and outline of a mesh."""
    si, truth = _met(shape, o, d), solid.hit(o, d, 1.0)
    t = np.where(np.array(si.is_valid()), np.array(si.t), np.inf)
    both = np.isfinite(t) & np.isfinite(truth.t)
    gap = np.abs(t[both] - truth.t[both]) * np.abs((truth.n * d).sum(axis=1)[both])
    normals = (np.array(n).T - truth.n for n in (si.n, si.sh_frame.n))  # of faces, of corners
    angle = np.max([np.linalg.norm(n, axis=1)[both] for n in normals], axis=0)
    what = f"of 99 % of the rays that meet a mesh of {SIDES} sides"
    half, inner = np.pi / SIDES, 1.2 * CONE_RADIUS * 0.5 * (np.pi / SIDES) ** 2
    missed = float(np.mean(np.isfinite(t) != np.isfinite(truth.t)))
    cases.at_most(f"{name}, place", f"distance {what}", "inscribed", np.quantile(gap, 0.99), inner)
    cases.at_most(f"{name}, normal", f"angle {what}", "half a side", np.quantile(angle, 0.99), half)
    cases.at_most(f"{name}, outline", "share of rays that hit one of the two only", "few", missed, 2e-4)


def _around(cases: Cases, solid: Solid, shape: dict[str, Any], o: Any, d: Any) -> None:
    """Texture coordinates around the axis, of the mesh and of the exact surface."""
    axis = np.subtract(BASE, APEX) / np.linalg.norm(np.subtract(BASE, APEX))
    across = np.cross(axis, [0.3, 0.5, 0.7])
    across /= np.linalg.norm(across)
    truth = solid.hit(o, d, 1.0)
    on_side = np.isfinite(truth.t) & (np.abs(truth.n @ axis) < 0.9)
    p = (o + np.where(on_side, truth.t, 0)[:, None] * d - APEX)[on_side]
    azimuth = np.arctan2(p @ np.cross(axis, across), p @ across)
    for name, exact, limit in (("stand-in, u", False, 1 / SIDES), ("u", True, 5e-6)):
        u = np.array(_met(shape, o, d, exact=exact).uv.x)[on_side]
        turned = [np.exp(1j * (2 * np.pi * u + sign * azimuth)) for sign in (1, -1)]
        around = max(turned, key=lambda z: abs(z.mean()))
        astray = np.abs(np.angle(around / around.mean())) / (2 * np.pi)
        astray = np.where((u >= 0) & (u <= 1), astray, 1.0)
        what = "its place around the axis, in turns, of 99.9 % of the rays; 1 outside of 0 … 1"
        cases.at_most(f"{solid.name}, {name}", what, "the azimuth", np.quantile(astray, 0.999), limit)


def _met(shape: dict[str, Any], o: np.ndarray, d: np.ndarray, *, exact: bool = False) -> Any:
    """Return interactions of rays with the mesh of a shape, or with its exact surface."""
    scene, ray = mi.load_dict({"type": "scene", "shape": shape}), rays(o, d)
    return traced(scene, ray).hit.si if exact else scene.ray_intersect(ray)


# --------------------------------------------- Measuring ---------------------------------------------------


@dataclass(frozen=True)
class _Cell:
    """The findings of rays from one distance at one size of a solid."""

    hits: int
    across: float  # worst error across the surface, in roundings of the largest coordinate
    normal: float  # worst angle of the normal times the cosine of incidence, in the same over the size
    wrong: int  # hits where there is nothing, and the other way around
    leaks: int  # rays from the inside that met nothing
    self_hits: int  # mirror rays that met the surface they left
    self_shadows: int  # points that their own surface hides from a light above it
    not_finite: int
    inputs: str  # of the worst ray
    fault: Any = None  # the same for rays with faults, where they were made


@dataclass(frozen=True)
class _Traced(Lanes):
    """The findings of the integrator along N rays."""

    found: np.ndarray
    t: np.ndarray
    n: np.ndarray  # [N, 3]
    direct: np.ndarray
    bounces: np.ndarray

    def with_faults(self) -> _Traced:
        """Return hits 1 in 100,000 further away, normals turned by 2; of ten rays, one is lost, one dark,
        one met by its own mirror ray, and one no number."""
        ray = np.arange(len(self.t)) % 10
        return _Traced(
            found=self.found & (ray != 0),
            t=self.t * (1 + 1e-5),
            n=self.n + 2e-5 * np.cross(self.n, [0.36, 0.48, 0.8]),
            direct=np.select([ray == 1, ray == 3], [0, np.nan], self.direct),
            bounces=np.where(ray == 2, 2, self.bounces),
        )


def _measure(solid: Solid, size: float, *, rays: int) -> list[_Cell]:
    # None is on the surface: what starts there has cases of its own
    distances = [1.5 * d if d == size else d for d in DECADES if d <= FARTHEST * size]
    bundles = [_rays(size, distance, rays) for distance in distances]
    o, d = (np.concatenate(part) for part in zip(*bundles, strict=True))
    traced = _trace(solid, size, o, d)
    parts = [slice(k * rays, (k + 1) * rays) for k in range(len(distances))]
    cells, faults = (
        [_compare(solid, size, o[part], d[part], found.only(part)) for part in parts]
        for found in (traced, traced.with_faults())
    )
    return [replace(cell, fault=fault) for cell, fault in zip(cells, faults, strict=True)]


def _rays(size: float, distance: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (o [N, 3], d [N, 3]) from a distance to all parts of an object, a third to its outline."""
    rng = np.random.default_rng(7)
    towards = _units(rng, count)
    o = (distance * towards).astype(np.float32)
    aside = np.cross(towards, _units(rng, count))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    offset = np.where(
        rng.random(count) < 1 / 3, 1 + 1e-3 * rng.normal(size=count), rng.uniform(0, 1.2, count)
    )
    d = aside * (size * offset)[:, None] - o
    if distance < 0.05 * size:
        d = _units(rng, count)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return o, d.astype(np.float32)


def _units(rng: np.random.Generator, count: int) -> np.ndarray:
    v = rng.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _light(size: float) -> np.ndarray:
    return np.array([3.0, 5.0, 4.0]) * size


def _trace(solid: Solid, size: float, o: np.ndarray, d: np.ndarray) -> _Traced:
    """Trace rays with ``mrt_whitted`` against a white mirror of that form under one light."""
    mirror = {"type": "mrt_bsdf", "fresnel": "unity", "alpha": 1.0, "diffuse_reflectance": 1.0}
    nodes = {"solid": {**solid.to_dict(size), "bsdf": mirror}}
    nodes |= {"other": _aside(size)} if solid.among_others else {}
    light = {"type": "mrt_light", "position": _light(size).tolist()}
    scene = mi.load_dict({"type": "scene", **nodes, "light": light})
    integrator = mi.load_dict({"type": "mrt_whitted", "min_contribution": 0.0, "bounce_budget": "plain"})
    # Its mirror rays meet nothing and would be left out; here they are to show that they do not meet it
    facts = replace(integrator.scene_facts(scene), alone=False)
    data = integrator.prepare(scene, integrator.kernel_plan(facts))
    found = integrator.trace(scene, None, rays(o, d), True, data)
    si, hit = found.hit.si, np.array(found.hit.found)
    t = np.where(hit, np.array(si.t, np.float64), np.inf)
    return _Traced(hit, t, np.array(si.n, np.float64).T, np.array(found.direct[0]), np.array(found.bounces))


def _aside(size: float) -> dict[str, Any]:
    """Return another kind of shape, so small and far off that no ray meets it."""
    radius = 1e-3 * float(size)
    return {"type": "sphere", "center": [1700 * radius] * 3, "radius": radius, "flip_normals": True}


def _compare(solid: Solid, size: float, o: np.ndarray, d: np.ndarray, traced: _Traced) -> _Cell:
    scale = max(float(np.abs(o).max()), size)
    rounding = ROUNDING * scale / size  # of the largest coordinate, in sizes
    truth, larger, smaller = (solid.hit(o, d, size * (1 + k * OUTLINE * rounding)) for k in (0, 1, -1))
    exists = np.isfinite(truth.t)
    both = traced.found & exists
    cosine = np.where(both, (truth.n * d).sum(axis=1), 1)
    t = np.where(both, truth.t, 0)
    p = o + t[:, None] * d
    across = np.abs((np.where(both, traced.t, 0) - t) * cosine)
    across /= ROUNDING * np.maximum(scale, np.abs(p).max(axis=1))
    # Where other parts of the surface are within reach, the normal may be that of another part
    smooth = both & np.isfinite(larger.t) & np.isfinite(smaller.t)
    spread = np.linalg.norm(larger.n - smaller.n, axis=1) * np.abs(cosine)
    smooth &= spread < 4 * NORMAL * rounding
    angle = np.linalg.norm(traced.n - truth.n, axis=1) * np.abs(cosine) / rounding
    near_outline = np.isfinite(larger.t) != np.isfinite(smaller.t)
    front = both & (cosine < -FLATTEST)
    to_light = _light(size) - p
    height = (to_light * truth.n).sum(axis=1) / np.linalg.norm(to_light, axis=1)
    dark = front & (height > FLATTEST + OUTLINE * rounding) & ~(traced.direct > 0)
    inside = solid.closed & (np.abs(o).max() < 0.05 * size)
    i = int(np.argmax(across))
    finite = np.isfinite(traced.direct) & (
        ~traced.found | np.isfinite(traced.n).all(axis=1) & np.isfinite(traced.t)
    )
    return _Cell(
        hits=int(both.sum()),
        across=float(across.max()),
        normal=float(np.max(angle, where=smooth, initial=0)),
        wrong=int(((traced.found != exists) & ~near_outline).sum()),
        leaks=int((inside & ~traced.found).sum()),
        self_hits=int((front & (traced.bounces > 1)).sum()),
        self_shadows=int(dark.sum()),
        not_finite=int((~finite).sum()),
        inputs=f"size {hexadecimal([size])}, o {hexadecimal(o[i])}, d {hexadecimal(d[i])}",
    )
