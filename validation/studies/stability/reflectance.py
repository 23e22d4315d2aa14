"""The reflectance in float32 against 50 digits, over a grid of stiff and extreme lobes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.plugins import fresnel, microfacet
from mrt_mitsuba.plugins.quadric_kinds import Columns
from mrt_mitsuba.validation.bsdf_probe import pairs_about
from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.studies.stability.case import Case

# Of tan²θh / alpha², minus the logarithm of exp(-…): the lobe is at 1e-7 of its peak, and at 1e-20
IN_BOUND, STEEPEST = -np.log([1e-7, 1e-20])
IORS = np.array([1.5, 1.33, 3, 1 + 1e-7, 1 - 1e-7, 0.5, 1e-3, 1e6], np.float32)
FRESNEL_IORS = np.array([*IORS, 1e-2, 0.1, 0.9, 0.99, 1.0001, 1.01, *10.0 ** np.arange(1, 6)], np.float32)

# The first limit holds where D is at least 1e-7 of its peak, for alpha 1e-4 … 1: 80 roundings, for the
# argument of exp is up to 16 there, and its error is multiplied by as much. The second holds on the whole
# grid, where the argument of exp goes to 46: 46 times the 4 roundings of tan²/alpha², and those of the other
# factors. G and F hold no exp: 16 and 32 roundings, three times what was measured
WITH_EXP = 5e-6, 2e-5
LIMITS = {"G": (1e-6, 1.2e-6)}
NOTE = (
    "Relative errors at the same float32 numbers against 50 digits. Directions are what their components "
    "say, and the half vector is their sum; the gradient's error is relative to the sum of the sizes of its "
    "terms, since their sum passes through zero."
)

# D; G; the value, which is the BSDF times cos θo; the density of visible normals; the derivative of the value
# with respect to alpha; and the sum of the sizes of the terms of that derivative
TRUTH = ("D", "G", "BSDF cos", "pdf", "gradient", "slope")

BECKMANN = microfacet.Beckmann()

Arrays = dict[str, np.ndarray]
Cosine = Any  # an array of Dr.Jit's, of float32 or float64


def cases(quick: bool) -> Iterator[Case]:
    """Yield errors of D, G, the whole, its density and its gradient, of F, and of functions of one cosine."""
    lobes = lobes_with_truth(2_000 if quick else 8_000)
    usual = (abs(np.log10(lobes["alpha"]) + 2) < 2) & (lobes["steepness"] <= IN_BOUND)
    for name, error in errors(lobes).items():
        limits = LIMITS.get(name, WITH_EXP)
        where = "alpha 1e-4 … 1, D ≥ 1e-7 of its peak"
        yield Case(f"{name}, p99.9", where, "a few roundings", np.quantile(error[usual], 0.999), limits[0])
        where = "alpha 1e-8 … 100, D ≥ 1e-20 of its peak"
        why = "roundings, which exp enlarges by up to 46"
        yield Case(f"{name}, largest", where, why, error.max(), limits[1])
    count = 60 if quick else 600
    uniform = np.random.default_rng(4).uniform(-7, 0.1, count * len(FRESNEL_IORS))
    cosines = np.float32(np.minimum(10**uniform, 1))
    worst = fresnel_error(cosines, np.repeat(FRESNEL_IORS, count))
    yield Case("F, largest", "cosines 1e-7 … 1, IOR 1e-3 … 1e6", "a few roundings", worst, 2e-6)
    # where total reflection begins, F ends in a square root: errors are those of g = 0
    iors = np.repeat(np.array([0.5, 0.9, 0.99, 0.9999], np.float32), 81)
    critical = np.float32(np.sqrt((1 - np.float64(iors)) * (1 + np.float64(iors))))
    cosines = (critical.view(np.int32) + np.tile(np.arange(-40, 41, dtype=np.int32), 4)).view(np.float32)
    what = "the 40 float32 cosines on either side of it, IOR 0.5 … 0.9999"
    why = "√ of a rounding: 1 - F is 4 g / (η² cos θ) there, and g² is known to a rounding of cos²"
    yield Case("F at the critical angle", what, why, fresnel_error(cosines, iors), 16 * 2.0**-12)
    stride = 2**12 if quick else 1
    what = f"largest error in steps of float32, over float32 cosines in [0, 1], 1 in {stride}"
    why = "about a dozen roundings, some of them doubled by squares"
    for name, formula in OF_COSINE.items():
        yield Case(name, what, why, largest_error(formula, stride), 16)


def fresnel_error(cosines: np.ndarray, iors: np.ndarray) -> float:
    """The largest relative error of the dielectric term."""
    truth = [float(exact.fresnel_dielectric(c, 1, n)) for c, n in zip(cosines, iors, strict=True)]
    found = np.array(fresnel.fresnel_dielectric(mi.Float(cosines), 1, mi.Float(iors)), np.float64)
    return float(abs(found / truth - 1).max())


def errors(lobes: Arrays) -> Arrays:
    """The relative errors [N] of the plugin and its functions, by quantity."""
    alpha = mi.Float(lobes["alpha"])
    wi = mi.Vector3f(lobes["wi"].T)
    wo = mi.Vector3f(lobes["wo"].T)
    dr.enable_grad(alpha)
    bsdf = mi.load_dict({"type": "mrt_bsdf", "fresnel": "dielectric", "diffuse_reflectance": 0.0})
    parameters = mi.traverse(bsdf)
    parameters["alpha"] = alpha
    parameters["int_ior"] = mi.Float(lobes["ior"])
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = wi
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(mi.TransportMode.Radiance, 0xFFFFFFFF, 1), si, wo)
    d = BECKMANN.d(microfacet.tan2_theta(wi + wo), alpha)
    g = BECKMANN.g1(wi, alpha) * BECKMANN.g1(wo, alpha)
    dr.forward(alpha)
    slope = np.array(dr.grad(value[0]), float)
    terms = {"D": d, "G": g, "BSDF cos": value[0], "pdf": pdf}
    of = {name: abs(np.array(dr.detach(x), float) / lobes[name] - 1) for name, x in terms.items()}
    of["gradient in alpha"] = abs(slope - lobes["gradient"]) / lobes["slope"]
    return {name: np.where(np.isnan(error), np.inf, error) for name, error in of.items()}


def schlick(c: Cosine) -> Cosine:
    return fresnel.fresnel_schlick(c, float(np.float32(0.04)))


def dielectric(c: Cosine) -> Cosine:
    return fresnel.fresnel_dielectric(c, 1.0, 1.5)


def g1(alpha: float, c: Cosine) -> Cosine:
    sine = dr.sqrt((1 - c) * (1 + c))
    return BECKMANN.g1(Columns((sine, c * 0, c)), float(np.float32(alpha)))


OF_COSINE: dict[str, Callable[[Cosine], Cosine]] = {
    "Schlick, F0 = 0.04": schlick,
    "exact Fresnel, into n = 1.5": dielectric,
    **{f"Smith's G1, alpha = {alpha}": partial(g1, alpha) for alpha in (0.05, 0.2, 1.0)},
}
# the bits of 1, and of the least number with all its digits
ONE = 0x3F800000
LEAST = 0x00800000
CHUNK = 2**24


def largest_error(formula: Callable[[Cosine], Cosine], stride: int) -> float:
    """The largest |float32 − float64| over the step of float32 there, for every ``stride``-th cosine.

    In float64, its own error is below 1e-6 of a float32 step: nothing in these forms cancels but 1 − c, which
    is exact, and what is small next to its sum. LLVM kernels take what is below the least number with all its
    digits for 0: that does not count.
    """
    from drjit.llvm import Float, Float64, UInt32

    worst = 0.0
    for start in range(0, ONE + 1, CHUNK * stride):  # all float32 numbers from 0 to 1, by their bits
        size = min(CHUNK, (ONE - start) // stride + 1)
        bits = dr.opaque(UInt32, start) + dr.arange(UInt32, size) * stride
        cosines = dr.reinterpret_array(Float, dr.select(bits < LEAST, 0, bits))
        found = formula(cosines)
        wide = formula(Float64(cosines))
        exponent = dr.reinterpret_array(UInt32, Float(wide)) & 0x7F800000
        step = Float64(dr.reinterpret_array(Float, dr.maximum(exponent, LEAST))) * 2.0**-23
        error = dr.select((found == 0) & (wide > 0), 0, dr.abs(Float64(found) - wide) / step)
        worst = max(worst, float(dr.max(error)[0]))
    return worst


@cache
def lobes_with_truth(count: int) -> Arrays:
    """``count`` pairs of directions, or a third more, above the surface, evenly on logarithmic scales.

    By name, for N pairs: the directions ``wi`` and ``wo`` [N, 3], ``alpha``, ``ior``, the ``steepness``
    tan²θh / alpha², and the exact values of ``TRUTH`` [N].
    """
    # a third of them points down
    rng = np.random.default_rng(2)
    drawn = 2 * count
    alpha = np.float32(10 ** rng.uniform(-8, 2, drawn))
    cosine = 10 ** rng.uniform(-7, 0, drawn)
    slope = alpha * np.sqrt(STEEPEST * rng.random(drawn) ** 2)
    wi, wo = pairs_about(cosine, slope, rng)
    x, y, z = (np.float64(wi) + wo).T  # along the half vector
    steepness = (x**2 + y**2) / (z * alpha) ** 2
    keep = (wo[:, 2] > 5e-8) & (steepness < STEEPEST)
    pairs = {"wi": wi, "wo": wo, "alpha": alpha, "ior": rng.choice(IORS, drawn)}
    pairs = {name: values[keep] for name, values in pairs.items()}
    truth = np.array([_exact(*pair) for pair in zip(*pairs.values(), strict=True)])
    return pairs | {"steepness": steepness[keep]} | dict(zip(TRUTH, truth.T, strict=True))


def _exact(wi: Sequence[float], wo: Sequence[float], alpha: float, ior: float) -> list[float]:
    """The values of ``TRUTH`` for a pair of directions."""
    a = exact.number(alpha)
    step = a * exact.mpf("1e-20")
    lobe = exact.lobe(wi, wo, a)
    # Components are not rounded again: the cosine between the directions is that of them made one unit long
    sides = zip(exact.unit(list(wi)), exact.unit(list(wo)), strict=True)
    half = exact.mp.sqrt(sum((p + q) ** 2 for p, q in sides)) / 2
    value = lobe.value * exact.fresnel_dielectric(half, 1, ior)
    density = lobe.d / (4 * exact.Beckmann.visible_cos(wi, a))
    # of the logarithms of D, 2 (tan²/alpha² - 1) / alpha, and of both G₁
    slopes = [(exact.Beckmann.g1(v, a + step) / exact.Beckmann.g1(v, a) - 1) / step for v in (wi, wo)]
    terms = [2 * lobe.tan2 / a**3, -2 / a, *slopes]
    values = (lobe.d, lobe.g, value, density, value * sum(terms), value * sum(map(abs, terms)))
    return [float(x) for x in values]
