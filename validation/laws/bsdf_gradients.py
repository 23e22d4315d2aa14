"""Derivatives of a BSDF's values by its parameters, against differences, and those of its samples."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from . import probe
from .bsdf_case import BsdfCase, changed, live, narrow, parameters
from .faults import GLOSS, of_weight
from .law import MIN_QUANTILE_ERRORS, SIGMAS, Outcome, Skip, finds, measures, most, number_of
from .probe import DIRECTION_EPS, Array, Lanes, Probe, as_mitsuba, context, excess

DERIVATIVE_TOL = 2e-2  # relative; differences of two widths agree better
MEAN_DERIVATIVE_TOL = 5e-2  # where outlines of lobes move, derivatives of samples miss them
DIFFERENCE_STEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  # of differences, over the parameter
BIASED = "biased derivatives: optimisations by AD go wrong"
DETACHED = f"{BIASED}; integrators follow a direction as a constant, and its density must not change, either"

DERIVATIVE = """params, key = mi.traverse(bsdf), {key!r}
before = type(params[key])(params[key])

def value(shift):
    params[key] = type(before)(before + shift)
    params.update()
    return dr.sum(bsdf.eval(ctx, si, wo), axis=None)

shift = mi.Float(0)
dr.enable_grad(shift)
moved = value(shift)
if dr.grad_enabled(moved):
    dr.forward(shift)
