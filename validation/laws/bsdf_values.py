"""Laws of the values of a BSDF: two ways to one, reciprocity, numbers that are finite and exact."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from . import noise, plots, probe
from .bsdf_case import POINTWISE_TOL, BsdfCase, changed, parameters
from .bsdf_snippets import SAMPLE, VALUE
from .case import READS, READS_WHY, WAVE, reads_checked
from .faults import (
    GLASS,
    GLOSS,
    larger,
    larger_by,
    member,
    no_number,
    of_sample,
    of_weight,
    put,
)
from .law import (
    MIN_QUANTILE_ERRORS,
    Criterion,
    Outcome,
    Skip,
    at_least,
    finds,
    measures,
    most,
    number_of,
)
from .probe import BEYOND, Array, Lanes, context, excess, is_scalar, method, unit

TWO_WAYS = "two ways to the same number"


def first_channel(size, pair, *_):
    value, pdf = pair
    return value * mi.Color3f(1 + size, 1, 1), pdf


def density_of_pair(size, pair, *_):
    value, pdf = pair
    return value, (1 + size) * pdf


@finds("value", "value of eval_pdf() too large in one channel", 1e-4, pair=first_channel)
@finds("density", "density of eval_pdf() too large", 2e-4, nested=GLOSS, pair=density_of_pair)
@measures(
    value=most(f"value of eval_pdf() against that of eval(), {BEYOND}", 1e-4, TWO_WAYS, VALUE),
    density=most(f"density of eval_pdf() against that of pdf(), {BEYOND}", 1e-4, TWO_WAYS, VALUE),
    inactive=number_of(
        "values that are not 0 where active is False",
        0,
        "a sum over lanes must not hold those that are switched off",
        VALUE,
    ),
)
def eval_pdf(law: Outcome, case: BsdfCase) -> None:
    """``eval_pdf`` returns what ``eval`` and ``pdf`` do; values are 0 where ``active`` is False.

    Densities need not be: half of Mitsuba's plugins state one in any lane.
    """
    case.need_smooth()
    p = case.pairs
    value, pdf = case.pair(p)
    law.check("value", excess(value, p.value, p.value_off), p)
    law.check("density", excess(pdf, p.pdf, p.pdf_off), p)

    def switched_off(ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> list[mi.Spectrum]:
        no_lane = wo.z > 2
        together, _ = method(case.plugin, "eval_pdf")(ctx, si, wo, active=no_lane)
        return [method(case.plugin, "eval")(ctx, si, wo, active=no_lane), together]

    if not is_scalar():  # where Mitsuba takes ``active`` out of its plugins
        values = case.ask(switched_off, p)
        law.check("inactive", np.any(values, axis=(0, 2)), p)


RECIPROCITY = """eta = {eta}  # index of refraction at wo over that at wi
forth = bsdf.eval(ctx, si, wo) / dr.abs(wo.z) * eta**2
importance = bsdf.eval(mi.BSDFContext(mi.TransportMode.Importance), si, wo) / dr.abs(wo.z)
si.wi, wo = wo, si.wi
back = bsdf.eval(ctx, si, wo) / dr.abs(wo.z)
print(forth, "should be", back, "and in the mode of importance", importance)
"""
THERE_AND_BACK = """# the way back should lead to where it came from, with the same product
for u in (({u}), ({back})):
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    scale = 1 if ctx.mode == mi.TransportMode.Importance else bs.eta**2
    print(si.wi, "->", bs.wo, "probability x weight x eta^2, or by importance:", bs.pdf * weight * scale)
    si.wi = bs.wo
    ctx.mode = mi.TransportMode.Importance
