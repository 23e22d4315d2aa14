"""The two lobes of ``mrt_bsdf`` at a surface point, wherever its parameters come from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from .fresnel import f0_from_ior, fresnel_dielectric, fresnel_schlick
from .microfacet import (
    beckmann_d,
    half_vector_angles,
    microfacet_specular,
    sample_beckmann,
    sample_beckmann_visible,
    tan2_theta,
    visible_over_cos,
)

# Roughness below this (zero included) acts as this: the lobe is then narrower than float32 directions can
# resolve, and D, its inverse square, still fits. Above the other, D is the same everywhere but at the horizon
ALPHA_MIN, ALPHA_MAX = 1e-8, 1e6

# Directions that are nearer to the horizon count as below it: what divides by their cosines stays in float32
COS_MIN = 1e-12

# Indices of textures and of updates, whose values are not checked, are brought between these
IOR_MIN, IOR_MAX = 1e-9, 1e9


class Parameters(Protocol):
    """The parameters of an ``mrt_bsdf`` at a surface point; without f0, that of the indices of refraction."""

    @property
    def alpha(self) -> mi.Float: ...

    @property
    def int_ior(self) -> mi.Float: ...

    @property
    def ext_ior(self) -> mi.Float: ...

    @property
    def diffuse(self) -> mi.UnpolarizedSpectrum: ...

    @property
    def specular(self) -> mi.UnpolarizedSpectrum: ...

    @property
    def f0(self) -> mi.UnpolarizedSpectrum | None: ...


@dataclass
class Pair:
    """Two directions, above the surface where ``active``, and tan² of their half vector's angle to z."""

    wi: mi.Vector3f
    wo: mi.Vector3f
    tan2_theta_h: mi.Float
    active: mi.Bool

    @classmethod
    def above(
        cls, wi: mi.Vector3f, wo: mi.Vector3f, active: mi.Bool, tan2_theta_h: mi.Float | None = None
    ) -> Pair:
        """Return the pair with directions from below the surface masked."""
        above_i, above_o = wi.z > COS_MIN, active & (wo.z > COS_MIN)
        # Masked lanes get harmless directions: scalar variants raise on 0/0, and no NaN is born. What depends
        # on wi alone is computed once for all wo
        up = mi.Vector3f(0, 0, 1)
        wi, wo, active = dr.select(above_i, wi, up), dr.select(above_o, wo, up), above_i & above_o
        return cls(wi, wo, tan2_theta(wi + wo) if tan2_theta_h is None else tan2_theta_h, active)


