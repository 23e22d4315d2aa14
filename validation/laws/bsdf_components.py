"""Laws of the components of a BSDF, and of its values in other variants."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .bsdf_case import POINTWISE_TOL, BsdfCase, pair_errors, parameters
from .bsdf_snippets import SAMPLE, VALUE
from .faults import VEIL, larger, larger_by, member, of_sample
from .law import Outcome, Skip, finds, measures, most, number_of
from .probe import Array, Lanes, Probe, context, excess, method

FLAGS = "print([hex(int(bsdf.flags(i))) for i in range(bsdf.component_count())], hex(int(bsdf.flags())))\n"
UPDATED = """params = mi.traverse(bsdf)
print("components before:", bsdf.component_count())
for key in {keys}:
    params[key] = 0.9 * params[key]
params.update()
print("and after params.update():", bsdf.component_count())
"""
MASKED = """ctx.type_mask = {mask}
print("lobes of type", hex(ctx.type_mask), "alone:", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
for i in range(8):
    bs, weight = bsdf.sample(ctx, si, (i + 0.5) / 8, mi.Point2f(0.3, 0.6))
    print("a sample of type", hex(int(np.ravel(bs.sampled_type)[0])), "weight", weight)
"""
SIDES = "reflection stays on its side, transmission crosses, lobes of one direction have no value"
SELECTS = "ctx.type_mask selects lobes: integrators that treat some apart count others twice"


@larger_by
def in_first_component(ctx, *_):
    return ctx.component == 0


@larger_by
def with_mask(ctx, *_):
    """Where lobes are asked for by their types."""
    return ctx.type_mask != mi.BSDFContext().type_mask


def without_mask(size, ctx):
    """The types of lobes are ignored, whatever the size."""
    other = mi.BSDFContext()
    other.mode = ctx.mode
    other.component = ctx.component
    return other


@finds("sum", "a component brighter than its share", 1e-4, eval=in_first_component)
@finds("masked", "lobes brighter where they are asked for by type", 1e-4, eval=with_mask)
@finds("masked_samples", "types of lobes ignored", 1, context=without_mask)
@measures(
    flags=most(
        "flags of the whole that no component has, or the other way around",
        0,
        "flags() is the union of flags(i)",
        FLAGS,
    ),
    updated=most(
        "components more or fewer after params.update()", 0, "an update says nothing about lobes", UPDATED
    ),
    sum=most("sum of the components against the whole, relative", 1e-4, "a sum", VALUE),
    values=number_of("results of eval() that contradict the flags of component {component}", 0, SIDES, VALUE),
    samples=number_of(
        "results of sample() that contradict the flags of component {component}", 0, SIDES, FLAGS + SAMPLE
    ),
    dark=most(
        "sides that a component's flags name, and from which it is black", 0, "a flag without a lobe", FLAGS
    ),
    masked=most(
        "value of lobes of type {mask:#x} against the sum of such components, relative", 1e-4, SELECTS, MASKED
    ),
    masked_samples=number_of(
        "samples and densities of lobes that the mask of types {mask:#x} leaves out", 0, SELECTS, MASKED
    ),
)
def components(law: Outcome, case: BsdfCase) -> None:
    """A component does what its flags say; f = Σ fᵢ; ``component`` and ``type_mask`` of ``ctx`` select."""
    bsdf = case.plugin
    p = case.pairs
    flags = [bsdf.flags(i) for i in range(bsdf.component_count())]
    union = int(np.bitwise_or.reduce(flags or [0]))
    law.check("flags", (union ^ bsdf.flags()).bit_count())
    if case.description is not None:
        copy = case.load()
        old = dict(parameters(case))
        mi.traverse(copy).update({key: type(value)(value) for key, value in old.items()})
        law.check("updated", abs(copy.component_count() - len(flags)), keys=list(old))
    parts = [case.eval(p, context(i)) for i in range(len(flags))]
    law.check("sum", excess(np.sum(parts, axis=0), p.value, p.value_off), p)
    dark = 0
    for i, (flag, value) in enumerate(zip(flags, parts, strict=True)):
        dark += _component(law, case, i, flag, value)
    law.check("dark", dark)
    _masks(law, case, flags, parts)


def _component(law: Outcome, case: BsdfCase, i: int, flag: int, value: Array) -> int:
    """Check values and samples of a component against its flags; return how many sides of these are black."""
    p = case.pairs
    lit = (value != 0).any(axis=1)
    bad = lit & np.isfinite(value).all(axis=1) & ~_allowed(flag & ~mi.BSDFFlags.Delta, p)
    law.check("values", bad, p, component=i)
    # samples of one component that go by another name, kind or side
    s = case.sample(case.at_random(2**12, 2**14), context(i))
    drawn = s.lit & np.isfinite(s.weight).all(axis=1)
    bad = (s.lobe != i) | ((s.flags & ~flag) != 0) | (s.flags == 0)
    bad |= (abs(s.wo[:, 2]) > 1e-6) & ~_allowed(flag, s)
    law.check("samples", drawn & bad, s, component=i)
    # sides that flags name and where there is no light, of a component that has some
    z = np.concatenate([p.wi[lit, 2], s.wi[drawn, 2]])
    if not len(z):
        return 0
    front = mi.has_flag(flag, mi.BSDFFlags.FrontSide) and not (z > 0).any()
    back = mi.has_flag(flag, mi.BSDFFlags.BackSide) and not (z < 0).any()
    return front + back


def _allowed(flags: int, at: Lanes) -> Array:
    """Where flags allow light from ``wi`` to ``wo``. [N], bool"""
    same_side = at.wi[:, 2] * at.wo[:, 2] > 0
    way = np.where(same_side, mi.BSDFFlags.Reflection, mi.BSDFFlags.Transmission)
    side = np.where(at.wi[:, 2] > 0, mi.BSDFFlags.FrontSide, mi.BSDFFlags.BackSide)
    return ((flags & way) != 0) & ((flags & side) != 0)


def _masks(law: Outcome, case: BsdfCase, flags: list[int], parts: list[Array]) -> None:
    """With a mask of types, a BSDF is the sum of the components of these types."""
    every = mi.BSDFFlags.All
    kinds = [flag & every for flag in flags]
    p = case.pairs
    few = case.few(p, 2**12, 2**13)
    for mask in sorted({*kinds, *(every & ~kind for kind in kinds)} - {0}):
        ctx = context(type_mask=mask)
        chosen = [part for kind, part in zip(kinds, parts, strict=True) if kind & ~mask == 0]
        expected = np.sum([np.zeros_like(p.value), *chosen], axis=0)
        value, pdf = case.both(p, ctx)
        law.check("masked", excess(value, expected, p.value_off), p, mask=mask)
        s = case.sample(few.having(u=case.uniform(len(few.wi), 3)), ctx)
        bad = s.lit & np.isfinite(s.weight).all(axis=1) & ((s.flags & ~mask) != 0)
        if not chosen:
            bad |= pdf[: len(bad)] > 0
        law.check("masked_samples", bad, few, mask=mask)


NULL = """print("eval_null_transmission():", bsdf.eval_null_transmission(si))
for i in range(8):
    bs, weight = bsdf.sample(ctx, si, (i + 0.5) / 8, mi.Point2f(0.3, 0.6))
    through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    print("a sample straight through:", through, "to", bs.wo, "probability x weight:", bs.pdf * weight)
"""
STRAIGHT = "integrators follow shadow rays through surfaces by it; where it is 0, what lies behind is black"


@finds("each", "eval_null_transmission() too large", 3e-3, nested=VEIL, null=larger)
@finds(
    "straight", "directions off the straight one", 3e-3, nested=VEIL, sample=of_sample(member("wo", larger))
)
@measures(
    each=most(
        "eval_null_transmission() against probability x weight of a sample straight through, relative",
        POINTWISE_TOL,
        STRAIGHT,
        NULL,
    ),
    straight=most("direction of a sample straight through off -wi", 1e-3, "the flag Null says so", NULL),
)
def null_transmission(law: Outcome, case: BsdfCase) -> None:
    """``eval_null_transmission`` is the light that a lobe of type ``Null`` lets through, 0 without one."""
    value = method(case.plugin, "eval_null_transmission")

    def through(_: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Vector3f) -> mi.Spectrum:
        return value(si)

    lobes = range(case.plugin.component_count())
    count = sum(bool(case.plugin.flags(i) & mi.BSDFFlags.Null) for i in lobes)
    s = case.sample(case.at_random(2**14, 2**17))
    (stated,) = case.ask(through, s, given="u")
    passes = s.lit & ((s.flags & mi.BSDFFlags.Null) != 0)
    if passes.any():
        law.check("straight", abs(s.wo + s.wi).max(axis=1), s, where=passes)
    if count > 1:
        law.notes.append("several lobes let light straight through: their sum is not checked")
    else:
        expected = np.where(count, s.weight * s.pdf[:, None], 0)
        law.check("each", excess(expected, stated), s, where=passes if count else True)


def by_variant(size, value, *_):
    """Larger in scalar variants."""
    return value if dr.is_jit_v(value) else (1 + size) * value


@finds("same", "values larger in scalar variants", 3e-3, value=by_variant)
@measures(
    same=most(
        "value and density in {other} against {here}, relative, beyond rounding",
        POINTWISE_TOL,
        "the same formula",
        VALUE,
    )
)
def variants(law: Outcome, case: BsdfCase) -> None:
    """Values are the same in the scalar variant, and in the spectral one where colours are grey."""
    here = mi.variant()
    case.with_()
    few = case.few(case.pairs[np.isfinite(case.pairs.value).all(axis=1)], 200, 800)
    grey = np.ptp(few.value, axis=1).max() <= 1e-5 * few.value.max()
    others = [case.other_kind]
    if here.endswith("_rgb") and grey:
        others.append(here.replace("_rgb", "_spectral"))
    for other in others:
        try:
            value, pdf = case.elsewhere(other, lambda: Probe(case.load()).both(few))
        except Skip as reason:
            law.notes.append(str(reason))
            continue
        expected = few
        if not other.endswith("_rgb"):  # the mean of equal channels, however many there are
            value = value.mean(axis=1)
            expected = few.having(value=few.value.mean(axis=1), value_off=few.value_off.max(axis=1))
        law.check(
            "same", pair_errors(expected, value, pdf), few, variants=(here, other), other=other, here=here
        )


@measures(
    same=most(
        "values of the BSDF {which} after a switch to {other} and back, relative, beyond rounding",
        1e-4,
        "the same formula with the same numbers",
        VALUE,
    )
)
def switch(law: Outcome, case: BsdfCase) -> None:
    """Values are the same after a switch to another variant and back, loaded before it or anew."""
    here = mi.variant()
    few = case.few(case.pairs, 1000, 1000)
    other = next(v for v in mi.variants() if v.startswith("scalar_") and v != here)
    mi.set_variant(other)
    mi.set_variant(here)
    candidates = {"that was loaded before": case.plugin}
    if case.description is not None:
        candidates["loaded anew"] = case.load()
    for which, bsdf in candidates.items():
        error = pair_errors(few, *Probe(bsdf).both(few))
        law.check("same", error, few, which=which, other=other, variants=(here, other, here))
