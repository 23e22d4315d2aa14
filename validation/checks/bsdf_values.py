"""Laws of a BSDF's values: one for each way to ask, either way along light, finite, right to its digits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks import noise, snippets
from mrt_mitsuba.validation.checks.bsdf_case import (
    BEYOND,
    POINTWISE,
    ROUNDED,
    Case,
    changed,
    excess,
    parameters,
)
from mrt_mitsuba.validation.checks.law import Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, direction, is_scalar, unit

EITHER_WAY = "light can be followed either way; transmitted radiance scales by the squared index"


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
        law.most(name, error, 1e-4, "two ways to the same number", case.at(snippets.PAIR, p))
    if is_scalar():  # where Mitsuba takes ``active`` out of its plugins
        return
    lit = np.any([(v != 0).any(axis=1) for v in case.probe.inactive(p.wi, p.wo, p.uv)], axis=0)
    why = "a sum over lanes must not hold those that are switched off"
    law.none("values that are not 0 where active is False", lit, why, case.at(snippets.INACTIVE, p))


def reciprocity(law: Law, case: Case) -> None:
    """f(ωi, ωo) η_o² = f(ωo, ωi) η_i², with the indices of the media that the directions are in."""
    if case.smooth:
        _smooth_either_way(law, case)
    _delta_either_way(law, case)
    _reflected(law, case)
    if not law.parts:
        raise Skip("no light was followed either way")


def _smooth_either_way(law: Law, case: Case) -> None:
    few = case.pairs.only(np.abs(case.pairs.wi[:, 2] * case.pairs.wo[:, 2]) > 1e-3)

    def forth(i: Array, o: Array, t: Array, eta: Array) -> Array:
        return case.probe.eval(i, o, t) / np.abs(o[:, 2:]) * eta[:, None] ** 2

    def back(i: Array, o: Array, t: Array, eta: Array) -> Array:
        return case.probe.eval(o, i, t) / np.abs(i[:, 2:])

    arguments = few.wi, few.wo, few.uv, few.eta
    allowed = case.spread(forth, *arguments) + case.spread(back, *arguments)
    law.most(
        f"f(wi, wo) against f(wo, wi), {BEYOND}",
        excess(forth(*arguments), back(*arguments), allowed),
        POINTWISE,
        EITHER_WAY,
        case.at(snippets.RECIPROCITY, few, eta=few.eta),
    )


def _reflected(law: Law, case: Case) -> None:
    """Light that is reflected stays in its medium: integrators multiply by ``eta`` as they go."""
    found = []
    for view in case.views:
        s = view.samples
        drawn = ((s.type & int(mi.BSDFFlags.Reflection)) != 0) & (s.weight != 0).any(axis=1)
        off = np.where(drawn, np.nan_to_num(np.abs(s.eta - 1), nan=np.inf), 0)
        if drawn.any():
            found.append((float(off.max()), view, int(off.argmax())))
    if found:
        worst, view, i = max(found, key=lambda f: f[0])
        show = case.snippet(snippets.WEIGHT, wi=view.wi, uv=view.uv, u=view.u[i])
        law.at_most("index of refraction of reflected samples, less 1", worst, ROUNDED, "one medium", show)


def _delta_either_way(law: Law, case: Case) -> None:
    """Lobes of one direction: probability × weight × η² of a sample, and of the one that goes back."""
    count = case.count(2**13, 2**15)
    wi = direction(case.rng.uniform(-1, 1, count), case.rng.uniform(0, 2 * np.pi, count))
    uv, first, second = case.rng.random((count, 2), np.float32), case.uniform(count), case.uniform(count)
    there = case.probe.sample(wi, first, uv)
    wo = unit(np.where(np.isfinite(there.wo), there.wo, 1))
    back = case.probe.sample(wo, second, uv)
    same = there.delta & (there.type == back.type) & (there.component == back.component)
    same &= np.abs(wi[:, 2] * wo[:, 2]) > 1e-3
    returned = (np.abs(unit(back.wo) - wi) < 1e-3).all(axis=1)
    if same.sum() < 20:
        return

    def show(i: int) -> str:
        return case.snippet(snippets.DELTA_RECIPROCITY, wi=wi[i], uv=uv[i], u=first[i], back=second[i])

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
    what = (
        f"probability x weight x eta^2 of a single direction (delta) against that of the way back, {BEYOND}"
    )
    error = np.where(same & returned, excess(forth, back_again, allowed), 0)
    law.most(what, error, POINTWISE, EITHER_WAY, show)


# ------------------------------------------------ Finite --------------------------------------------------

# A dot product of float32 vectors is rarely less than 1e-7
COSINES = (1, 1 - 6e-8, 0.5, 1e-2, 1e-4, 1e-7, 0)
INDICES = ("eta", "k", "int_ior", "ext_ior")
UNIFORM = (0, 2.0**-24, 0.5, 1 - 2.0**-24)


def finite(law: Law, case: Case) -> None:
    """No NaN, no infinity, nothing negative: extreme directions, random numbers and parameters."""
    extremes = _extremes(case)
    known = _finite(law, case, extremes, np.zeros((6, len(extremes[0])), bool))
    for key, value in _ends(case):
        copy = case.copy()
        with changed(copy, key, lambda old, value=value: type(old)(old * 0 + value)):
            _finite(law, copy, extremes, known, (key, value))
    law.parts = [part for part in law.parts if not part.holds] or law.parts[:1]


def _extremes(case: Case) -> tuple[Array, Array, Array, Array]:
    cosines = np.array([s * c for c in COSINES for s in (1, -1)])
    pool = direction(np.repeat(cosines, 6), np.tile([0, np.pi / 2, np.pi, -np.pi / 2, 0.7, 4], len(cosines)))
    count = case.count(2**14, 2**17)
    wi = pool[case.rng.integers(len(pool), size=count)]
    mirrored, kind = wi * np.array([-1, -1, 1], np.float32), case.rng.integers(4, size=count)[:, None]
    wo = np.where(kind == 0, pool[case.rng.integers(len(pool), size=count)], wi)
    wo = np.where(kind == 1, mirrored, np.where(kind == 2, -wi, wo))
    u = np.where(case.rng.random((count, 3)) < 0.6, case.rng.choice(UNIFORM, (count, 3)), case.uniform(count))
    uv = np.where(
        case.rng.random((count, 2)) < 0.3, case.rng.integers(0, 2, (count, 2)), case.rng.random((count, 2))
    )
    return wi, wo, u.astype(np.float32), uv.astype(np.float32)


def _finite(law: Law, case: Case, extremes: tuple, known: Array, setting: tuple | None = None) -> Array:
    """Count faults that are not known yet; return where they are, by kind. [6, N]"""
    wi, wo, u, uv = extremes
    value, pdf = case.probe.both(wi, wo, uv)
    together = case.probe.pair(wi, wo, uv)
    s = case.probe.sample(wi, u, uv)
    lit = (s.weight != 0).any(axis=1)  # else nothing more is read
    length = np.linalg.norm(s.wo.astype(np.float64), axis=1)
    kinds = {
        "eval()": _bad(value),
        "pdf()": _bad(pdf),
        "eval_pdf()": _bad(together[0]) | _bad(together[1]),
        "weights of samples": _bad(s.weight),
        "densities of samples": lit & _bad(s.pdf),
        "directions of samples": lit & ~(np.abs(length - 1) < 1e-3),
    }
    faults = np.array(list(kinds.values()))
    new = faults & ~known
    kind, i = np.unravel_index(int(new.argmax()), new.shape)
    where = f" with {setting[0]} = {setting[1]:g}" if setting else ""
    named = [f"{name} {count}" for name, count in zip(kinds, new.sum(axis=1), strict=True) if count]
    what = f"results not finite, or negative{where}: {', '.join(named) or 'none'}"
    body = snippets.FINITE_SAMPLE if kind > 2 else snippets.FINITE
    show = case.snippet(body, wi=wi[i], uv=uv[i], wo=wo[i], u=u[i], setting=setting)
    law.at_most(what, new.sum(), 0, "one such number spoils a picture", show)
    return faults


def _bad(values: Array) -> Array:
    return ~(np.isfinite(values) & (values >= 0)).reshape(len(values), -1).all(axis=1)


def _ends(case: Case) -> Iterator[tuple[str, float]]:
    """Yield every number, colour or bitmap of the BSDF at the ends of its likely range, one at a time."""
    for key, value in parameters(case):
        number = float(np.mean(np.array(value)))
        name = key.removesuffix(".value").removesuffix(".values").split(".")[-1]
        if name in INDICES and (number <= 1 or key.endswith(".values")):
            ends = 0.5 * number, 2.0 * number  # of metals: 0 makes no sense there
        else:
            ends = (0.0, 1.0) if 0 <= number <= 1 else (1.001, 2 * number)
        for end in ends:
            yield key, end


# ----------------------------------------------- Roundoff -------------------------------------------------


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

        found = noise.measure(at, inputs, seed=case.seed)
        if np.isnan(found.noise).mean() > 0.25:
            raise Skip("values change too fast for float32 steps to tell noise")
        lost = np.nan_to_num(found.lost(noise.ALLOWANCE), posinf=0)
        title = f"noise of {what} over that of {noise.ALLOWANCE:g} roundings with rounded directions, 9 in 10"
        why = "sound formulas stay below 1.6; beyond, digits are lost inside that could be kept"
        show = case.at(snippets.NOISE, few, function=what[:-2], stride=found.stride)
        law.quantile(title, lost, 0.9, noise.LOST, why, show)
        if not law.parts[-1].holds:
            law.notes.append(
                f"{what}: noise of {np.median(found.noise):.3g} roundings (2^-24), "
                f"of which directions explain {np.median(found.explained):.3g}"
            )