class Lobes:
    """Value, density and samples of the lobes, seen from the local direction ``wi``."""

    def __init__(self, form: str, parameters: Parameters, wi: mi.Vector3f, *, visible: bool = True) -> None:
        self.form, self.parameters, self.wi, self.visible = form, parameters, wi, visible

    @cached_property
    def alpha(self) -> mi.Float:
        """The roughness within what float32 resolves."""
        alpha = self.parameters.alpha
        size = _within(dr.abs(alpha), ALPHA_MIN, ALPHA_MAX)
        return dr.select(alpha < 0, -size, size)

    def fresnel(self, cos_theta: mi.Float, sin2_theta: mi.Float) -> Any:
        """Return F at a microfacet: a float, or a spectrum where ``f0`` was given."""
        given = self.parameters
        if self.form == "unity":
            return mi.Float(1)
        ext_ior, int_ior = (_within(ior, IOR_MIN, IOR_MAX) for ior in (given.ext_ior, given.int_ior))
        if self.form == "dielectric":
            return fresnel_dielectric(cos_theta, ext_ior, int_ior, sin2_theta)
        f0 = f0_from_ior(ext_ior, int_ior) if given.f0 is None else given.f0
        return fresnel_schlick(cos_theta, f0, sin2_theta)

    @cached_property
    def mirror_reflectance(self) -> mi.UnpolarizedSpectrum:
        """k_s F(θi): what a perfect mirror in place of the lobe would reflect; 0 from behind."""
        above = self.wi.z > COS_MIN
        sin2_theta = dr.square(self.wi.x) + dr.square(self.wi.y)
        fresnel = self.fresnel(dr.select(above, self.wi.z, 1), dr.select(above, sin2_theta, 0))
        return dr.select(above, self.parameters.specular * fresnel, 0)

    def value(self, ctx: mi.BSDFContext, pair: Pair) -> mi.UnpolarizedSpectrum:
        """Return f cos θo of the enabled lobes."""
        diffuse, specular = _enabled(ctx)
        value = mi.UnpolarizedSpectrum(0)
        if specular:
            fresnel = self.fresnel(*half_vector_angles(pair.wi, pair.wo))
            lobe = microfacet_specular(pair.wi, pair.wo, pair.tan2_theta_h, self.alpha)
            value += self.parameters.specular * fresnel * lobe
        if diffuse:
            value += self.parameters.diffuse * (dr.inv_pi * pair.wo.z)
        # The report's G₁ of a negative roughness can be negative; light cannot
        return dr.select(pair.active, dr.maximum(value, 0), 0)

    def density(self, ctx: mi.BSDFContext, pair: Pair) -> mi.Float:
        """Return the density per solid angle with which ``sample`` draws ``pair.wo``."""
        diffuse, specular = _enabled(ctx)
        density, probability = mi.Float(0), self._specular_probability(ctx)
        if specular:
            density += probability * self._specular_density(pair)
        if diffuse:
            density += (1 - probability) * (dr.inv_pi * pair.wo.z)
        return dr.select(pair.active, density, 0)

    def sample(
        self, ctx: mi.BSDFContext, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, Pair, mi.Bool]:
        """Draw a direction; return it, its pair with ``wi``, and whether the specular lobe was drawn from."""
        above = active & (self.wi.z > COS_MIN)
        wi = dr.select(above, self.wi, mi.Vector3f(0, 0, 1))
        specular = sample1 < self._specular_probability(ctx)
        m = self._sample_normal(wi, sample2)
        lambertian = mi.warp.square_to_cosine_hemisphere(sample2)
        wo = dr.select(specular, mi.reflect(wi, m), lambertian)
        # The drawn normal *is* the half vector: of a narrow lobe, wi + wo has lost what sets it apart from n
        tan2_theta_h = dr.select(specular, tan2_theta(m), tan2_theta(wi + lambertian))
        return wo, Pair.above(wi, wo, above, tan2_theta_h), specular

    def _sample_normal(self, wi: mi.Vector3f, sample2: mi.Point2f) -> mi.Vector3f:
        if not self.visible:
            return sample_beckmann(self.alpha, sample2.x, sample2.y, mi.Vector3f)
        unit = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, 1.0)
        return sample_beckmann_visible(wi, self.alpha, sample2, unit.sample_visible_11, mi.Vector3f)

    def _specular_density(self, pair: Pair) -> mi.Float:
        """Return that of the microfacet normal over 4 ωo·h."""
        d = beckmann_d(pair.tan2_theta_h, self.alpha)
        if self.visible:
            return 0.25 * d * visible_over_cos(pair.wi, self.alpha)
        # D cos θh / (4 ωo·h), where h = ωi + ωo is not normalised: cos θh = h.z / |h|, ωo·h = |h|² / 2, and
        # |h|² = h.z² (1 + tan²θh). The product ωo·h itself would feel the rounding of ωo's length: by 2 % at
        # cos θ = 1e-3 in float32
        return 0.5 * d / ((pair.wi.z + pair.wo.z) * (1 + pair.tan2_theta_h))

    def _specular_probability(self, ctx: mi.BSDFContext) -> mi.Float:
        """Return the probability of the specular lobe, after the lobes' reflectances towards ``wi``."""
        diffuse, specular = _enabled(ctx)
        if not (diffuse and specular):
            return mi.Float(1 if specular else 0)
        weight = dr.abs(dr.mean(self.mirror_reflectance))
        total = weight + dr.abs(dr.mean(self.parameters.diffuse))
        return dr.select(total > 0, weight / dr.select(total > 0, total, 1), 0.5)


def _enabled(ctx: mi.BSDFContext) -> tuple[bool, bool]:
    """Return whether the diffuse and the specular lobe take part."""
    return (
        ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0),
        ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1),
    )


def _within(x: Any, least: float, most: float) -> Any:
    """Return ``x`` between two limits; NaN gives the lower one."""
    return dr.select(x >= least, dr.minimum(x, most), least)
