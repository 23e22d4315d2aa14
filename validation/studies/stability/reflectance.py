"""The reflectance in float32 against 50 digits, over a grid of stiff and extreme lobes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.plugins import fresnel, microfacet
from mrt_mitsuba.plugins.quadric_kinds import Columns
from mrt_mitsuba.validation.oracles import exact

ALPHAS = 10.0 ** np.arange(-8, 3)
COSINES = np.array([1, 0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7])
# Edges of the cells of tan²θh / alpha², minus the logarithm of exp(-…). The lobe is at 1e-7 of its peak at
# ``IN_BOUND``, and at 1e-20 at the last
IN_BOUND = -np.log(1e-7)
STEEPNESS = np.array([0, 0.1, 1, 4, 9, IN_BOUND, 25, 35, -np.log(1e-20)])
IORS = np.array([1.5, 1.33, 3, 1 + 1e-7, 1 - 1e-7, 0.5, 1e-3, 1e6], np.float32)
FRESNEL_IORS = np.array([*IORS, 1e-2, 0.1, 0.9, 0.99, 1.0001, 1.01, *10.0 ** np.arange(1, 6)], np.float32)

# What is measured, with its limits. The first holds where D is at least 1e-7 of its peak, for alpha 1e-4 … 1:
# 80 roundings, for the argument of exp is up to 16 there, and its error is multiplied by as much. The second
# holds on the whole grid, where the argument of exp goes to 46: 46 times the 4 roundings of tan²/alpha², and
# those of the other factors. G and F hold no exp: 16 and 24 roundings, three times what was measured
BOUND, EVERYWHERE = 5e-6, 2e-5
QUANTITIES = {
    "d": ("D", BOUND, EVERYWHERE),
    "g": ("G", 1e-6, 1.2e-6),
    "f": ("F", 1.5e-6, 2e-6),
    "value": ("BSDF cos", BOUND, EVERYWHERE),
    "pdf": ("pdf", BOUND, EVERYWHERE),
    "gradient": ("gradient in alpha", BOUND, EVERYWHERE),
}
FAULT = "alpha and index 1 in 30,000 too large: what a quarter of the cases exceed"
NOTE = (
    "Relative errors at the same float32 numbers against 50 digits. Directions are what their components "
    "say, and the half vector is their sum; the gradient's error is relative to the sum of the sizes of its "
    "terms, since their sum passes through zero."
)

Case = tuple[Any, ...]
Arrays = dict[str, np.ndarray]


def cases(quick: bool) -> Iterator[Case]:
    """Yield errors of D, G, F, the whole, its density and its gradient; then of functions of one cosine."""
    lobes = lobes_with_truth(2 if quick else 12)
    ours, wrong = (errors(lobes, 60 if quick else 600, wrong=w) for w in (1, 1 + 1 / 30_000))
    wi, alpha = lobes["wi"], lobes["alpha"]
    usual = (alpha > 0.9e-4) & (alpha < 1.1) & (lobes["steepness"] <= IN_BOUND)
    for name, (title, bound, everywhere) in QUANTITIES.items():
        part = slice(None) if name == "f" else usual
        where = "cosines 1e-7 … 1, IOR 1e-3 … 1e6" if name == "f" else "alpha 1e-4 … 1, D ≥ 1e-7 of its peak"
        figure, fault = np.quantile(ours[name][part], 0.999), (FAULT, np.quantile(wrong[name][part], 0.75))
        yield f"{title}, p99.9", where, "a few roundings", figure, bound, fault
        where, why = "alpha 1e-8 … 100, D ≥ 1e-20 of its peak", "roundings, which exp enlarges by up to 46"
        yield f"{title}, largest", where, why, ours[name].max(), everywhere, fault
    moved = slope2(wi, np.nextafter(lobes["wo"], np.float32(2))) / np.float64(alpha) ** 2
    change = np.abs(np.expm1(lobes["steepness"] - moved))
    for size in (1e-3, 1e-4, 1e-6):
        here = np.isclose(alpha, size, atol=0) & (lobes["steepness"] <= IN_BOUND) & np.isclose(wi[:, 2], 0.5)
        what = "largest relative change of D at 60° when x and y of one direction move by one float32 step"
        why = "directions are float32: neighbouring ones, equal to a renderer, have values this far apart"
        yield f"D of a neighbouring direction, alpha {size:g}", what, why, change[here].max()
    # where total reflection begins, F ends in a square root: errors are those of g = 0
    iors = np.repeat(np.array([0.5, 0.9, 0.99, 0.9999], np.float32), 81)
    critical = np.float32(np.sqrt((1 - np.float64(iors)) * (1 + np.float64(iors))))
    cosines = (critical.view(np.int32) + np.tile(np.arange(-40, 41, dtype=np.int32), 4)).view(np.float32)
    what = "the 40 float32 cosines on either side of it, IOR 0.5 … 0.9999"
    why = "√ of a rounding: 1 - F is 4 g / (η² cos θ) there, and g² is known to a rounding of cos²"
    yield "F at the critical angle", what, why, fresnel_errors(cosines, iors).max(), 16 * 2.0**-12
    stride = 2**12 if quick else 1
    what = f"largest error in steps of float32, over float32 cosines in [0, 1], 1 in {stride}"
    why = "about a dozen roundings, some of them doubled by squares"
    for name, formula in OF_COSINE.items():
        yield name, what, why, largest_error(formula, stride), 16


def fresnel_errors(cosines: np.ndarray, iors: np.ndarray, wrong: Any = 1) -> np.ndarray:
    """Return the relative errors of the dielectric term [N]."""
    truth = [float(exact.fresnel_dielectric(c, 1, n)) for c, n in zip(cosines, iors, strict=True)]
    found = np.array(fresnel.fresnel_dielectric(mi.Float(cosines), 1, mi.Float(iors * wrong)), np.float64)
    return np.abs(found / truth - 1)


def errors(lobes: Arrays, count: int, *, wrong: float) -> Arrays:
    """Return the relative errors [N] of the plugin and its functions, by quantity.

    Alpha and indices are ``wrong`` times what they are; ``count``: of cosines for each index of refraction.
    """
    factor = np.float32(wrong)
    alpha, ior = mi.Float(lobes["alpha"] * factor), mi.Float(lobes["ior"] * factor)
    wi, wo = mi.Vector3f(lobes["wi"].T), mi.Vector3f(lobes["wo"].T)
    dr.enable_grad(alpha)
    bsdf = mi.load_dict({"type": "mrt_bsdf", "fresnel": "dielectric", "diffuse_reflectance": 0.0})
    parameters = mi.traverse(bsdf)
    for name, values in (("alpha", alpha), ("int_ior", ior)):
        parameters[name] = type(parameters[name])(values)
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = wi
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(mi.TransportMode.Radiance, 0xFFFFFFFF, 1), si, wo)
    d = microfacet.beckmann_d(microfacet.tan2_theta(wi + wo), alpha)
    g = microfacet.smith_g1(wi, alpha) * microfacet.smith_g1(wo, alpha)
    dr.forward(alpha)
    slope = np.array(dr.grad(value[0]), float)
    terms = {"d": d, "g": g, "value": value[0], "pdf": pdf}
    of = {name: np.abs(np.array(dr.detach(x), float) / lobes[name] - 1) for name, x in terms.items()}
    of["gradient"] = np.abs(slope - lobes["gradient"]) / lobes["slope"]
    cosines = np.float32(10 ** np.random.default_rng(4).uniform(-7, 0, count * len(FRESNEL_IORS)))
    cosines[::count] = 1
    of["f"] = fresnel_errors(cosines, np.repeat(FRESNEL_IORS, count), factor)
    return {name: np.where(np.isnan(error), np.inf, error) for name, error in of.items()}


# --------------------------------------------- Every cosine -----------------------------------------------


def _g1(alpha: float) -> Callable[[Any], Any]:
    return lambda c: microfacet.smith_g1(Columns((dr.sqrt((1 - c) * (1 + c)), c * 0, c)), alpha)


OF_COSINE: dict[str, Callable[[Any], Any]] = {
    "Schlick, F0 = 0.04": lambda c: fresnel.fresnel_schlick(c, float(np.float32(0.04))),
    "exact Fresnel, into n = 1.5": lambda c: fresnel.fresnel_dielectric(c, 1.0, 1.5),
    **{f"Smith's G1, alpha = {alpha}": _g1(float(np.float32(alpha))) for alpha in (0.05, 0.2, 1.0)},
}
ONE, LEAST = 0x3F800000, 0x00800000  # the bits of 1, and of the least number with all its digits
CHUNK = 2**24


def largest_error(formula: Callable[[Any], Any], stride: int) -> float:
    """Return the largest |float32 − float64| over the step of float32 there, for every ``stride``-th cosine.

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
        found, wide = formula(cosines), formula(Float64(cosines))
        exponent = dr.reinterpret_array(UInt32, Float(wide)) & 0x7F800000
        step = Float64(dr.reinterpret_array(Float, dr.maximum(exponent, LEAST))) * 2.0**-23
        error = dr.select((found == 0) & (wide > 0), 0, dr.abs(Float64(found) - wide) / step)
        worst = max(worst, float(dr.max(error)[0]))
    return worst