"""
EITHER_WAY = "light can be followed either way; transmitted radiance scales by the squared index"


@larger_by
def with_cosine(ctx, wi, wo):
    return wi.z


@larger_by
def from_one_side(ctx, wi, wo):
    return wi.z > 0


@larger_by
def by_importance(ctx, *_):
    return ctx.mode == mi.TransportMode.Importance


@finds("swapped", "value that grows with the cosine of wi", 3e-3, value=with_cosine)
@finds("modes", "more light in the mode of importance", 3e-3, value=by_importance)
@finds("medium", "index of refraction of reflected light", 3e-7, sample=of_sample(member("eta", larger)))
@finds("single", "more light through glass from one side", 3e-3, nested=GLASS, value=from_one_side)
@measures(
    swapped=most(f"f(wi, wo) against f(wo, wi), {BEYOND}", POINTWISE_TOL, EITHER_WAY, RECIPROCITY),
    modes=most(
        f"f in the mode of radiance against that of importance, {BEYOND}",
        POINTWISE_TOL,
        EITHER_WAY,
        RECIPROCITY,
    ),
    medium=most(
        "index of refraction of reflected samples, less 1", probe.DIRECTION_EPS, "one medium", SAMPLE
    ),
    returns=at_least(
        "share of single directions (delta) that the way back returns to",
        0.05,
        "light can be followed either way; of several directions, the way back may draw another",
        THERE_AND_BACK,
    ),
    single=most(
        "probability x weight x eta^2 of a single direction (delta) against that of the way back in the mode "
        f"of importance, {BEYOND}",
        POINTWISE_TOL,
        EITHER_WAY,
        THERE_AND_BACK,
    ),
)
def reciprocity(law: Outcome, case: BsdfCase) -> None:
    """f(ωi, ωo) η_o² = f(ωo, ωi) η_i², with the indices of refraction on either side.

    E. Veach, Robust Monte Carlo Methods for Light Transport Simulation, 1997, § 5.2.
    """
    pairs = case.pairs[abs(case.pairs.wi[:, 2] * case.pairs.wo[:, 2]) > 1e-3]

    def forth(at: Lanes) -> Array:
        return case.eval(at) / abs(at.wo[:, 2:]) * at.eta[:, None] ** 2

    def back(at: Lanes) -> Array:
        return case.eval(at.having(wi=at.wo, wo=at.wi)) / abs(at.wi[:, 2:])

    def importance(at: Lanes) -> Array:
        return case.eval(at, context(importance=True)) / abs(at.wo[:, 2:])

    value = forth(pairs)
    allowed = case.spread(forth, pairs)
    for name, other in (("swapped", back), ("modes", importance)):
        law.check(name, excess(value, other(pairs), allowed + case.spread(other, pairs)), pairs)
    if not law.holds:
        few = pairs[:3000]
        law.plot = partial(plots.swapped, forth(few).max(axis=1), back(few).max(axis=1))
    _delta_either_way(law, case)
    # light that is reflected stays in its medium: integrators multiply by ``eta`` as they go
    s = case.drawn
    reflected = ((s.flags & mi.BSDFFlags.Reflection) != 0) & s.lit
    if reflected.any():
        law.check("medium", abs(s.eta - 1), s, where=reflected)


def _delta_either_way(law: Outcome, case: BsdfCase) -> None:
    """Lobes of one direction: probability × weight × η² of a sample, and of the one that goes back."""
    at = case.at_random(2**13, 2**15)
    at.back = case.uniform(len(at.wi), 3)
    forth = case.sample(at)
    there = at.having(wo=unit(forth.wo))
    and_back = there.having(wi=there.wo, wo=at.wi, u=at.back)
    back = case.sample(and_back)
    same = forth.delta & (forth.flags == back.flags) & (forth.lobe == back.lobe)
    same &= abs(at.wi[:, 2] * there.wo[:, 2]) > 1e-3
    returned = (abs(unit(back.wo) - at.wi) < 1e-3).all(axis=1)
    if same.sum() < MIN_QUANTILE_ERRORS:
        return
    lost = (same & ~returned).argmax()
    law.check("returns", returned[same].mean(), at[lost])

    def followed(at: Lanes) -> Array:
        s = case.sample(at)
        return s.weight * (s.pdf * np.float64(s.eta) ** 2)[:, None]

    def followed_back(at: Lanes) -> Array:
        s = case.sample(at, context(importance=True))
        return s.weight * s.pdf[:, None]

    # next to total reflection, a rounding of the direction is a percent of what is transmitted
    allowed = case.spread(followed, there) + case.spread(followed_back, and_back)
    error = excess(followed(there), followed_back(and_back), allowed)
    law.check("single", error, at, where=same & returned)


# A dot product of float32 vectors is rarely less than 1e-7
COSINES = (1, 1 - 6e-8, 0.5, 1e-2, 1e-4, 1e-7, 0)
AZIMUTHS = (0, np.pi / 2, np.pi, -np.pi / 2, 0.7, 4)
INDICES = ("eta", "k", "int_ior", "ext_ior")


def no_number_at_the_end(size, weight, u):
    return dr.select(u.x > 1 - size, dr.nan, weight)


def no_direction(size, bs, weight, u, _):
    return put(bs, wo=no_number(size, bs.wo, u)), weight


def negative_next_to_normal(size, value, ctx, wi, wo):
    return dr.select(dr.minimum(wi.z, wo.z) > 1 - size, -1, 1) * value


@finds("results", "NaN for the last random numbers, this share", 1e-6, sample=of_weight(no_number_at_the_end))
@finds("results", "NaN for a share of the random numbers", 1e-6, quick=4e-6, sample=of_weight(no_number))
@finds("results", "direction NaN for a share of the random numbers", 1e-6, quick=4e-6, sample=no_direction)
@finds("results", "negative value where both cosines are so near to 1", 1e-6, value=negative_next_to_normal)
@measures(
    reads=most(READS, 0, READS_WHY),
    results=number_of(
        "results not finite, or negative{with_setting}: {faults}",
        0,
        "one such number spoils a picture",
        VALUE + SAMPLE,
    ),
)
def finite(law: Outcome, case: BsdfCase) -> None:
    """No NaN, infinity or negative number, for extreme directions, random numbers and parameters."""
    extremes = _extremes(case)
    with reads_checked(law):
        sound = _finite(law, case, extremes)
        for _ in case.waves if sound else ():
            sound &= _finite(law, case, case.sample(case.at_random(WAVE, WAVE)))
        for key, value in parameters(case) if sound else ():
            for end in _ends(key, float(np.mean(np.array(value)))):  # one parameter at a time
                copy = case.copy()
                with changed(copy, key, factor=0, summand=end):
                    _finite(law, copy, extremes, (key, end))


def _extremes(case: BsdfCase) -> Lanes:
    """Directions, random numbers ``u`` and ``uv`` at and between the ends of their ranges."""
    rng = case.rng
    count = case.count(2**14, 2**17)
    cosines = np.array([side * cosine for cosine in COSINES for side in (1, -1)])
    pool = probe.direction(np.repeat(cosines, len(AZIMUTHS)), np.tile(AZIMUTHS, len(cosines)))
    wi, elsewhere = rng.choice(pool, (2, count))
    mirrored = wi * np.array([-1, -1, 1], np.float32)
    kinds = [elsewhere, mirrored, -wi, wi]
    wo = np.choose(rng.integers(len(kinds), size=count)[:, None], kinds)
    u = case.numbers(count, 3, extreme=0.6)
    return Lanes(wi=wi, wo=wo, u=u, uv=case.numbers(count, 2, extreme=0.3))


def _ends(key: str, number: float) -> tuple[float, float]:
    """The ends of the likely range of a parameter."""
    name = key.removesuffix(".value").removesuffix(".values").split(".")[-1]
    if name in INDICES and (number <= 1 or key.endswith(".values")):
        return 0.5 * number, 2.0 * number  # of metals: 0 makes no sense there
    return (0.0, 1.0) if 0 <= number <= 1 else (1.001, 2 * number)


def _finite(law: Outcome, case: BsdfCase, at: Lanes, setting: tuple[str, float] | None = None) -> bool:
    """Check values and samples; return whether all is sound."""
    value, pdf = case.both(at)
    s = case.sample(at)
    length = np.linalg.norm(np.float64(s.wo), axis=1)
    kinds = {
        "eval()": _bad(value),
        "pdf()": _bad(pdf),
        "eval_pdf()": np.any([_bad(values) for values in case.pair(at)], axis=0),
        "weights of samples": _bad(s.weight),
        "densities of samples": s.lit & _bad(s.pdf),  # where the weight is 0, nothing more is read
        "directions of samples": s.lit & ~(abs(length - 1) < 1e-3),
    }
    words = ", ".join(f"{kind} {faults.sum()}" for kind, faults in kinds.items() if faults.any())
    if words or not law.parts:
        with_setting = f" with {setting[0]} = {setting[1]:g}" if setting else ""
        faults = np.any([*kinds.values()], axis=0)
        law.check("results", faults, at, setting=setting, with_setting=with_setting, faults=words or "none")
    return not words


def _bad(values: Array) -> Array:
    """Where any of values [N, …] is not finite, or negative. [N]"""
    sound = np.isfinite(values) & (values >= 0)
    return ~sound.reshape(len(values), -1).all(axis=1)


NOISE = """for k in range(9):  # float32 steps in all components: a smooth function would change evenly
    x = (np.array([{wo}], np.float32).view(np.int32) + {stride} * k).view(np.float32)
    print(np.ravel(bsdf.{function}(ctx, si, mi.Vector3f(*map(float, x)))))
