"""Nothing that is not finite, and nothing negative: plugins in bulk, and whole renders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.scene.model import Cone, Cylinder, Light, Material, Plane, Scene, Sphere
from mrt_mitsuba.validation.checks.probe import not_finite
from mrt_mitsuba.validation.studies.stability.cases import Cases
from mrt_mitsuba.validation.studies.stability.transport import BASE, not_a_colour
from mrt_mitsuba.validation.tools.scenery import traced
from mrt_mitsuba.validation.tools.study import Study

AT_ONCE = 2_500_000
TINY, NORMAL = 1e-45, 1.2e-38  # the least float32 of all, and the least with all its digits
_ZERO_UP = (0, TINY, NORMAL, 1e-20, 1e-8, 1e-4, 0.1, 1, 1e2, 1e6, 3e38, np.inf, np.nan)
ALPHAS: tuple[float, ...] = (*_ZERO_UP, *(-a for a in _ZERO_UP[1:-1]))
IORS = (1, 1 + 1.2e-7, 1 - 6e-8, TINY, NORMAL, 1e-3, 1e6, 1e9, 3e38, np.inf, np.nan, 0, -1)
COSINES = (1, 1 - 6e-8, 0.5, 1e-3, 1e-7, 1e-12, 1e-20, NORMAL, TINY, 0, -TINY, -1e-7, -0.5, -1)
NUMBERS = (0, 1, -1, TINY, -TINY, NORMAL, 1e-20, 1e-7, -1e-7, 0.5, 2, 1e3, -1e6)
UNIFORM = (0, 6e-8, 0.5, 1 - 6e-8)
FRESNEL = ("schlick", "dielectric", "unity")


def run(study: Study, *, quick: bool) -> None:
    """Check bulk evaluations with one in three numbers an extreme one; random scenes."""
    cases = Cases(study, "finite", "Finite and not negative")
    count = 10**6 if quick else 10**8
    for name, what, evaluate in BULK:
        # in kernels of ``AT_ONCE``; one trace serves all
        parts = range(-(-count // AT_ONCE))
        bad = sum(int(np.sum(evaluate(_Draw(min(AT_ONCE, count), part)))) for part in parts)
        cases.at_most(name, f"{count:.0e} random and adversarial evaluations: {what}", "none", bad, 0)
    bad, scenes = 0, 3 if quick else 40
    for seed in range(scenes):
        scene = random_scene(np.random.default_rng(seed))
        described = scene.to_dict(width=64, height=48, fresnel=FRESNEL[seed % 3])
        described["integrator"] = {"type": "mrt_whitted", "clamp": bool(seed % 2)}
        bad += not_a_colour(render(described, aa=1, lattice="report").image)
    what = f"{scenes} pictures of extreme objects, materials and lights"
    cases.at_most("random scenes", what, "none", bad, 0)
    cases.close(
        "A negative alpha is allowed: D sees its square, G₁ its sign, and where the BSDF "
        "would be negative it is 0. "
        "|alpha| below 1e-8, 0 included, acts as 1e-8, above 1e6 as 1e6; an update with NaN acts as 1e-8."
    )


class _Draw:
    """Random numbers of N lanes; every third is an extreme one."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed = count, seed
        self._generator = mi.PCG32(count, initstate=dr.opaque(mi.UInt64, seed))

    def uniform(self) -> Any:
        return self._or(UNIFORM, self._generator.next_float32())

    def log(self, least: float, most: float, extremes: Sequence[float]) -> Any:
        """Spread over decades."""
        u = self._generator.next_float32()
        return self._or(extremes, dr.exp(dr.lerp(float(np.log(least)), float(np.log(most)), u)))

    def coordinate(self, size: float = 1.0) -> Any:
        return size * self._or(NUMBERS, 4 * self._generator.next_float32() - 2)

    def vector(self, kind: Any, size: float = 1.0) -> Any:
        return kind(self.coordinate(size), self.coordinate(size), self.coordinate(size))

    def unit(self) -> Any:
        """Return a unit vector, often with components that are 0 or tiny."""
        v = self.vector(mi.Vector3f)
        length = dr.norm(v)
        usable = (length > 1e-15) & (length < 1e15)
        return dr.select(usable, v / dr.select(usable, length, 1), mi.Vector3f(0, 0, 1))

    def local(self) -> Any:
        """Return a direction by its cosine to +z."""
        z = self._or(COSINES, 2 * self._generator.next_float32() - 1)
        sine, cosine = dr.sincos(2 * dr.pi * self.uniform())
        r = dr.sqrt(dr.maximum((1 - z) * (1 + z), 0))
        return mi.Vector3f(r * cosine, r * sine, z)

    def _or(self, extremes: Sequence[float], ordinary: Any) -> Any:
        table = mi.Float(np.array(extremes, np.float32))
        index = mi.UInt32(self._generator.next_float32() * 3 * len(extremes))
        extreme = index < len(extremes)
        return dr.select(extreme, dr.gather(mi.Float, table, index, extreme), ordinary)


_bad = partial(not_finite, least=0)


def _not_unit(v: Any) -> Any:
    return ~(dr.abs(dr.norm(v) - 1) < 1e-5)


# ------------------------------------------------ Plugins --------------------------------------------------