# ------------------------------------------------- The truth -----------------------------------------------


def slope2(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return tan² of the angle of the half vectors [N], exact to a few roundings of float64."""
    h = wi.astype(np.float64) + wo
    return np.asarray((h[:, 0] ** 2 + h[:, 1] ** 2) / h[:, 2] ** 2)


@lru_cache(maxsize=4)
def lobes_with_truth(per_cell: int) -> Arrays:
    """Return up to ``per_cell`` pairs of directions in every cell of roughness, cosine and steepness.

    Of N pairs ``wi`` and ``wo`` [N, 3], ``alpha``, ``ior``, the ``steepness`` tan²θh / alpha², and what
    ``_exact`` says of them.
    """
    rng, cells = np.random.default_rng(1), np.arange(len(STEEPNESS) - 1)
    grid = np.meshgrid(np.float32(ALPHAS), COSINES, cells, np.arange(2 * per_cell))  # half of them point down
    alpha, cosine, cell, _ = (x.ravel() for x in grid)
    tan = alpha * np.sqrt(rng.uniform(STEEPNESS[cell], STEEPNESS[cell + 1]))
    phi, psi = rng.uniform(0, 2 * np.pi, (2, len(alpha)))
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    wi = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)
    m = np.stack([tan * np.cos(psi), tan * np.sin(psi), np.ones(len(alpha))], axis=1)
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    wi, wo = np.float32(wi), np.float32(2 * (wi * m).sum(axis=1, keepdims=True) * m - wi)
    steepness = slope2(wi, wo) / np.float64(alpha) ** 2
    keep = (wo[:, 2] > 0.5 * COSINES[-1]) & (steepness < STEEPNESS[-1])
    lobes = {"wi": wi, "wo": wo, "alpha": alpha, "ior": rng.choice(IORS, len(alpha)), "steepness": steepness}
    lobes = {name: values[keep] for name, values in lobes.items()}
    rows = [_exact(*pair) for pair in zip(*list(lobes.values())[:4], strict=True)]
    names = ("d", "g", "value", "pdf", "gradient", "slope")
    return lobes | dict(zip(names, np.array(rows).T, strict=True))


def _exact(wi: np.ndarray, wo: np.ndarray, alpha: float, ior: float) -> tuple[float, ...]:
    """Return D, G, the value (BSDF times cos θo), the density of visible normals, the value's derivative with
    respect to alpha, and the sum of the sizes of the terms of that derivative."""
    a, step = exact.number(alpha), exact.number(alpha) * exact.mpf("1e-20")
    x, y, z = (exact.number(p) + exact.number(q) for p, q in zip(wi, wo, strict=True))
    tan2 = (x * x + y * y) / (z * z)
    # Components are not rounded again: the cosine between the directions is that of them made one unit long
    sides = zip(exact.unit(list(wi)), exact.unit(list(wo)), strict=True)
    f = exact.fresnel_dielectric(exact.mp.sqrt(sum((p + q) ** 2 for p, q in sides)) / 2, 1, ior)

    def terms(a: Any) -> list[Any]:
        d = exact.beckmann_d(1 / exact.mp.sqrt(1 + tan2), a)
        return [d, exact.smith_g1(wi, a), exact.smith_g1(wo, a)]

    (d, g_i, g_o), moved = terms(a), terms(a + step)
    value = d * f * g_i * g_o / (4 * exact.number(wi[2]))
    of_d, *of_g = ((after / before - 1) / step for after, before in zip(moved, (d, g_i, g_o), strict=True))
    # d ln D / d alpha is 2 (tan²/alpha² - 1) / alpha
    size = 2 * (tan2 / a**2 + 1) / a + sum(map(abs, of_g))
    density = d / (4 * exact.visible_cos(wi, a))
    return tuple(map(float, (d, g_i * g_o, value, density, value * (of_d + sum(of_g)), value * size)))
