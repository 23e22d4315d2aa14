"""A sound BSDF of two lobes, and the mistakes that checks must find, by name."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mrt_mitsuba.plugins.microfacet import beckmann_d, smith_g1, smith_g1_over_cos, tan2_theta
from mrt_mitsuba.plugins.variants import first, is_jit, updatable

# Each mistake, and the laws that it breaks: a value without its cosine is no reciprocal one, and what
# sample() and eval() disagree on shows in the energy as well
MISTAKES = {
    "missing cosine": {"weights", "energy", "reciprocity"},
    "density x 1.1": {"sampling", "energy"},
    "weight of one lobe missing": {"weights", "energy"},
    "not reciprocal": {"reciprocity"},
    "albedo 1.05": {"energy"},
    "NaN at grazing": {"finite"},
    "eval_pdf unlike eval": {"eval_pdf"},
    "detached gradient": {"gradients"},
    "wrong hemisphere flag": {"components"},
    "cancelling half vector": {"roundoff"},
}


def register() -> None:
    """Define the class anew for the current variant."""

    class Specimen(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.mistake = props.get("mistake", "")
            self.alpha = updatable(props.get("alpha", 0.2))
            self.kd, self.ks = (1.05, 0.0) if self.mistake == "albedo 1.05" else (0.4, 0.4)
            f = mi.BSDFFlags
            diffuse = (
                f.DiffuseTransmission if self.mistake == "wrong hemisphere flag" else f.DiffuseReflection
            )
            self.m_components = [diffuse | f.FrontSide, f.GlossyReflection | f.FrontSide]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback):
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            pass

        def lobes(self, ctx, wi, wo, active):
            """f cos θo, and the density of plain sampling of D, for both directions above."""
            alpha = self.alpha if is_jit() else first(self.alpha)
            if self.mistake == "detached gradient":
                alpha = dr.detach(alpha)
            active = active & (wi.z > 1e-7) & (wo.z > 1e-7)
            up = mi.Vector3f(0, 0, 1)
            wi, wo = dr.select(active, wi, up), dr.select(active, wo, up)
            tan2 = tan2_theta(wi + wo)
            if self.mistake == "cancelling half vector":
                c2 = dr.square(dr.normalize(wi + wo).z)
                tan2 = (1 - c2) / c2
            d = beckmann_d(tan2, alpha)
            diffuse, glossy = (ctx.component in (0xFFFFFFFF, i) for i in range(2))
            value = self.kd * dr.inv_pi * wo.z if diffuse else 0
            value += 0.25 * self.ks * d * smith_g1_over_cos(wi, alpha) * smith_g1(wo, alpha) if glossy else 0
            share = 0.5 if diffuse and glossy else float(glossy)
            pdf = (1 - share) * dr.inv_pi * wo.z + share * 0.5 * d / ((wi.z + wo.z) * (1 + tan2))
            if self.mistake == "missing cosine":
                value /= wo.z
            if self.mistake == "not reciprocal":
                value *= 0.5 + 0.5 * wi.z
            if self.mistake == "NaN at grazing":
                value = dr.select(wo.z < 1e-3, dr.nan, value)
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(self.lobes(ctx, si.wi, wo, active)[0])

        def pdf(self, ctx, si, wo, active=True):
            return self.lobes(ctx, si.wi, wo, active)[1] * (1.1 if self.mistake == "density x 1.1" else 1)

        def eval_pdf(self, ctx, si, wo, active=True):
            unlike = 1.2 if self.mistake == "eval_pdf unlike eval" else 1
            return unlike * self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            diffuse, glossy = (ctx.component in (0xFFFFFFFF, i) for i in range(2))
            second = sample1 < (0.5 if diffuse and glossy else float(glossy))
            tan = (self.alpha if is_jit() else first(self.alpha)) * dr.sqrt(-dr.log(1 - sample2.x))
            sin, cos = dr.sincos(2 * dr.pi * sample2.y)
            m = dr.normalize(mi.Vector3f(tan * cos, tan * sin, 1))
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(second, mi.reflect(si.wi, m), mi.warp.square_to_cosine_hemisphere(sample2))
            bs.eta = mi.Float(1)
            bs.sampled_component = dr.select(second, mi.UInt32(1), mi.UInt32(0))
            bs.sampled_type = dr.select(
                second, mi.UInt32(+self.m_components[1] & 0x1FF), mi.UInt32(+self.m_components[0] & 0x1FF)
            )
            bs.pdf = self.pdf(ctx, si, bs.wo, active)
            value = self.lobes(ctx, si.wi, bs.wo, active)[0]
            if self.mistake == "missing cosine":
                value *= bs.wo.z
            if self.mistake == "weight of one lobe missing":
                value = dr.select(second, 0, value)
            drawn = bs.pdf > 0
            return bs, mi.Spectrum(dr.select(drawn, value / dr.select(drawn, bs.pdf, 1), 0))

        def to_string(self):
            return f"Specimen[{self.mistake or 'sound'}]"

    mi.register_bsdf("specimen", Specimen)
