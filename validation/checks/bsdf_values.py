"""Laws of a BSDF's values: one for each way to ask, either way along light, finite, right to its digits."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks import noise
from mrt_mitsuba.validation.checks.bsdf_case import (
    BEYOND,
    POINTWISE,
    ROUNDED,
    Case,
    changed,
    excess,
    parameters,
)
from mrt_mitsuba.validation.checks.bsdf_samples import WEIGHT
from mrt_mitsuba.validation.checks.law import Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, context, direction, is_scalar, unit

EITHER_WAY = "light can be followed either way; transmitted radiance scales by the squared index"

PAIR = """point wo
print("eval_pdf():", bsdf.eval_pdf(ctx, si, wo))
print("eval():", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
"""
INACTIVE = """point wo
print("a lane switched off:", bsdf.eval(ctx, si, wo, False), "should be 0")
"""


def eval_pdf(law: Law, case: Case) -> None:
    """``eval_pdf`` against ``eval`` and ``pdf``; both ways to a value heed ``active``.

    Densities need not: half of Mitsuba's plugins state one in any lane.
    """
    case.need_smooth()
    p = case.pairs
    value, pdf = case.probe.pair(p.wi, p.wo, p.uv)
    for what, one, other, single in (
        ("value", value, p.value, case.probe.eval),
        ("density", pdf, p.pdf, case.probe.pdf),
    ):
        error = excess(one, other, case.spread(single, p.wi, p.wo, p.uv))
        name = f"{what} of eval_pdf() against that of the single function, {BEYOND}"
        law.most(name, error, 1e-4, "two ways to the same number", case.at(PAIR, p))
    if not is_scalar():  # where Mitsuba takes ``active`` out of its plugins
        lit = np.any([(v != 0).any(axis=1) for v in case.probe.inactive(p.wi, p.wo, p.uv)], axis=0)
        why = "a sum over lanes must not hold those that are switched off"
        law.none("values that are not 0 where active is False", lit, why, case.at(INACTIVE, p))


RECIPROCITY = """point wo
eta = {eta}  # index of refraction at wo over that at wi
forth = bsdf.eval(ctx, si, wo) / dr.abs(wo.z) * eta**2
si.wi, wo = wo, si.wi
back = bsdf.eval(ctx, si, wo) / dr.abs(wo.z)
print(forth, "should be", back)
"""
MODES = """point wo
eta = {eta}  # index of refraction at wo over that at wi
print("radiance, times eta^2:", bsdf.eval(ctx, si, wo) * eta**2)
print("importance:", bsdf.eval(mi.BSDFContext(mi.TransportMode.Importance), si, wo))
"""
DELTA_RECIPROCITY = """point
# the way back should lead to where it came from, with the same product
for u in (({u}), ({back})):
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    print(si.wi, "->", bs.wo, "probability x weight x eta^2:", bs.pdf * weight * bs.eta**2)
    si.wi = bs.wo
"""


def reciprocity(law: Law, case: Case) -> None:
    """f(ωi, ωo) η_o² = f(ωo, ωi) η_i², with the indices of the media that the directions are in."""
    if case.smooth:
        few = case.pairs.only(np.abs(case.pairs.wi[:, 2] * case.pairs.wo[:, 2]) > 1e-3)

        def forth(i: Array, o: Array, t: Array, eta: Array) -> Array:
            return case.probe.eval(i, o, t) / np.abs(o[:, 2:]) * eta[:, None] ** 2

        def back(i: Array, o: Array, t: Array, eta: Array) -> Array:
            return case.probe.eval(o, i, t) / np.abs(i[:, 2:])

        def importance(i: Array, o: Array, t: Array, eta: Array) -> Array:
            return case.probe.eval(i, o, t, context(importance=True)) / np.abs(o[:, 2:])

        arguments = few.wi, few.wo, few.uv, few.eta
        one, allowed = forth(*arguments), case.spread(forth, *arguments)
        for what, other, body in (
            ("f(wi, wo) against f(wo, wi)", back, RECIPROCITY),
            ("f in the mode of radiance against that of importance", importance, MODES),
        ):
            error = excess(one, other(*arguments), allowed + case.spread(other, *arguments))
            law.most(f"{what}, {BEYOND}", error, POINTWISE, EITHER_WAY, case.at(body, few, eta=few.eta))
    _delta_either_way(law, case)
    # light that is reflected stays in its medium: integrators multiply by ``eta`` as they go
    found = []
    for view in case.views:
        s = view.samples
        drawn = ((s.type & int(mi.BSDFFlags.Reflection)) != 0) & (s.weight != 0).any(axis=1)
        off = np.where(drawn, np.nan_to_num(np.abs(s.eta - 1), nan=np.inf), 0)
        if drawn.any():
            found.append((float(off.max()), view, int(off.argmax())))
    if found:
        worst, view, i = max(found, key=lambda f: f[0])
        show = case.snippet(WEIGHT, wi=view.wi, uv=view.uv, u=view.u[i])
        law.at_most("index of refraction of reflected samples, less 1", worst, ROUNDED, "one medium", show)
    if not law.parts:
        raise Skip("no light was followed either way")


def _delta_either_way(law: Law, case: Case) -> None:
    """Lobes of one direction: probability × weight × η² of a sample, and of the one that goes back."""
    count = case.count(2**13, 2**15)
    wi, uv = case.units(count), case.rng.random((count, 2), np.float32)
    first, second = case.uniform(count), case.uniform(count)
    there = case.probe.sample(wi, first, uv)
    wo = unit(np.where(np.isfinite(there.wo), there.wo, 1))
    back = case.probe.sample(wo, second, uv)
    same = there.delta & (there.type == back.type) & (there.component == back.component)
    same &= np.abs(wi[:, 2] * wo[:, 2]) > 1e-3
    returned = (np.abs(unit(back.wo) - wi) < 1e-3).all(axis=1)
    if same.sum() < 20:
        return

    def show(i: int) -> str:
        return case.snippet(DELTA_RECIPROCITY, wi=wi[i], uv=uv[i], u=first[i], back=second[i])

    what = "share of single directions (delta) that the way back returns to"
    why = "light can be followed either way; of several directions, the way back may draw another"
    law.at_least(what, returned[same].mean(), 0.05, why, show(int((same & ~returned).argmax())))

    def followed(i: Array, _: Array, t: Array, u: Array) -> Array:
        s = case.probe.sample(i, u, t)
        return s.weight * (s.pdf * s.eta.astype(np.float64) ** 2)[:, None]

    ways = (wi, wo, uv, first), (wo, wi, uv, second)
    # next to total reflection, a rounding of the direction is a percent of what is transmitted
    forth, back_again = (followed(*way) for way in ways)
    allowed = case.spread(followed, *ways[0]) + case.spread(followed, *ways[1])
    what = "probability x weight x eta^2 of a single direction (delta) against that of the way back"
    error = np.where(same & returned, excess(forth, back_again, allowed), 0)
    law.most(f"{what}, {BEYOND}", error, POINTWISE, EITHER_WAY, show)
    # the same random numbers in the other mode
    other = case.probe.sample(wi, first, uv, context(importance=True))
    alike = there.delta & (np.abs(other.wo - there.wo) < 1e-3).all(axis=1)
    error = np.where(alike, excess(there.weight * there.eta[:, None] ** 2, other.weight, 0 * there.weight), 0)
    what = (
        "weight of a single direction (delta), times eta^2, against that in the mode of importance, relative"
    )
    law.most(what, error, POINTWISE, EITHER_WAY, show)


# ------------------------------------------------ Finite --------------------------------------------------

# A dot product of float32 vectors is rarely less than 1e-7
COSINES = (1, 1 - 6e-8, 0.5, 1e-2, 1e-4, 1e-7, 0)
INDICES = ("eta", "k", "int_ior", "ext_ior")
UNIFORM = (0, 2.0**-24, 0.5, 1 - 2.0**-24)

FINITE = """point wo setting
print("eval():", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
"""
FINITE_SAMPLE = """point setting sample
print("weight:", weight, "density:", bs.pdf, "direction:", bs.wo)
"""


def finite(law: Law, case: Case) -> None:
    """No NaN, no infinity, nothing negative: extreme directions, random numbers and parameters."""
    cosines = np.array([s * c for c in COSINES for s in (1, -1)])
    pool = direction(np.repeat(cosines, 6), np.tile([0, np.pi / 2, np.pi, -np.pi / 2, 0.7, 4], len(cosines)))
    rng, count = case.rng, case.count(2**14, 2**17)
    wi = pool[rng.integers(len(pool), size=count)]
    mirrored, kind = wi * np.array([-1, -1, 1], np.float32), rng.integers(4, size=count)[:, None]
    wo = np.where(kind == 0, pool[rng.integers(len(pool), size=count)], wi)
    wo = np.where(kind == 1, mirrored, np.where(kind == 2, -wi, wo))
    u = np.where(rng.random((count, 3)) < 0.6, rng.choice(UNIFORM, (count, 3)), case.uniform(count))
    uv = np.where(rng.random((count, 2)) < 0.3, rng.integers(0, 2, (count, 2)), rng.random((count, 2)))
    extremes = wi, wo, u.astype(np.float32), uv.astype(np.float32)
    known = _finite(law, case, extremes, np.zeros((6, count), bool))
    for key, value in parameters(case):
        # the ends of its likely range, one at a time
        number, name = float(np.mean(np.array(value))), key.removesuffix(".value").removesuffix(".values")
        if name.split(".")[-1] in INDICES and (number <= 1 or key.endswith(".values")):
            ends = 0.5 * number, 2.0 * number  # of metals: 0 makes no sense there
        else:
            ends = (0.0, 1.0) if 0 <= number <= 1 else (1.001, 2 * number)
        for end in ends:
            copy = case.copy()
            with changed(copy, key, lambda old, end=end: type(old)(old * 0 + end)):
                _finite(law, copy, extremes, known, (key, end))
    law.parts = [part for part in law.parts if not part.holds] or law.parts[:1]


def _finite(law: Law, case: Case, extremes: tuple, known: Array, setting: tuple | None = None) -> Array:
    """Count faults that are not known yet; return where they are, by kind. [6, N]"""
    wi, wo, u, uv = extremes
    value, pdf = case.probe.both(wi, wo, uv)
    together = case.probe.pair(wi, wo, uv)
    s = case.probe.sample(wi, u, uv)
    lit = (s.weight != 0).any(axis=1)  # else nothing more is read
    length = np.linalg.norm(s.wo.astype(np.float64), axis=1)

    def bad(values: Array) -> Array:
        return ~(np.isfinite(values) & (values >= 0)).reshape(len(values), -1).all(axis=1)

    kinds = {
        "eval()": bad(value),
        "pdf()": bad(pdf),
        "eval_pdf()": bad(together[0]) | bad(together[1]),
        "weights of samples": bad(s.weight),
        "densities of samples": lit & bad(s.pdf),
        "directions of samples": lit & ~(np.abs(length - 1) < 1e-3),
    }
    faults = np.array(list(kinds.values()))
    new = faults & ~known
    kind, i = np.unravel_index(int(new.argmax()), new.shape)
    where = f" with {setting[0]} = {setting[1]:g}" if setting else ""
    named = [f"{name} {count}" for name, count in zip(kinds, new.sum(axis=1), strict=True) if count]
    what = f"results not finite, or negative{where}: {', '.join(named) or 'none'}"
    body = FINITE_SAMPLE if kind > 2 else FINITE
    show = case.snippet(body, wi=wi[i], uv=uv[i], wo=wo[i], u=u[i], setting=setting)
    law.at_most(what, new.sum(), 0, "one such number spoils a picture", show)
    return faults


# ----------------------------------------------- Roundoff -------------------------------------------------

NOISE = """point wo
for k in range(9):  # float32 steps in all components: a smooth function would change evenly
    x = (np.array([{wo}], np.float32).view(np.int32) + {stride} * k).view(np.float32)
    print(np.ravel(bsdf.{function}(ctx, si, mi.Vector3f(*map(float, x)))))
"""


def roundoff(law: Law, case: Case) -> None:
    """Noise of float32 evaluation beyond what the rounding of the directions explains."""
    case.need_smooth()
    lit = case.pairs.only((np.abs(case.pairs.wi[:, 2]) > 0.1) & (np.abs(case.pairs.wo[:, 2]) > 0.1))
    # far off a lobe, an exponent of 40 makes 40 roundings of one: of nothing
    lit = lit.only((lit.pdf > 1e-3) & (lit.value.max(axis=1) > 1e-20))
    few = lit.only(slice(0, case.count(500, 2000)))
    if len(few.pdf) < 20:
        raise Skip("too few pairs of directions with a value")
    inputs = np.concatenate([few.wi, few.wo], axis=1)
    for what, function in (("eval()", lambda *a: case.probe.eval(*a).max(axis=1)), ("pdf()", case.probe.pdf)):

        def at(x: Array, function: Any = function) -> Array:
            return function(x[:, :3], x[:, 3:], np.tile(few.uv, (len(x) // len(few.uv), 1)))

        found = noise.measure(at, inputs, seed=case.seed, project=_on_spheres)
        if np.isnan(found.noise).mean() > 0.25:
            raise Skip("values change too fast for float32 steps to tell noise")
        lost = np.nan_to_num(found.lost(noise.ALLOWANCE), posinf=0)
        title = f"noise of {what} over that of {noise.ALLOWANCE:g} roundings with rounded directions, 9 in 10"
        why = "sound formulas stay below 1.6; beyond, digits are lost inside that could be kept"
        show = case.at(NOISE, few, function=what[:-2], stride=found.stride)
        law.quantile(title, lost, 0.9, noise.LOST, why, show)
        if not law.parts[-1].holds:
            law.notes.append(
                f"{what}: noise of {np.nanquantile(found.noise, 0.9):.3g} roundings (2^-24), "
                f"of which directions explain {np.median(found.explained):.3g}"
            )


def _on_spheres(x: Array) -> Array:
    """Return pairs of directions [N, 6] made one unit long again."""
    return np.concatenate([unit(x[:, :3].astype(np.float64)), unit(x[:, 3:].astype(np.float64))], axis=1)
