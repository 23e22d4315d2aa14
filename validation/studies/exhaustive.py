"""The formulas of one variable at every float32 cosine in [0, 1]: true largest errors, not sampled ones.

The reference is the same formula in float64, whose own error is below 1e-6 of a float32 step: nothing in
these forms cancels but 1 − c, which is exact, and what is small next to its sum. 50-digit numbers confirm
that at cosines drawn at random.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import VariantError
from mrt_mitsuba.plugins.fresnel import fresnel_dielectric, fresnel_schlick
from mrt_mitsuba.plugins.microfacet import smith_g1
from mrt_mitsuba.plugins.quadric_kinds import Columns
from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Formulas of one variable at every float32 cosine"
ONE = 0x3F800000  # the bits of 1
LEAST = 0x00800000  # of the least number with all its digits; LLVM kernels take smaller ones for 0
CHUNK = 2**24
QUICK = 2**12  # in a quick run, every so manieth cosine
CONFIRMED = 300  # cosines at which 50 digits judge the reference
F0, IOR = np.float32(0.04), np.float32(1.5)
Function = Callable[[Any], Any]


def _g1(alpha: float) -> tuple[Function, Function]:
    rough = float(np.float32(alpha))

    def truth(c: Any) -> Any:
        x = exact.number(c)
        return exact.smith_g1((exact.mp.sqrt(1 - x * x), 0, x), rough)

    return lambda c: smith_g1(Columns((dr.sqrt((1 - c) * (1 + c)), c * 0, c)), rough), truth


# Functions of the cosine by name, in any precision and in 50 digits
FORMULAS: dict[str, tuple[Function, Function]] = {
    "Schlick, F0 = 0.04": (
        lambda c: fresnel_schlick(c, float(F0)),
        lambda c: exact.fresnel_schlick(c, F0),
    ),
    "exact Fresnel, into n = 1.5": (
        lambda c: fresnel_dielectric(c, 1.0, float(IOR)),
        lambda c: exact.fresnel_dielectric(c, 1, IOR),
    ),
    **{f"Smith's G1, alpha = {alpha}": _g1(alpha) for alpha in (0.05, 0.2, 1.0)},
}


def run(study: Study, *, quick: bool) -> None:
    """Show the table of errors, of a billion cosines each, or of some hundred thousand."""
    if runtime.obstacle(runtime.FAST):
        raise VariantError(f"every cosine needs llvm arrays: {runtime.obstacle(runtime.FAST)}")
    from drjit.llvm import Float64

    stride = QUICK if quick else 1
    bits = np.random.default_rng(6).integers(LEAST, ONE, CONFIRMED).astype(np.uint32)
    cosines = np.append(bits.view(np.float32), np.float32(1))
    rows, confirmed = [], 0.0
    for name, (formula, truth) in study.each(TITLE, FORMULAS.items()):
        worst, cosine, flushed = largest_error(formula, stride)
        rows.append([name, worst, cosine, flushed])
        right = np.array([float(truth(c)) for c in cosines])
        error = np.abs(np.array(formula(Float64(cosines.astype(np.float64)))) - right)
        confirmed = max(confirmed, float((error / np.spacing(right.astype(np.float32))).max()))
        study.at_most(
            f"{name}: largest error, ulp", worst, 16, "some dozen roundings, of which squares double some"
        )
    note = f"Every {stride}th float32 cosine." if quick else "Every float32 cosine in [0, 1]."
    note += " 1 ulp: the step between float32 numbers. Flushed: 0 in place of a number with fewer digits."
    study.table("exhaustive", "Largest errors", ["formula", "ulp", "at the cosine", "flushed"], rows, note)
    what = "error of the float64 reference against 50 digits, ulp of float32"
    study.at_most(what, confirmed, 1e-6, "some dozen roundings of float64, 2e-9 of a float32 step each")


def largest_error(formula: Function, stride: int) -> tuple[float, float, int]:
    """Return the largest |float32 − float64| over the step of float32 there, where it is, and how many values
    are flushed to 0: LLVM kernels do so with what is below the least number with all its digits."""
    from drjit.llvm import Float, Float64, UInt32

    worst, cosine, flushed = -1.0, 0.0, 0
    for start in range(0, ONE + 1, CHUNK * stride):  # all float32 numbers from 0 to 1, by their bits
        size = min(CHUNK, (ONE - start) // stride + 1)
        bits = dr.opaque(UInt32, start) + dr.arange(UInt32, size) * stride
        cosines = dr.reinterpret_array(Float, dr.select(bits < LEAST, 0, bits))
        found, wide = formula(cosines), formula(Float64(cosines))
        exponent = dr.reinterpret_array(UInt32, Float(wide)) & 0x7F800000
        step = Float64(dr.reinterpret_array(Float, dr.maximum(exponent, LEAST))) * 2.0**-23
        to_zero = (found == 0) & (wide > 0)
        error = dr.select(to_zero, 0, dr.abs(Float64(found) - wide) / step)
        dr.eval(cosines, error, to_zero)
        flushed += int(dr.count(to_zero)[0])
        largest = float(dr.max(error)[0])
        if largest > worst:
            worst = largest
            cosine = float(dr.gather(Float, cosines, dr.compress(error == largest))[0])
    return worst, cosine, flushed