print("derivative:", dr.grad(moved), "difference:", (value(1e-3) - value(-1e-3)) / 2e-3)
"""
SAMPLED = """params, key = mi.traverse(bsdf), {key!r}
shift = mi.Float(0)
dr.enable_grad(shift)
params[key] = type(params[key])(params[key] + shift)
params.update()
bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
value, pdf = bsdf.eval_pdf(ctx, si, dr.detach(bs.wo))
weight, expected = dr.sum(weight, axis=None), dr.sum(value / dr.detach(pdf), axis=None)
dr.forward(shift)
print("does the direction move?", dr.grad_enabled(bs.wo))
print("derivative of the weight:", dr.grad(weight), "of eval() over a constant density:", dr.grad(expected))
"""
UPDATE = """params, key = mi.traverse(bsdf), {key!r}
print("eval():", bsdf.eval(ctx, si, wo))
params[key] = type(params[key])(params[key] * 0 + {number})
params.update()
print("after an update to {number}:", bsdf.eval(ctx, si, wo), "should be", {value})
"""


def steeper(size, value, *_):
    """The same number, with a larger derivative."""
    return value + size * (value - dr.detach(value))


@finds("values", "derivative of values too large", 0.03, nested=GLOSS, value=steeper)
@finds("mean", "derivative of weights too large", 0.06, nested=GLOSS, sample=of_weight(steeper))
@measures(
    values=most(
        "derivative of values by {key}{how}, relative, beyond the error of differences",
        DERIVATIVE_TOL,
        f"{BIASED}; differences of two widths agree better, or the difference is allowed for",
        DERIVATIVE,
    ),
    broken=number_of(
        "derivatives by {key} that are not finite, of finite values",
        0,
        "one of them spoils a whole gradient",
        DERIVATIVE,
    ),
    mean=most(
        "mean derivative of weights by {key} against that of eval() over a constant density, relative, "
        f"beyond {SIGMAS} standard errors",
        MEAN_DERIVATIVE_TOL,
        DETACHED,
        SAMPLED,
    ),
    reached=most(
        "values that loading with another {key} changes, but params.update() does not, relative",
        DERIVATIVE_TOL,
        f"{BIASED}; parameters_changed() has to compute anew what is made of parameters",
        UPDATE,
    ),
)
def gradients(law: Outcome, case: BsdfCase) -> None:
    """Derivatives by every parameter agree with differences, and those of samples with those of values."""
    if "_ad_" not in mi.variant():
        raise Skip(f"{mi.variant()} has no derivatives")
    case.need_smooth()
    if not len(case.lit.wi):
        raise Skip("values are 0")
    case = case.copy()
    params = mi.traverse(case.plugin)
    keys = [k for k, _ in parameters(case) if not params.flags(k) & mi.ParamFlags.NonDifferentiable]
    if not keys:
        raise Skip("traverse() marks no parameter as differentiable")
    for key in keys:
        number = float(np.mean(np.array(params[key])))
        factor = 0.9 if number == 1 else 1  # so that it can be varied both ways
        summand = 0.1 if number == 0 else 0
        with changed(case, key, factor=factor, summand=summand):
            if _attached(law, case, key):
                _sampled(law, case, key)


def _attached(law: Outcome, case: BsdfCase, key: str) -> bool:
    """Check the derivative by one parameter against differences; return whether it is attached, or right."""
    few = case.lit
    (derivative,), attached = _derivatives(case, key, len(few.wi), lambda: [_values(case)])
    broken = ~np.isfinite(derivative)
    derivative = probe.finite_or_0(derivative)
    slope, error = _differences(case, key)
    if not attached and not slope.any():
        law.notes.append(f"{key} changes no value")
        _reached(law, case, key)
    off = abs(derivative - slope)
    known = np.isfinite(error)
    if known.sum() < MIN_QUANTILE_ERRORS:
        law.notes.append(f"{key}: its least differences move lobes away, and cannot judge derivatives")
        return True
    usual = known & (off <= np.quantile(off[known], 0.98))  # where values have a kink, no slope is
    beyond = np.maximum(off - error, 0)[usual].sum()
    measured = beyond / max(abs(slope)[usual].sum(), abs(derivative)[usual].sum(), 1e-30)
    i = int(np.where(usual, off, 0).argmax())
    how = "" if attached else " (detached)"
    law.check("values", measured, few[i], key=key, how=how)
    law.check("broken", broken, few, key=key)
    return attached or measured <= DERIVATIVE_TOL


def _derivatives(
    case: BsdfCase, key: str, count: int, values: Callable[[], list[mi.Float]]
) -> tuple[Array, bool]:
    """Derivatives [K, N] by a parameter of K arrays that ``values`` makes, and whether there are any."""
    shift = mi.Float(0)
    dr.enable_grad(shift)
    with changed(case, key, summand=_sizes(case, key) * shift):
        arrays = values()
        attached = any(map(dr.grad_enabled, arrays))
        if attached:
            dr.forward(shift)
        derivatives = [np.array(dr.grad(array), np.float64) for array in arrays]
        return np.array([np.broadcast_to(x, count) for x in derivatives]), attached


def _sampled(law: Outcome, case: BsdfCase, key: str) -> None:
    """Check the mean derivative of sample weights against that of f cos θo / pdf, pdf and ωo detached.

    Single weights may differ where a sample moves with the parameter; under smooth light, means agree.
    """
    at = case.at_random(2**14, 2**16)

    def weights() -> list[mi.Float]:
        si = _interaction(at)
        u = as_mitsuba("Point3f", at.u)
        bs, weight = probe.method(case.plugin, "sample")(context(), si, u.x, mi.Point2f(u.y, u.z))
        value, pdf = probe.method(case.plugin, "eval_pdf")(context(), si, dr.detach(bs.wo))
        light = 1 + 0.5 * bs.wo.x + 0.25 * dr.square(bs.wo.z)
        by_value = _total(value) / dr.detach(dr.select(pdf > 0, pdf, 1))
        return [_total(weight) * light, by_value * dr.detach(light)]

    (derivative, expected), attached = _derivatives(case, key, len(at.wi), weights)
    s = case.sample(at)
    up = (abs(s.wi[:, 2]) > 0.05) & (abs(s.wo[:, 2]) > 0.05)
    flat = s.pdf < (1024 * DIRECTION_EPS) ** -2  # else a rounding shows
    counts = live(s, *case.both(s)) & ~narrow(s) & up & flat & np.isfinite(derivative + expected)
    if not attached or counts.sum() < 100:
        return
    s = s[counts]
    apart = (derivative - expected)[counts]
    size = max(abs(expected[counts]).mean(), 1e-3 * abs(s.weight).mean(), 1e-30)
    known = np.clip(apart, *np.quantile(apart, (1e-3, 1 - 1e-3)))
    off = max(abs(known.mean()) - SIGMAS * known.std() / np.sqrt(len(known)), 0)
    worst = s[int(abs(apart).argmax())]
    law.check("mean", off / size, Lanes(wi=worst.wi, uv=worst.uv, u=worst.u), key=key)


def _interaction(at: Lanes) -> mi.SurfaceInteraction3f:
    return probe.interaction(as_mitsuba("Vector3f", at.wi), as_mitsuba("Point2f", at.uv))


def _total(spectrum: mi.Spectrum) -> mi.Float:
    total = dr.sum(mi.unpolarized_spectrum(spectrum))
    return dr.select(dr.isfinite(total), total, 0)


def _reached(law: Outcome, case: BsdfCase, key: str) -> None:
    """A parameter whose updates change no value should change none where it is loaded, either."""
    name = key.removesuffix(".value")
    few = case.lit
    usual = float(np.mean(np.array(mi.traverse(case.plugin)[key])))
    number = 0.8 * usual or 0.5
    if case.description is None or "." in name:
        return
    try:
        other = Probe(case.load(**{name: number}))
    except RuntimeError:  # what is loaded goes by another name, or takes other numbers
        return
    value = other.eval(few)
    off = excess(value, few.value, few.value_off)
    law.check("reached", off, few.having(value=value), key=key, number=number)


def _sizes(case: BsdfCase, key: str) -> mi.Float:
    """The sizes of the numbers of a parameter: a spectrum's may be of many."""
    numbers = mi.traverse(case.plugin)[key]
    usual = float(np.mean(abs(np.array(numbers)))) or 0.05
    return dr.select(numbers == 0, usual, dr.abs(dr.detach(numbers)))