def bsdf_lanes(form: str, visible: bool) -> Callable[[_Draw], Any]:
    """Return value, density, sample and mirror reflectance, with an alpha and indices for each lane."""

    def evaluate(draw: _Draw) -> Any:
        bright = {"specular_reflectance": 100.0, "diffuse_reflectance": 2.0}
        bsdf = mi.load_dict({"type": "mrt_bsdf", "fresnel": form, "sample_visible": visible, **bright})
        parameters = mi.traverse(bsdf)
        sign = dr.select(draw.uniform() < 0.8, mi.Float(1), -1)
        parameters["alpha"] = sign * draw.log(1e-9, 1e3, ALPHAS)
        parameters["int_ior"], parameters["ext_ior"] = draw.log(1e-3, 1e3, IORS), draw.log(0.5, 2, IORS)
        parameters.update()
        si = dr.zeros(mi.SurfaceInteraction3f, draw.count)
        si.wi = draw.local()
        context = mi.BSDFContext()
        away = 10.0 ** (-9 * draw.uniform()) * draw.vector(mi.Vector3f)
        near = dr.normalize(mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z) + away)  # where narrow lobes are
        wo = dr.select((draw.uniform() < 0.5) & dr.all(dr.isfinite(near)), near, draw.local())
        value, pdf = bsdf.eval_pdf(context, si, wo)
        drawn, weight = bsdf.sample(context, si, draw.uniform(), mi.Point2f(draw.uniform(), draw.uniform()))
        mirror = bsdf.eval_attribute("mirror_reflectance", si)
        return _bad(value, pdf, weight, drawn.pdf, mirror) | _not_unit(drawn.wo)

    return evaluate


def light_lanes(draw: _Draw) -> Any:
    light = mi.load_dict({"type": "mrt_light", "intensity": 1e3})
    parameters = mi.traverse(light)
    parameters["position"] = draw.vector(mi.Point3f)
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f, draw.count)
    si.p = draw.vector(mi.Point3f)
    ds, weight = light.sample_direction(si, mi.Point2f(0.5))
    # Between points that are no further apart than the square root of the least float32, no direction is left
    far = dr.max(dr.abs(ds.p - si.p)) > 1e-15
    return _bad(weight, ds.dist, ds.pdf) | (far & _not_unit(ds.d)) | ~dr.all(dr.isfinite(ds.d))


def texture_lanes(draw: _Draw) -> Any:
    texels = np.random.default_rng(9).random((5, 7, 3)).astype(np.float32)
    texture = mi.load_dict({"type": "mrt_texture", "bitmap": mi.Bitmap(texels)})
    si = dr.zeros(mi.SurfaceInteraction3f, draw.count)
    si.uv = mi.Point2f(draw.coordinate(1e3), draw.coordinate(1e3))
    color = texture.eval(si)
    return _bad(color) | (dr.max(color) > 1)


def whitted_lanes(draw: _Draw) -> Any:
    """Return bad results of random rays through a scene of every kind of shape, some from inside."""
    scene = mi.load_dict(random_scene(np.random.default_rng(draw.seed)).to_dict())
    ray = mi.Ray3f(draw.vector(mi.Point3f), draw.unit())
    trace = traced(scene, ray, clamp=False, min_contribution=0.0)
    si = trace.hit.si
    lost = trace.hit.found & (~dr.isfinite(si.t) | _not_unit(si.n))
    bad = _bad(trace.radiance, trace.direct) | lost
    dr.eval(bad)  # while the scene lives
    return bad


# What is evaluated in bulk: plugin, results that are looked at, and the function of the lanes
BULK: Sequence[tuple[str, str, Callable[[_Draw], Any]]] = (
    *((f"mrt_bsdf, {form}", "values, densities, samples and reflectances", bsdf_lanes(form, True))
      for form in FRESNEL),
    ("mrt_bsdf, normals drawn from D", "the same", bsdf_lanes("dielectric", False)),
    ("mrt_light", "directions, distances and weights", light_lanes),
    ("mrt_texture", "colours, which are of [0, 1]", texture_lanes),
    ("mrt_whitted", "radiance, distances and normals", whitted_lanes),
)  # fmt: skip


# --------------------------------------------- Whole renders -----------------------------------------------


def random_scene(rng: np.random.Generator) -> Scene:
    def color() -> tuple[float, float, float]:
        r, g, b = map(float, rng.choice([0, 1e-30, 0.5, 1, 10], 3))
        return (r, g, b)

    def material() -> Material:
        alpha = float(rng.choice([0, 1e-8, 1e-4, -0.04, 0.1, 1, 100, 1e20]))
        ior = float(rng.choice([1e-8, 0.5, 1, 1.0000001, 1.5, 1e6, 1e30]))
        return Material(ior, alpha, color(), color())

    def point() -> tuple[float, float, float]:
        x, y, z = rng.uniform(-2, 2, 3)
        return (float(x), float(y), float(z))

    def radius() -> float:
        return float(10 ** rng.uniform(-4, 0.5))

    return replace(
        BASE,
        lights=(*(Light(point(), (1.0, 1.0, 1.0)) for _ in range(2)), Light((1e6, 1e6, 0), (1e3, 1e3, 1e3))),
        spheres=tuple(Sphere(point(), radius(), material()) for _ in range(8)),
        planes=(Plane(point(), 2.5, material()), Plane((0, 1e-20, 0), 1.5, material())),
        cones=tuple(Cone(point(), point(), radius(), material()) for _ in range(3)),
        cylinders=tuple(Cylinder(point(), point(), radius(), material()) for _ in range(3)),
    )
