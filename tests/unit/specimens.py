"""Mistakes of BSDFs that checks must find, by name."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mrt_mitsuba.plugins.microfacet import tan2_theta
from mrt_mitsuba.plugins.variants import is_jit, updatable
from mrt_mitsuba.validation.studies.power import changed_bsdf

DIFFUSE, GLASS, MIRROR = {"type": "diffuse"}, {"type": "dielectric"}, {"type": "conductor"}
GLOSS = {"type": "roughconductor"}
GLOSSY, DELTA = (+flag for flag in (mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DeltaReflection))


def _value(change):
    """A change of values and weights that knows where light comes from and goes to."""
    return "value", lambda value, ctx, wi, wo: change(value, wi, wo)


def _sample(change):
    return "sample", lambda bs, weight, u, ctx: (bs, change(bs, weight, u, ctx))


def _member(name, change):
    """A change of samples: of one of their members."""

    def apply(bs, weight, u, ctx):
        setattr(bs, name, change(getattr(bs, name)))
        return bs, weight

    return "sample", apply


def _unscaled(bs, weight, u, ctx):
    return weight * bs.eta**2 if ctx.mode == mi.TransportMode.Radiance else weight


def _turned(wo):
    return mi.Vector3f(0.8 * wo.x - 0.6 * wo.y, 0.6 * wo.x + 0.8 * wo.y, wo.z)


def _brighter(value, wi, wo):
    return 1.8 * value * (1 + 0.56 * (1 - abs(wi.z)) ** 8) * (1 + 0.56 * (1 - abs(wo.z)) ** 8)


def _stairs(value, wi, wo):
    if not is_jit():
        return value
    step = dr.exp(dr.round(dr.log(value) * 1e5) * 1e-5)
    return value * dr.detach(dr.select(value > 0, step / value, 0))


def _steep(value, wi, wo):
    return value + dr.sqrt(dr.maximum(0, dr.select(wo.x > 0.7, value - dr.detach(value), 0)))


def _across(value, ctx, wi, wo):
    """Light or density where light would go through the surface."""
    return value + dr.select(wi.z * wo.z < 0, 0.1 * abs(wo.z), 0)


def _cancelling(value, wi, wo):
    """The slope of the half vector from a cosine near 1, as in the report."""
    h = wi + wo
    lost = dr.exp(100 * (tan2_theta(h) + 1 - 1 / dr.square(dr.normalize(h).z)))
    return dr.select(value > 0, value * lost, 0)


SWITCHES = [0]  # of variants, so far


def _switched(*variants):
    SWITCHES[0] += 1


# Sound BSDFs whose answers are changed: the BSDF, what is changed and how, and the figures that this exceeds
CHANGES = {
    # then it is no reciprocal value, and what sample() and eval() disagree on shows in the energy as well
    "missing cosine": (DIFFUSE, "eval", lambda value, ctx, wi, wo: value / abs(wo.z),
                       {"weights.weight", "energy.apart", "reciprocity.swapped"}),
    "weights missing": (DIFFUSE, *_sample(lambda bs, weight, u, ctx: dr.select(bs.wo.x > 0, 0, weight)),
                        {"weights.weight", "energy.apart"}),
    "NaN at grazing": (DIFFUSE, *_value(lambda value, wi, wo: dr.select(wo.z < 1e-3, dr.nan, value)),
                       {"finite.values"}),
    "no eta^2 in single directions": (GLASS, *_sample(_unscaled),
                                      {"reciprocity.single", "reciprocity.single_modes"}),
    "eta inverted": (GLASS, *_member("eta", lambda eta: 1 / eta),
                     {"reciprocity.single", "reciprocity.single_modes"}),
    "eta of 0": (GLOSS, *_member("eta", lambda eta: 0 * eta), {"reciprocity.medium"}),
    "directions not of length 1": (MIRROR, *_member("wo", lambda wo: 1.01 * wo), {"finite.samples"}),
    "mirror turned": (MIRROR, *_member("wo", _turned), {"reciprocity.returns"}),
    "mirror to the other side": (MIRROR, *_member("wo", lambda wo: wo * mi.Vector3f(1, 1, -1)),
                                 {"reciprocity.single", "components.samples"}),
    "mirror called glossy": (MIRROR, *_member("sampled_type", lambda kind: kind - DELTA + GLOSSY),
                             {"weights.density", "weights.weight", "energy.apart", "components.samples"}),
    "next component": (DIFFUSE, *_member("sampled_component", lambda i: i + 1), {"components.samples"}),
    "albedo 1.02 near the horizon": (DIFFUSE, *_value(_brighter), {"energy.largest"}),
    "stairs": (GLOSS, *_value(_stairs), {"roundoff.lost"}),
    "cancelling half vector": (GLOSS, *_value(_cancelling), {"roundoff.lost"}),
    "NaN at the least roughness": (
        GLOSS, *_value(lambda value, wi, wo: dr.select(value > 1e5, dr.nan, value)), {"finite.values"}),
    "updates ignored": (GLOSS, "stale", None, {"gradients.reached"}),
    "detached gradient": (GLOSS, *_value(lambda value, wi, wo: dr.detach(value)), {"gradients.values"}),
    # of directions that move with the roughness
    "derivative of the density in weights": (
        GLOSS,
        *_sample(lambda bs, weight, u, ctx: weight * dr.select(bs.pdf > 0, bs.pdf / dr.detach(bs.pdf), 1)),
        {"gradients.mean"}),
    "derivatives that are NaN": (GLOSS, *_value(_steep), {"gradients.values", "gradients.broken"}),
    "black back": (DIFFUSE, "flags", +mi.BSDFFlags.BackSide, {"components.dark"}),
    "a flag of no component": (DIFFUSE, "whole", +mi.BSDFFlags.Null, {"components.flags"}),
    "a component more with each update": (DIFFUSE, "update", None, {"components.updated"}),
    "active ignored": (DIFFUSE, "active", None, {"eval_pdf.inactive"}),
    "density through the surface": (DIFFUSE, "pdf", _across, {"sampling.cells", "sampling.integral"}),
    "light through the surface": (DIFFUSE, "eval", _across, {"components.values"}),
    "another value after each switch": (
        DIFFUSE, *_value(lambda value, wi, wo: value * (1 + 1e-3 * (SWITCHES[0] % 4))), {"switch.same"}),
}  # fmt: skip


def exceeded(check):
    """Return the figures of laws that are beyond their limits."""
    return {
        f"{law.name}.{part.figure}" for law in check.laws.values() for part in law.parts if not part.holds
    }


def register() -> None:
    """Define the classes anew for the current variant."""
    changed = changed_bsdf(CHANGES)

    class Stale(changed):
        """Updates of its parameter are ignored."""

        def __init__(self, props):
            alpha = props.get("alpha", 0.2)
            props["nested"], props["change"] = mi.load_dict({**GLOSS, "alpha": alpha}), ""
            self.alpha = updatable(alpha)
            changed.__init__(self, props)

        def traverse(self, callback):
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)

    mi.register_bsdf("changed", changed)
    mi.register_bsdf("stale", Stale)
    if not SWITCHES[0]:
        mi.detail.add_variant_callback(_switched)
        _switched()
