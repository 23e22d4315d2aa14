"""A sound BSDF, and the mistakes that checks must find, by name."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mrt_mitsuba.plugins.microfacet import beckmann_d, smith_g1, smith_g1_over_cos, tan2_theta
from mrt_mitsuba.plugins.variants import first, is_jit, updatable
from mrt_mitsuba.validation.studies.power import changed_bsdf

# Mistakes of the specimen, and the figures of the laws that each exceeds
MISTAKES = {
    "NaN at roughness 0": {"finite.values"},
    "detached gradient": {"gradients.values"},
    "update ignored": {"gradients.reached"},
    "wrong hemisphere flag": {"components.values", "components.samples"},
    "cancelling half vector": {"roundoff.lost"},
}


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


def _below(pdf, ctx, wi, wo):
    return pdf + dr.select((wi.z > 0) & (wo.z < 0), -0.1 * wo.z, 0)


SWITCHES = [0]  # of variants, so far


def _switched(*variants):
    SWITCHES[0] += 1


# Sound BSDFs whose answers are changed: the BSDF, what is changed and how, and the figures that this exceeds
CHANGES = {
    # then it is no reciprocal value, and what sample() and eval() disagree on shows in the energy as well
    "missing cosine": (
        DIFFUSE,
        *("eval", lambda value, ctx, wi, wo: value / abs(wo.z)),
        {"weights.weight", "energy.apart", "reciprocity.swapped"},
    ),
    "weights missing": (
        DIFFUSE,
        *_sample(lambda bs, weight, u, ctx: dr.select(bs.wo.x > 0, 0, weight)),
        {"weights.weight", "energy.apart"},
    ),
    "NaN at grazing": (
        DIFFUSE,
        *_value(lambda value, wi, wo: dr.select(wo.z < 1e-3, dr.nan, value)),
        {"finite.values"},
    ),
    "no eta^2 in single directions": (
        GLASS,
        *_sample(_unscaled),
        {"reciprocity.single", "reciprocity.single_modes"},
    ),
    "eta inverted": (
        GLASS,
        *_member("eta", lambda eta: 1 / eta),
        {"reciprocity.single", "reciprocity.single_modes"},
    ),
    "eta of 0": (GLOSS, *_member("eta", lambda eta: 0 * eta), {"reciprocity.medium"}),
    "directions not of length 1": (MIRROR, *_member("wo", lambda wo: 1.01 * wo), {"finite.samples"}),
    "mirror turned": (MIRROR, *_member("wo", _turned), {"reciprocity.returns"}),
    "mirror called glossy": (
        MIRROR,
        *_member("sampled_type", lambda kind: kind - DELTA + GLOSSY),
        {"weights.density", "weights.weight", "energy.apart", "components.samples"},
    ),
    "next component": (DIFFUSE, *_member("sampled_component", lambda i: i + 1), {"components.samples"}),
    "albedo 1.02 near the horizon": (DIFFUSE, *_value(_brighter), {"energy.largest"}),
    "stairs": (GLOSS, *_value(_stairs), {"roundoff.lost"}),
    # of directions that move with the roughness
    "derivative of the density in weights": (
        {"type": "specimen"},
        *_sample(lambda bs, weight, u, ctx: weight * dr.select(bs.pdf > 0, bs.pdf / dr.detach(bs.pdf), 1)),
        {"gradients.mean"},
    ),
    "derivatives that are NaN": (
        {"type": "specimen"},
        *_value(_steep),
        {"gradients.values", "gradients.broken"},
    ),
    "black back": (DIFFUSE, "flags", +mi.BSDFFlags.BackSide, {"components.dark"}),
    "a flag of no component": (DIFFUSE, "whole", +mi.BSDFFlags.Null, {"components.flags"}),
    "a component more with each update": (DIFFUSE, "update", None, {"components.updated"}),
    "active ignored": (DIFFUSE, "active", None, {"eval_pdf.inactive"}),
    "density below the horizon": (DIFFUSE, "pdf", _below, {"sampling.cells", "sampling.integral"}),
    "another value after each switch": (
        DIFFUSE,
        *_value(lambda value, wi, wo: value * (1 + 1e-3 * (SWITCHES[0] % 4))),
        {"switch.same"},
    ),
}


def exceeded(check):
    """Return the figures of laws that are beyond their limits."""
    return {
        f"{law.name}.{part.figure}" for law in check.laws.values() for part in law.parts if not part.holds
    }


def register() -> None:
    """Define the classes anew for the current variant."""
    mi.register_bsdf("changed", changed_bsdf(CHANGES))
    mi.register_bsdf("specimen", _specimen())
    if not SWITCHES[0]:
        mi.detail.add_variant_callback(_switched)
        _switched()


def _specimen() -> type:
    class Specimen(mi.BSDF):
        """A rough reflection that is sampled plainly, by D."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.mistake = props.get("mistake", "")
            self.alpha = updatable(props.get("alpha", 0.2))
            self.derived = 1 * self.alpha
            f = mi.BSDFFlags
            wrong = self.mistake == "wrong hemisphere flag"
            self.m_flags = f.FrontSide | (f.GlossyTransmission if wrong else f.GlossyReflection)
            self.m_components = [self.m_flags]

        def traverse(self, callback):
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            pass

        def roughness(self):
            alpha = self.derived if self.mistake == "update ignored" else self.alpha
            alpha = alpha if is_jit() else first(alpha)
            return alpha if self.mistake == "NaN at roughness 0" else dr.maximum(alpha, 1e-4)

        def eval_pdf(self, ctx, si, wo, active=True):
            alpha, up = self.roughness(), mi.Vector3f(0, 0, 1)
            if self.mistake == "detached gradient":
                alpha = dr.detach(alpha)
            active = active & (si.wi.z > 1e-7) & (wo.z > 1e-7)
            wi, wo = dr.select(active, si.wi, up), dr.select(active, wo, up)
            tan2 = tan2_theta(wi + wo)
            if self.mistake == "cancelling half vector":
                c2 = dr.square(dr.normalize(wi + wo).z)
                tan2 = (1 - c2) / c2
            d = beckmann_d(tan2, alpha)
            value = 0.2 * d * smith_g1_over_cos(wi, alpha) * smith_g1(wo, alpha)
            pdf = 0.5 * d / ((wi.z + wo.z) * (1 + tan2))
            return mi.Spectrum(dr.select(active, value, 0)), dr.select(active, pdf, 0)

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def sample(self, ctx, si, sample1, sample2, active=True):
            tan = self.roughness() * dr.sqrt(-dr.log(1 - sample2.x))
            sin, cos = dr.sincos(2 * dr.pi * sample2.y)
            bs = mi.BSDFSample3f()
            bs.wo = mi.reflect(si.wi, dr.normalize(mi.Vector3f(tan * cos, tan * sin, 1)))
            bs.eta, bs.sampled_component = mi.Float(1), mi.UInt32(0)
            bs.sampled_type = mi.UInt32(+self.m_flags & 0x1FF)
            value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
            drawn = bs.pdf > 0
            return bs, dr.select(drawn, value / dr.select(drawn, bs.pdf, 1), 0)

        def to_string(self):
            return f"Specimen[{self.mistake or 'sound'}]"

    return Specimen
