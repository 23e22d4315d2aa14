"""The components of a BSDF: flags, sums, and what ``ctx.component`` selects."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks.bsdf_case import Case, excess, parameters
from mrt_mitsuba.validation.checks.law import Law
from mrt_mitsuba.validation.checks.probe import Array, context

FLAGS = """
print("flags of the components:", [hex(int(bsdf.flags(i))) for i in range(bsdf.component_count())])
print("flags of the whole:", hex(int(bsdf.flags())))
"""
UPDATED = """
params = mi.traverse(bsdf)
print("components before:", bsdf.component_count())
for key in {keys}:
    params[key] = 0.9 * params[key]
params.update()
print("and after params.update():", bsdf.component_count())
"""
PARTS = """point wo
print("whole:", bsdf.eval(ctx, si, wo))
for i in range(bsdf.component_count()):
    ctx.component = i
    print("component", i, bsdf.eval(ctx, si, wo))
"""
SIDE = """point wo component
print("value:", bsdf.eval(ctx, si, wo), "flags:", hex(int(bsdf.flags(ctx.component))))
"""
SAMPLE = """point component sample
print("flags:", hex(int(bsdf.flags(ctx.component))))
print("sample:", bs, "weight:", weight)
"""


def components(law: Law, case: Case) -> None:
    """Flags of components against what they do; their sum against the whole; ``ctx.component``."""
    bsdf, p = case.plugin, case.pairs
    flags = [int(bsdf.flags(i)) for i in range(bsdf.component_count())]
    apart = bin(np.bitwise_or.reduce(flags or [0]) ^ int(bsdf.flags())).count("1")
    what = "flags of the whole that no component has, or the other way around"
    law.at_most(what, apart, 0, "flags() is the union of flags(i)", case.snippet(FLAGS))
    if case.description is not None:
        copy, keys = case.load(), [key for key, _ in parameters(case)]
        params = mi.traverse(copy)
        for key, value in parameters(case):
            params[key] = type(value)(value)
        params.update()
        more = abs(copy.component_count() - len(flags))
        updated = case.snippet(UPDATED, keys=keys)
        law.at_most(
            "components more or fewer after params.update()",
            more,
            0,
            "an update says nothing about lobes",
            updated,
        )
    parts = [case.probe.eval(p.wi, p.wo, p.uv, context(i)) for i in range(len(flags))]
    error = excess(np.sum(parts, axis=0), p.value, case.spread(case.probe.eval, p.wi, p.wo, p.uv))
    law.most("sum of the components against the whole, relative", error, 1e-4, "a sum", case.at(PARTS, p))
    faults: dict[str, list[tuple[int, str]]] = {"eval()": [], "sample()": []}
    dark = 0
    for component, flag in enumerate(flags):
        value = parts[component]
        lit = (value != 0).any(axis=1)
        bad = lit & np.isfinite(value).all(axis=1) & ~_allowed(flag, p.wi, p.wo, smooth=True)
        show = case.at(SIDE, p, component=component)
        faults["eval()"].append((int(bad.sum()), show(int(bad.argmax()))))
        # samples of one component that go by another name, kind or side
        count = case.count(2**12, 2**14)
        wi, u, uv = case.units(count), case.uniform(count), case.rng.random((count, 2), np.float32)
        s = case.probe.sample(wi, u, uv, context(component))
        drawn = (s.weight != 0).any(axis=1) & np.isfinite(s.weight).all(axis=1)
        bad = (s.component != component) | ((s.type & ~flag) != 0) | (s.type == 0)
        clear = np.abs(s.wo[:, 2]) > 1e-6
        bad = drawn & (bad | clear & ~_allowed(flag, wi, s.wo, smooth=False))
        i = int(bad.argmax())
        show_one = case.snippet(SAMPLE, component=component, wi=wi[i], uv=uv[i], u=u[i], wo=s.wo[i])
        faults["sample()"].append((int(bad.sum()), show_one))
        # sides that flags name and where there is no light, of a component that has some
        z = np.concatenate([p.wi[lit, 2], wi[drawn, 2]])
        sides = (mi.BSDFFlags.FrontSide, (z > 0).any()), (mi.BSDFFlags.BackSide, (z < 0).any())
        dark += sum(bool(flag & int(side)) and len(z) > 0 and not seen for side, seen in sides)
    why = "reflection stays on its side, transmission crosses, lobes of one direction have no value"
    for kind, found in faults.items():
        total, show_worst = sum(count for count, _ in found), max(found, key=lambda fault: fault[0])[1]
        law.at_most(f"results of {kind} that contradict the component's flags", total, 0, why, show_worst)
    what = "sides that a component's flags name, and from which it is black"
    law.at_most(what, dark, 0, "a flag without a lobe", case.snippet(FLAGS))


def _allowed(flags: int, wi: Array, wo: Array, *, smooth: bool) -> Array:
    """Return where flags allow light; ``smooth``: but for single directions."""
    f = mi.BSDFFlags
    reflects: list[Any] = [f.DiffuseReflection, f.GlossyReflection]
    transmits: list[Any] = [f.DiffuseTransmission, f.GlossyTransmission]
    if not smooth:
        reflects, transmits = [*reflects, f.DeltaReflection], [*transmits, f.DeltaTransmission, f.Null]
    same, other = (any(flags & int(kind) for kind in kinds) for kinds in (reflects, transmits))
    front, back = bool(flags & int(f.FrontSide)), bool(flags & int(f.BackSide))
    return np.where(wi[:, 2] * wo[:, 2] > 0, same, other) & np.where(wi[:, 2] > 0, front, back)
