"""``mrt_bsdf``: the report's reflectance model as a Mitsuba BSDF."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .fresnel import f0_from_ior, fresnel_dielectric, fresnel_schlick
from .microfacet import (
    beckmann_d,
    half_vector_angles,
    microfacet_specular,
    sample_beckmann,
    sample_beckmann_visible,
    smith_g1_over_cos,
    tan2_theta,
)
from .parameters import ParameterError, choice, flag, number
from .variants import first

FRESNEL_FORMS = ("schlick", "dielectric", "unity")

# Roughness below this (zero included) acts as this: the lobe is then narrower than float32 directions can resolve,
# and D, its square, still fits
ALPHA_MIN = 1e-8


class MrtBSDF(mi.BSDF):
    r"""Lambertian base under a Beckmann microfacet lobe, as in the original ray tracer.

    .. math::
        f = \frac{k_d}{\pi} + k_s \frac{F(\omega_i \cdot h)\, D(h)\, G_1(\omega_i) G_1(\omega_o)}
                                       {4 \cos\theta_i \cos\theta_o}

    with Beckmann's D, the rational fit of Smith's G₁ (Walter et al. 2007) and one of three Fresnel terms. The two
    lobes are simply added, so energy is conserved only where k_d and k_s promise it.

    ======================== ================= =========== =====================================================
    name                     type              default     unit or range
    ======================== ================= =========== =====================================================
    ``alpha``                float or texture  0.1         roughness; 0 acts as 1e-8, a negative value keeps its
                                                           sign in G₁ (scene 2 of the report holds some)
    ``int_ior``              float or texture  1.5         > 0, index of refraction inside
    ``ext_ior``              float or texture  1.0         > 0, index of refraction outside
    ``diffuse_reflectance``  spectrum/texture  0.5         k_d, may exceed 1
    ``specular_reflectance`` spectrum/texture  1.0         k_s, may exceed 1
    ``fresnel``              string            schlick     ``schlick``, ``dielectric`` (exact) or ``unity`` (F = 1)
    ``f0``                   spectrum/texture  from IORs   Schlick only: reflectance at normal incidence
    ``sample_visible``       boolean           true        sample visible normals instead of D
    ======================== ================= =========== =====================================================

    .. code-block:: python

        {'type': 'mrt_bsdf', 'alpha': 0.06, 'int_ior': 1.38,
         'diffuse_reflectance': {'type': 'rgb', 'value': [0.2, 0.4, 0.3]},
         'specular_reflectance': {'type': 'rgb', 'value': 0.2}}

    .. code-block:: xml

        <bsdf type="mrt_bsdf">
            <float name="alpha" value="0.06"/>
            <float name="int_ior" value="1.38"/>
            <rgb name="diffuse_reflectance" value="0.2, 0.4, 0.3"/>
            <rgb name="specular_reflectance" value="0.2"/>
        </bsdf>

    Nearest stock plugins: ``roughconductor`` (same D and G, exact conductor Fresnel, no diffuse part) and
    ``roughplastic`` (same lobes, but the diffuse part is refracted through the interface). Reflection is on the side of
    the normal only. The attribute ``mirror_reflectance`` (``eval_attribute``) is k_s F(θi), the weight that
    ``mrt_whitted`` gives to the mirror ray, and ``int_ior`` (``eval_attribute_1``) drives its bounce budget.
    In polarised variants the reflected light is depolarised.
    """

    def __init__(self, props: mi.Properties):
        mi.BSDF.__init__(self, props)
        self.fresnel = choice(props, "fresnel", FRESNEL_FORMS)
        self.int_ior = self._number_or_texture(props, "int_ior", 1.5, above=0)
        self.ext_ior = self._number_or_texture(props, "ext_ior", 1.0, above=0)
        self.alpha = self._number_or_texture(props, "alpha", 0.1)
        self.diffuse_reflectance = props.get_unbounded_texture("diffuse_reflectance", 0.5)
        self.specular_reflectance = props.get_unbounded_texture("specular_reflectance", 1.0)
        self.f0 = props.get_unbounded_texture("f0") if "f0" in props else None
        self.sample_visible = flag(props, "sample_visible", True)
        self._update()

    @staticmethod
    def _number_or_texture(props, name, default, **limits):
        if name in props and props.type(name) == mi.Properties.Type.Object:
            return props.get_unbounded_texture(name)
        return mi.Float(number(props, name, default, **limits))

    def _update(self) -> None:
        # Opaque numbers travel as data: instances share one compiled function, and new values need no new kernel
        dr.make_opaque(*(p for p in (self.alpha, self.int_ior, self.ext_ior) if not isinstance(p, mi.Texture)))
        diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if self._varies(self.diffuse_reflectance):
            diffuse |= mi.BSDFFlags.SpatiallyVarying
        if self._varies(self.specular_reflectance, self.alpha, self.int_ior, self.ext_ior, self.f0):
            glossy |= mi.BSDFFlags.SpatiallyVarying
        self.m_components = [diffuse, glossy]
        self.m_flags = diffuse | glossy

    @staticmethod
    def _varies(*parameters) -> bool:
        return any(isinstance(p, mi.Texture) and p.is_spatially_varying() for p in parameters)

    def traverse(self, callback) -> None:
        flags = mi.ParamFlags.Differentiable
        for name in ("alpha", "int_ior", "ext_ior", "diffuse_reflectance", "specular_reflectance"):
            callback.put(name, getattr(self, name), flags)
        if self.f0 is not None:
            callback.put("f0", self.f0, flags)

    def parameters_changed(self, keys=()) -> None:
        self._update()

    # ------------------------------- Parameter values at a surface point -------------------------------

    @staticmethod
    def _value(parameter, si, active):
        return parameter.eval_1(si, active) if isinstance(parameter, mi.Texture) else parameter

    def _alpha(self, si, active):
        alpha = self._value(self.alpha, si, active)
        return dr.select(dr.abs(alpha) >= ALPHA_MIN, alpha, dr.select(alpha < 0, -ALPHA_MIN, ALPHA_MIN))

    def _fresnel(self, si, cos_theta, sin2_theta, active):
        """F at a microfacet: a float, or a spectrum where ``f0`` was given."""
        if self.fresnel == "unity":
            return mi.Float(1)
        ext_ior, int_ior = self._value(self.ext_ior, si, active), self._value(self.int_ior, si, active)
        if self.fresnel == "dielectric":
            return fresnel_dielectric(cos_theta, ext_ior, int_ior, sin2_theta)
        f0 = f0_from_ior(ext_ior, int_ior) if self.f0 is None else self.f0.eval(si, active)
        return fresnel_schlick(cos_theta, f0, sin2_theta)

    def _mirror_reflectance(self, si, active):
        """k_s F(θi): what a perfect mirror in place of the lobe would reflect."""
        sin2_theta = dr.square(si.wi.x) + dr.square(si.wi.y)
        fresnel = self._fresnel(si, mi.Frame3f.cos_theta(si.wi), sin2_theta, active)
        return self.specular_reflectance.eval(si, active) * fresnel

    def _specular_probability(self, ctx, si, active):
        """Probability of drawing from the specular lobe, after the lobes' reflectances towards ``si.wi``."""
        diffuse, specular = self._enabled(ctx)
        if not (diffuse and specular):
            return mi.Float(1 if specular else 0)
        specular = dr.abs(dr.mean(self._mirror_reflectance(si, active)))
        total = specular + dr.mean(self.diffuse_reflectance.eval(si, active))
        return dr.select(total > 0, specular / dr.select(total > 0, total, 1), 0.5)

    @staticmethod
    def _enabled(ctx) -> tuple[bool, bool]:
        return (ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0), ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1))

    # -------------------------------------- Value and density ------------------------------------------

    def _eval_pdf(self, ctx, si, wo, tan2_theta_h, active):
        """(f cos θo, density) of the enabled lobes; ``tan2_theta_h`` is that of the half vector."""
        diffuse, specular = self._enabled(ctx)
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0) & (cos_o > 0)
        # Masked lanes get harmless directions: scalar variants raise on 0/0, and no NaN is born to be selected away
        up = mi.Vector3f(0, 0, 1)
        wi, wo = dr.select(active, si.wi, up), dr.select(active, wo, up)
        value, pdf = mi.UnpolarizedSpectrum(0), mi.Float(0)
        probability = self._specular_probability(ctx, si, active)
        if specular:
            alpha = self._alpha(si, active)
            fresnel = self._fresnel(si, *half_vector_angles(wi, wo), active)
            ks = self.specular_reflectance.eval(si, active)
            value += ks * fresnel * microfacet_specular(wi, wo, tan2_theta_h, alpha)
            pdf += probability * self._specular_pdf(wi, wo, tan2_theta_h, alpha)
        if diffuse:
            lambert = dr.inv_pi * mi.Frame3f.cos_theta(wo)
            value += self.diffuse_reflectance.eval(si, active) * lambert
            pdf += (1 - probability) * lambert
        return dr.select(active, value, 0), dr.select(active, pdf, 0)

    def _specular_pdf(self, wi, wo, tan2_theta_h, alpha):
        """Density of the reflected direction: that of the microfacet normal over 4 ωo·h."""
        d = beckmann_d(tan2_theta_h, alpha)
        if self.sample_visible:
            return 0.25 * d * smith_g1_over_cos(wi, dr.abs(alpha))
        # D cos θh / (4 ωo·h) with cos θh = h.z / |h| and ωo·h = |h| / 2, h = ωi + ωo not normalised
        return 0.5 * d * (wi.z + wo.z) / dr.squared_norm(wi + wo)

    def eval_pdf(self, ctx, si, wo, active=True):
        value, pdf = self._eval_pdf(ctx, si, wo, tan2_theta(si.wi + wo), active)
        return mi.depolarizer(value), pdf

    def eval(self, ctx, si, wo, active=True):
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx, si, wo, active=True):
        return self.eval_pdf(ctx, si, wo, active)[1]

    # ------------------------------------------- Sampling ----------------------------------------------

    def sample(self, ctx, si, sample1, sample2, active=True):
        cos_i = mi.Frame3f.cos_theta(si.wi)
        active = active & (cos_i > 0)
        wi = dr.select(active, si.wi, mi.Vector3f(0, 0, 1))
        probability = self._specular_probability(ctx, si, active)
        pick_specular = sample1 < probability
        m = self._sample_normal(si, wi, sample2, active)
        mirrored = mi.reflect(wi, m)
        lambertian = mi.warp.square_to_cosine_hemisphere(sample2)
        bs = mi.BSDFSample3f()
        bs.wo = dr.select(pick_specular, mirrored, lambertian)
        # The drawn normal *is* the half vector: for narrow lobes wi + wo has lost what distinguishes it from n
        tan2_h = dr.select(pick_specular, tan2_theta(m), tan2_theta(wi + lambertian))
        value, pdf = self._eval_pdf(ctx, si, bs.wo, tan2_h, active)
        bs.pdf = pdf
        bs.eta = mi.Float(1)
        bs.sampled_component = dr.select(pick_specular, mi.UInt32(1), mi.UInt32(0))
        bs.sampled_type = dr.select(
            pick_specular, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection))
        drawn = active & (pdf > 0)
        weight = dr.select(drawn, value / dr.select(drawn, pdf, 1), 0)
        return bs, mi.depolarizer(weight)

    def _sample_normal(self, si, wi, sample2, active):
        alpha = self._alpha(si, active)
        if not self.sample_visible:
            return sample_beckmann(alpha, sample2.x, sample2.y, mi.Vector3f)
        unit = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, 1.0)
        return sample_beckmann_visible(wi, alpha, sample2, unit.sample_visible_11, mi.Vector3f)

    # ------------------------------------------ Attributes ---------------------------------------------

    def eval_diffuse_reflectance(self, si, active=True):
        return self.diffuse_reflectance.eval(si, active)

    def has_attribute(self, name, active=True):
        return name in ("mirror_reflectance", "int_ior")

    def eval_attribute(self, name, si, active=True):
        if name == "mirror_reflectance":
            return self._mirror_reflectance(si, active)
        raise ParameterError(f'mrt_bsdf: no spectrum attribute "{name}"; there is "mirror_reflectance"')

    def eval_attribute_1(self, name, si, active=True):
        if name == "int_ior":
            return self._value(self.int_ior, si, active)
        raise ParameterError(f'mrt_bsdf: no scalar attribute "{name}"; there is "int_ior"')

    def mirror_bound(self) -> tuple[float, float]:
        """An upper bound of ``mirror_reflectance``, and ``int_ior``; infinite where they vary or are not known."""
        reflectance = int_ior = float("inf")
        if not (self.specular_reflectance.is_spatially_varying() or mi.is_spectral):
            reflectance = max(map(first, self.specular_reflectance.eval(dr.zeros(mi.SurfaceInteraction3f))))
        if not isinstance(self.int_ior, mi.Texture):
            int_ior = first(self.int_ior)
        return reflectance, int_ior

    def to_string(self) -> str:
        names = ("alpha", "int_ior", "ext_ior", "diffuse_reflectance", "specular_reflectance", "f0")
        return f"MrtBSDF[fresnel={self.fresnel}, " + ", ".join(f"{n}={getattr(self, n)}" for n in names) + "]"


mi.register_bsdf("mrt_bsdf", MrtBSDF)
