"""The components of a BSDF: flags, sums, and what ``ctx.component`` selects."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks import snippets
from mrt_mitsuba.validation.checks.bsdf_case import Case, excess, parameters
from mrt_mitsuba.validation.checks.law import Law
from mrt_mitsuba.validation.checks.probe import Array, Samples, context, direction
from mrt_mitsuba.validation.checks.recipe import row


def components(law: Law, case: Case) -> None:
    """Flags of components against what they do; their sum against the whole; ``ctx.component``."""
    bsdf, pairs = case.plugin, case.pairs
    count = bsdf.component_count()
    flags = [int(bsdf.flags(i)) for i in range(count)]
    apart = bin(np.bitwise_or.reduce(flags or [0]) ^ int(bsdf.flags())).count("1")
    why = "flags() is the union of flags(i)"
    what = "flags of the whole that no component has, or the other way around"
    law.at_most(what, apart, 0, why, case.snippet(snippets.FLAGS))
    _updated(law, case, count)
    parts = [case.probe.eval(pairs.wi, pairs.wo, pairs.uv, context(i)) for i in range(count)]
    allowed = case.spread(case.probe.eval, pairs.wi, pairs.wo, pairs.uv)
    error = excess(np.sum(parts, axis=0), pairs.value, allowed)
    what = "sum of the components against the whole, relative"
    law.most(what, error, 1e-4, "a sum", case.at(snippets.PARTS, pairs))
    why = "reflection stays on its side, transmission crosses, lobes of one direction have no value"
    sides = [_wrong_side(case, i, flag, parts[i]) for i, flag in enumerate(flags)]
    drawn = [_drawn(case, i) for i in range(count)]
    samples = [_wrong_samples(i, flag, *drawn[i]) for i, flag in enumerate(flags)]
    for kind, faults, body in (
        ("eval()", sides, snippets.SIDE),
        ("sample()", samples, snippets.COMPONENT_SAMPLE),
    ):
        total, shown = sum(count for count, _ in faults), max(faults, key=lambda fault: fault[0])[1]
        what = f"results of {kind} that contradict the component's flags"
        law.at_most(what, total, 0, why, case.snippet(body, **shown))
    dark = sum(_dark_sides(case, flag, parts[i], *drawn[i]) for i, flag in enumerate(flags))
    what = "sides that a component's flags name, and from which it is black"
    law.at_most(what, dark, 0, "a flag without a lobe", case.snippet(snippets.FLAGS))


def _updated(law: Law, case: Case, count: int) -> None:
    if case.recipe.description is not None:
        copy = case.recipe.load()
        params = mi.traverse(copy)
        for key, value in parameters(case):
            params[key] = type(value)(value)
        params.update()
        law.at_most(
            "components more or fewer after params.update()",
            abs(copy.component_count() - count),
            0,
            "an update says nothing about lobes",
            case.snippet(snippets.UPDATED, keys=[key for key, _ in parameters(case)]),
        )


def _wrong_side(case: Case, component: int, flags: int, value: Array) -> tuple[int, dict[str, Any]]:
    """Count values where the component's flags allow none."""
    p = case.pairs
    bad = (
        (value != 0).any(axis=1) & np.isfinite(value).all(axis=1) & ~_allowed(flags, p.wi, p.wo, smooth=True)
    )
    i = int(bad.argmax())
    return int(bad.sum()), {"component": component, "wi": p.wi[i], "uv": p.uv[i], "wo": p.wo[i]}


def _allowed(flags: int, wi: Array, wo: Array, *, smooth: bool) -> Array:
    f = mi.BSDFFlags
    reflects = f.DiffuseReflection, f.GlossyReflection, *(() if smooth else (f.DeltaReflection,))
    transmits = (
        f.DiffuseTransmission,
        f.GlossyTransmission,
        *(() if smooth else (f.DeltaTransmission, f.Null)),
    )
    same, other = (any(flags & int(kind) for kind in kinds) for kinds in (reflects, transmits))
    front, back = bool(flags & int(f.FrontSide)), bool(flags & int(f.BackSide))
    return np.where(wi[:, 2] * wo[:, 2] > 0, same, other) & np.where(wi[:, 2] > 0, front, back)


def _drawn(case: Case, component: int) -> tuple[dict[str, Array], Samples]:
    """Return where samples of one component were asked for, and what came."""
    count = case.count(2**12, 2**14)
    wi = direction(case.rng.uniform(-1, 1, count), case.rng.uniform(0, 2 * np.pi, count))
    u, uv = case.uniform(count), case.rng.random((count, 2), np.float32)
    return {"wi": wi, "uv": uv, "u": u}, case.probe.sample(wi, u, uv, context(component))


def _lit(s: Samples) -> Array:
    return (s.weight != 0).any(axis=1) & np.isfinite(s.weight).all(axis=1)


def _wrong_samples(
    component: int, flags: int, given: dict[str, Array], s: Samples
) -> tuple[int, dict[str, Any]]:
    """Count samples of one component that go by another name, kind or side."""
    bad = (s.component != component) | ((s.type & ~flags) != 0) | (s.type == 0)
    clear = np.abs(s.wo[:, 2]) > 1e-6
    bad = _lit(s) & (bad | clear & ~_allowed(flags, given["wi"], s.wo, smooth=False))
    return int(bad.sum()), {"component": component, **row({**given, "wo": s.wo}, int(bad.argmax()))}


def _dark_sides(case: Case, flags: int, value: Array, given: dict[str, Array], s: Samples) -> int:
    """Count the sides that flags name and where there is no light, of a component that has some."""
    wi = np.concatenate([case.pairs.wi[(value != 0).any(axis=1)], given["wi"][_lit(s)]])
    sides = (mi.BSDFFlags.FrontSide, (wi[:, 2] > 0).any()), (mi.BSDFFlags.BackSide, (wi[:, 2] < 0).any())
    return sum(bool(flags & int(flag)) and len(wi) > 0 and not lit for flag, lit in sides)