def _values(case: BsdfCase) -> mi.Float:
    """Values at pairs, with derivatives, each over what it is without a change. [N]"""
    few = case.lit
    value = probe.method(case.plugin, "eval")(context(), _interaction(few), as_mitsuba("Vector3f", few.wo))
    scale = np.maximum(few.value.max(axis=1), 1e-3 * few.value.max())
    return _total(value) / as_mitsuba("Float", scale)


def _differences(case: BsdfCase, key: str) -> tuple[Array, Array]:
    """Central differences [N] of the width that is off by least, and by how much they may be off [N].

    That is what the next larger width says otherwise, the rounding of values, and half of what the slopes to
    either side are apart: where a value has a kink, as at the end of a range, either one is a derivative.
    Where a lobe is so narrow that it moves away within every width, differences say nothing: infinity.
    """

    def at(shift: float) -> Array:
        with changed(case, key, summand=_sizes(case, key) * dr.opaque(mi.Float, shift)):
            return np.array(_values(case), np.float64)

    here = at(0.0)
    after = np.array([at(step) for step in DIFFERENCE_STEPS])
    before = np.array([at(-step) for step in DIFFERENCE_STEPS])
    across = 2 * np.array(DIFFERENCE_STEPS)[:, None]
    slopes = (after - before) / across
    bent = abs(after - 2 * here + before)
    sides = np.where(bent <= 0.25 * abs(here), bent / across, np.inf)
    rounding = 2.0**-22 * abs(here) / across
    error = 2 * abs(np.diff(slopes, axis=0)) + sides[1:] + rounding[1:]
    best = error.argmin(axis=0)
    lanes = np.arange(len(best))
    return slopes[1:][best, lanes], error[best, lanes]
