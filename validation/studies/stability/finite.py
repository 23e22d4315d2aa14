"""Extreme input: filters on pictures that are constant, damaged or of huge range; the material in bulk."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import filters, runtime
from mrt_mitsuba.validation.laws.probe import Array, not_finite
from mrt_mitsuba.validation.studies.stability.case import Case

SHAPES = ((1, 1), (1, 17), (17, 1), (2, 2), (3, 3), (1, 2), (40, 30))
MODES = ("report", "corrected")
# A blurred pixel is a weighted mean of at most 16² others: sums of as many float32 products
MEAN = 64 * 2.0**-24
DETECTORS = ("luma", "sobel", "geometry")


def of_filters(quick: bool) -> Iterator[Case]:
    """Yield the cases of the filters, in both kinds of variants."""
    for variant in (runtime.SLOW, runtime.FAST):
        runtime.use(variant)
        for case in (*blurs(), *detectors()):
            yield replace(case, name=f"{case.name} ({variant})")


def _blurred(image: Array, depth: Array, mode: str, f: float = 2.0, r: float = 0.5) -> Array:
    return np.asarray(filters.gaussian_dof(image, depth, mode=mode, focal_distance=f, focal_range=r))


def blurs() -> Iterator[Case]:
    """Yield blurs of constant, damaged and huge pictures."""
    excess = 0.0
    damage = 0
    rng = np.random.default_rng(1)
    for shape, mode in product(SHAPES, MODES):
        depth = rng.uniform(0.1, 12, shape).astype(np.float32)  # on both sides of the focus
        depth[rng.random(shape) < 0.1] = np.inf
        image = rng.random((*shape, 3)).astype(np.float32)
        for level in (np.full_like(image, 1e-25), np.full_like(image, 0.3), 1e20 * image - np.float32(3e19)):
            out = _blurred(level, depth, mode)
            low = level.min()
            high = level.max()
            excess = max(excess, np.maximum(low - out, out - high).max() / max(abs(low), abs(high)))
        for value in (np.nan, np.inf) if shape == SHAPES[-1] else ():
            image[20, 15, 1] = value
            bad = ~np.isfinite(_blurred(image, depth, mode)).all(axis=-1)
            bad[20, 15] ^= True  # this one has to be
            damage += int(bad.sum())
    what = "how far means leave the range of values, 1×1 … 40×30, to 1e20"
    yield Case("range of a blur", what, "not at all", excess, MEAN)
    what = "other pixels that are not finite afterwards, and this one where it is hidden"
    yield Case("nan or inf in a picture, blur", what, "damage stays local, and to be seen", damage, 0)
    image = np.float32(10 ** rng.uniform(-38, 34, (20, 20, 3)))
    depth = np.float32(10 ** rng.uniform(-30, 30, (20, 20)))
    settings = product(MODES, (1e-30, 1.0, 1e30), (0.0, 1e-30, 1e30, np.inf))
    found = [_blurred(image, depth, *setting) for setting in settings]
    what = "values that are not finite, pictures 1e-38 … 1e34, depths 1e-30 … 1e30"
    yield Case("huge ranges, blur", what, "means are finite", np.sum(~np.isfinite(found)), 0)


def _marks(name: str, image: Array, depth: Array) -> filters.EdgeMap:
    """What a detector finds in a picture, or the one that looks at the geometry in the depth."""
    if name == "geometry":
        return filters.geometry_edges(np.full_like(image, 3**-0.5), depth)
    return getattr(filters, f"{name}_edges")(image)


def detectors() -> Iterator[Case]:
    """Yield detectors on damaged pictures and huge ranges."""
    rng = np.random.default_rng(7)
    expected = np.zeros((12, 10), bool)
    expected[5:8, 4:7] = True
    huge = np.float32(10 ** rng.uniform(-38, 34, (20, 20, 3)) * rng.choice([-1, 1], (20, 20, 3)))
    far = np.float32(10 ** rng.uniform(-37, 37, (20, 20)))
    for name in DETECTORS:
        wrong = np.isnan(_marks(name, huge, far).value).sum()
        for value in (np.nan, np.inf):
            image = np.full((12, 10, 3), 0.5, np.float32)
            depth = np.full((12, 10), 3, np.float32)
            image[6, 5, 2] = value
            depth[6, 5] = np.nan  # an infinite depth is a miss
            edges = _marks(name, image, depth)
            wrong += (np.isinf(edges.value) != expected).sum() + (~np.asarray(edges.mask) & expected).sum()
        what = "pixels not marked in its 3×3, or marked elsewhere; NaN among the values of pictures to ±1e34"
        yield Case(f"nan or inf in a picture, huge ranges, {name}", what, "reported, and local", wrong, 0)


AT_ONCE = 2_500_000
# the least float32 of all, and the least with all its digits
TINY = 1e-45
NORMAL = 1.2e-38
_ZERO_UP = (0, TINY, NORMAL, 1e-20, 1e-8, 1e-4, 0.1, 1, 1e2, 1e6, 3e38, np.inf, np.nan)
ALPHAS = (*_ZERO_UP, *(-a for a in _ZERO_UP[1:-1]))
IORS = (1, 1 + 1.2e-7, 1 - 6e-8, TINY, NORMAL, 1e-3, 1e6, 1e9, 3e38, np.inf, np.nan, 0, -1)
COSINES = (1, 1 - 6e-8, 0.5, 1e-3, 1e-7, 1e-12, 1e-20, NORMAL, TINY, 0, -TINY, -1e-7, -0.5, -1)
NUMBERS = (0, 1, -1, TINY, -TINY, NORMAL, 1e-20, 1e-7, -1e-7, 0.5, 2, 1e3, -1e6)
NOTE = (
    "A negative alpha is allowed: D sees its square, G₁ its sign, and where the BSDF would be negative it is "
    "0. |alpha| below 1e-8, 0 included, acts as 1e-8, above 1e6 as 1e6; an update with NaN acts as 1e-8."
)


def in_bulk(quick: bool) -> Iterator[Case]:
    """Yield bulk evaluations with one in three numbers an extreme one."""
    count = 10**6 if quick else 10**8
    what = f"{count:.0e} random and adversarial evaluations: values, densities, samples, reflectances"
    for form, visible in (("schlick", True), ("dielectric", True), ("unity", True), ("dielectric", False)):
        seeds = range(-(-count // AT_ONCE))  # one trace serves all
        bad = sum(bad_lanes(form, visible, count // len(seeds), seed) for seed in seeds)
        normals = "visible normals" if visible else "normals by D"
        yield Case(f"mrt_bsdf, {form}, {normals}", what, "none is bad", bad, 0)


def bad_lanes(form: str, visible: bool, count: int, seed: int) -> int:
    """Count bad values, densities, samples and mirror reflectances; each lane has its alpha and indices."""
    generator = mi.PCG32(count, initstate=dr.opaque(mi.UInt64, seed))

    draw = generator.next_float32

    def mixed(ordinary: mi.Float, extremes: Sequence[float]) -> mi.Float:
        """Ordinary numbers, in every third lane an extreme."""
        table = mi.Float(np.array(extremes, np.float32))
        index = mi.UInt32(draw() * 3 * len(extremes))
        extreme = index < len(extremes)
        return dr.select(extreme, dr.gather(mi.Float, table, index, extreme), ordinary)

    def uniform() -> mi.Float:
        return mixed(draw(), (0, 6e-8, 0.5, 1 - 6e-8))

    def decades(least: float, most: float, extremes: Sequence[float]) -> mi.Float:
        return mixed(least * dr.exp(draw() * math.log(most / least)), extremes)

    def direction() -> mi.Vector3f:
        z = mixed(2 * draw() - 1, COSINES)
        sine, cosine = dr.sincos(2 * dr.pi * uniform())
        r = dr.sqrt(dr.maximum((1 - z) * (1 + z), 0))
        return mi.Vector3f(r * cosine, r * sine, z)

    bright = {"specular_reflectance": 100.0, "diffuse_reflectance": 2.0}
    bsdf = mi.load_dict({"type": "mrt_bsdf", "fresnel": form, "sample_visible": visible, **bright})
    parameters = mi.traverse(bsdf)
    parameters["alpha"] = dr.select(uniform() < 0.8, mi.Float(1), -1) * decades(1e-9, 1e3, ALPHAS)
    parameters["int_ior"] = decades(1e-3, 1e3, IORS)
    parameters["ext_ior"] = decades(0.5, 2, IORS)
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = direction()
    context = mi.BSDFContext()
    away = mi.Vector3f(*(mixed(4 * draw() - 2, NUMBERS) for _ in range(3)))
    near = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z) + 10.0 ** (-9 * uniform()) * away
    near = dr.normalize(near)  # where narrow lobes are
    wo = dr.select((uniform() < 0.5) & dr.all(dr.isfinite(near)), near, direction())
    value, pdf = bsdf.eval_pdf(context, si, wo)
    drawn, weight = bsdf.sample(context, si, uniform(), mi.Point2f(uniform(), uniform()))
    mirror = bsdf.eval_attribute("mirror_reflectance", si)
    bad = not_finite(value, pdf, weight, drawn.pdf, mirror, least=0) | ~(dr.abs(dr.norm(drawn.wo) - 1) < 1e-5)
    return int(dr.count(bad)[0])