"""


def stairs_on_slope(size, value, ctx, wi, wo):
    slope = wi.z * wo.z / size
    return value * (1 + size * (dr.round(slope) - slope))


@finds("lost", "stairs on a slope, of this height", 1e-4, value=stairs_on_slope)
@measures(
    lost=Criterion(
        0.9,
        "rounding noise of {function}() over that of 8 roundings and of rounded directions, 90th percentile",
        noise.MAX_NOISE,
        "sound formulas stay below 1.6; beyond, digits are lost",
        NOISE,
    )
)
def roundoff(law: Outcome, case: BsdfCase) -> None:
    """Float32 evaluation loses no more digits than the rounding of directions explains (``noise``)."""
    case.need_smooth()
    p = case.pairs
    steep = (abs(p.wi[:, 2]) > 0.1) & (abs(p.wo[:, 2]) > 0.1)
    # far off a lobe, an exponent of 40 makes 40 roundings of one: of nothing
    few = case.few(p[steep & (p.pdf > 1e-3) & (p.value.max(axis=1) > 1e-20)], 500, 2000)
    if len(few.pdf) < MIN_QUANTILE_ERRORS:
        raise Skip("too few pairs of directions with a value")
    inputs = np.column_stack([few.wi, few.wo])

    def both_unit(x: Array) -> Array:
        return unit(x.reshape(-1, 2, 3).astype(np.float64)).reshape(-1, 6)

    def brightest(at: Lanes) -> Array:
        return case.eval(at).max(axis=1)

    def values(function: Callable[[Lanes], Array], x: Array) -> Array:
        uv = np.tile(few.uv, (len(x) // len(few.uv), 1))
        return function(Lanes(wi=x[:, :3], wo=x[:, 3:], uv=uv))

    for name, function in (("eval", brightest), ("pdf", case.pdf)):
        estimate = noise.measure(partial(values, function), inputs, both_unit, seed=case.seed)
        if np.isnan(estimate.noise).mean() > 0.25:
            raise Skip("values change too fast for float32 steps to tell noise")
        law.check("lost", estimate.lost, few, function=name, stride=estimate.stride)
