"""The lobes of ``mrt_bsdf``: a table of them, and their value, density and samples at a surface point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi

from .fresnel import f0_from_ior, fresnel_dielectric, fresnel_schlick
from .microfacet import GGX, Beckmann, half_vector_angles, microfacet_specular, tan2_theta

# Roughness below this (zero included) acts as this: the lobe is then narrower than float32 directions can
# resolve, and D, its inverse square, still fits. Above the other, D is the same everywhere but at the horizon
ALPHA_MIN = 1e-8
ALPHA_MAX = 1e6

# Directions nearer to the horizon count as below it, so that quotients by their cosines stay within float32
COS_MIN = 1e-12

# Indices of textures and of updates, whose values are not checked, are brought between these
IOR_MIN = 1e-9
IOR_MAX = 1e9


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
        above_i = wi.z > COS_MIN
        above_o = active & (wo.z > COS_MIN)
        # Masked lanes get harmless directions: scalar variants raise on 0/0, and no NaN is born. What depends
        # on wi alone is computed once for all wo
        up = mi.Vector3f(0, 0, 1)
        wi = dr.select(above_i, wi, up)
        wo = dr.select(above_o, wo, up)
        tan2 = tan2_theta(wi + wo)
        if tan2_theta_h is not None:
            tan2 = dr.replace_grad(tan2_theta_h, tan2) if dr.grad_enabled(tan2) else tan2_theta_h
        return cls(wi, wo, tan2, above_i & above_o)


# A lobe has a name, the parameter that scales it with its default, the flag of its component among
# ``mi.BSDFFlags`` and the names of the other parameters that it depends on. ``value`` is f cos θo, and
# ``density`` that of its samples per solid angle; ``sample`` draws a direction, with tan² of the angle of the
# half vector to z. ``albedo``, how much light from ``at.wi`` it reflects, decides how often it is drawn from.
# ``at.given`` has the values of all parameters, by name


class Diffuse:
    """Lambert's lobe."""

    name = "diffuse"
    reflectance = "diffuse_reflectance"
    default = 0.5
    flag = "DiffuseReflection"
    depends_on: tuple[str, ...] = ()

    def value(self, at: Lobes, pair: Pair) -> mi.UnpolarizedSpectrum:
        return at.given[self.reflectance] * (dr.inv_pi * pair.wo.z)

    def density(self, at: Lobes, pair: Pair) -> mi.Float:
        """Return the density of the cosine-weighted hemisphere, per solid angle."""
        return dr.inv_pi * pair.wo.z

    def sample(self, at: Lobes, wi: mi.Vector3f, sample2: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        return wo, tan2_theta(wi + wo)

    def albedo(self, at: Lobes) -> mi.UnpolarizedSpectrum:
        return at.given[self.reflectance]


class Specular:
    """Microfacets, each a mirror of Fresnel's reflectance."""

    name = "specular"
    reflectance = "specular_reflectance"
    default = 1.0
    flag = "GlossyReflection"
    depends_on: tuple[str, ...] = ("alpha", "int_ior", "ext_ior", "f0")

    def value(self, at: Lobes, pair: Pair) -> mi.UnpolarizedSpectrum:
        fresnel = at.fresnel(*half_vector_angles(pair.wi, pair.wo))
        lobe = microfacet_specular(at.distribution, pair.wi, pair.wo, pair.tan2_theta_h, at.alpha)
        return at.given[self.reflectance] * fresnel * lobe

    def density(self, at: Lobes, pair: Pair) -> mi.Float:
        """Return the density per solid angle with which ``sample`` draws ``pair.wo``: that of the microfacet
        normal h over 4 ωo·h."""
        d = at.distribution.d(pair.tan2_theta_h, at.alpha)
        if at.visible:
            return 0.25 * d * at.distribution.visible_over_cos(pair.wi, at.alpha)
        # D cos θh / (4 ωo·h), where h = ωi + ωo is not normalised: cos θh = h.z / |h|, ωo·h = |h|² / 2, and
        # |h|² = h.z² (1 + tan²θh). The product ωo·h itself would feel the rounding of ωo's length: by 2 % at
        # cos θ = 1e-3 in float32
        return 0.5 * d / ((pair.wi.z + pair.wo.z) * (1 + pair.tan2_theta_h))

    def sample(self, at: Lobes, wi: mi.Vector3f, sample2: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        if at.visible:
            m = at.distribution.sample_visible(wi, at.alpha, sample2, mi.Vector3f)
        else:
            m = at.distribution.sample(at.alpha, sample2, mi.Vector3f)
        # The drawn normal *is* the half vector: in a narrow lobe, wi + wo has lost the digits in which it
        # differs from n
        return mi.reflect(wi, m), tan2_theta(m)

    def albedo(self, at: Lobes) -> mi.UnpolarizedSpectrum:
        return at.mirror_reflectance


Lobe = Diffuse | Specular
# In the order of the components of the BSDF
LOBES: tuple[Lobe, ...] = (Diffuse(), Specular())


def _visible_slopes(cos_theta: mi.Float, u: mi.Point2f) -> mi.Vector2f:
    """Return slopes of Beckmann's microfacets of unit roughness that are visible, as Mitsuba draws them."""
    return mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, 1.0).sample_visible_11(cos_theta, u)


DISTRIBUTIONS: dict[str, Any] = {"beckmann": Beckmann(_visible_slopes), "ggx": GGX()}

# Parameters that are one of a few words; the first is the default
CHOICES: dict[str, tuple[str, ...]] = {
    "distribution": tuple(DISTRIBUTIONS),
    "fresnel": ("schlick", "dielectric", "unity"),
}

# Parameters that are numbers, or textures of one channel, with their defaults and limits, as ``number`` takes
# them: up to four of them, which is what a row of the table of materials holds
NUMBERS: dict[str, tuple[float, dict[str, float]]] = {
    "alpha": (0.1, {}),
    "int_ior": (1.5, {"above": 0}),
    "ext_ior": (1.0, {"above": 0}),
}


@dataclass(eq=False)
class Lobes:
    """Value, density and samples of the lobes, seen from the local direction ``wi``.

    ``choices`` and ``given``: the parameters of the BSDF there, by name. Samples and their density are
    constants in derivatives (detached sampling): only the value, divided by the density, follows the
    parameters.
    """

    choices: Mapping[str, str]
    given: dict[str, Any]
    wi: mi.Vector3f
    visible: bool = True  # are visible normals sampled

    @cached_property
    def constant(self) -> Lobes:
        """The same without derivatives by the parameters."""
        return Lobes(self.choices, dr.detach(self.given), self.wi, visible=self.visible)

    @property
    def distribution(self) -> Any:
        """The distribution of the microfacets."""
        return DISTRIBUTIONS[self.choices["distribution"]]

    @cached_property
    def alpha(self) -> mi.Float:
        """The roughness alpha, with its sign, its size clipped to [ALPHA_MIN, ALPHA_MAX], which float32
        resolves."""
        alpha = self.given["alpha"]
        size = _within(dr.abs(alpha), ALPHA_MIN, ALPHA_MAX)
        return dr.select(alpha < 0, -size, size)

    def fresnel(self, cos_theta: mi.Float, sin2_theta: mi.Float) -> mi.UnpolarizedSpectrum:
        """Return F at a microfacet: a float, or a spectrum where ``f0`` was given."""
        form = self.choices["fresnel"]
        if form == "unity":
            return mi.Float(1)
        ext_ior = _within(self.given["ext_ior"], IOR_MIN, IOR_MAX)
        int_ior = _within(self.given["int_ior"], IOR_MIN, IOR_MAX)
        if form == "dielectric":
            return fresnel_dielectric(cos_theta, ext_ior, int_ior, sin2_theta)
        f0 = self.given.get("f0")
        if f0 is None:
            f0 = f0_from_ior(ext_ior, int_ior)
        return fresnel_schlick(cos_theta, f0, sin2_theta)

    @cached_property
    def mirror_reflectance(self) -> mi.UnpolarizedSpectrum:
        """k_s F(θi), the reflectance of a perfect mirror in place of the lobe; 0 from behind."""
        above = self.wi.z > COS_MIN
        sin2_theta = dr.square(self.wi.x) + dr.square(self.wi.y)
        fresnel = self.fresnel(dr.select(above, self.wi.z, 1), dr.select(above, sin2_theta, 0))
        return dr.select(above, self.given["specular_reflectance"] * fresnel, 0)

    def value(self, ctx: mi.BSDFContext, pair: Pair) -> mi.UnpolarizedSpectrum:
        """Return f cos θo of the enabled lobes."""
        value = mi.UnpolarizedSpectrum(0)
        for _, lobe in _enabled(ctx):
            value += lobe.value(self, pair)
        # The report's G₁ of a negative roughness can be negative; light cannot
        return dr.select(pair.active, dr.maximum(value, 0), 0)

    def density(self, ctx: mi.BSDFContext, pair: Pair) -> mi.Float:
        """Return the density per solid angle with which ``sample`` draws ``pair.wo``."""
        at = self.constant
        density = mi.Float(0)
        for _, lobe, probability in at._chances(ctx):
            density += probability * lobe.density(at, pair)
        return dr.select(pair.active, density, 0)

    def sample(
        self, ctx: mi.BSDFContext, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, Pair, mi.UInt32]:
        """Draw a direction; return it, its pair with ``wi``, and which of ``LOBES`` it was drawn from."""
        at = self.constant
        above = active & (self.wi.z > COS_MIN)
        up = mi.Vector3f(0, 0, 1)
        wi = dr.select(above, dr.detach(self.wi), up)
        wo = up
        tan2_theta_h = mi.Float(0)
        component = mi.UInt32(0)
        taken = mi.Float(0)
        for place, (number, lobe, probability) in enumerate(at._chances(ctx)):
            direction, tan2 = lobe.sample(at, wi, sample2)
            own = mi.Bool(True)  # the first lobe takes what the others leave
            if place > 0:
                own = (sample1 >= taken) & (sample1 < taken + probability)
                taken += probability
            wo = dr.select(own, direction, wo)
            tan2_theta_h = dr.select(own, tan2, tan2_theta_h)
            component = dr.select(own, mi.UInt32(number), component)
        wo = dr.detach(wo)
        tan2_theta_h = dr.detach(tan2_theta_h)
        return wo, Pair.above(dr.select(above, self.wi, up), wo, above, tan2_theta_h), component

    def _chances(self, ctx: mi.BSDFContext) -> list[tuple[int, Lobe, mi.Float]]:
        """Return the enabled lobes, and how likely each is drawn from: after their reflectances."""
        lobes = _enabled(ctx)
        if len(lobes) < 2:
            return [(k, lobe, mi.Float(1)) for k, lobe in lobes]
        weights = [dr.abs(dr.mean(lobe.albedo(self))) for _, lobe in lobes]
        total = sum(weights)
        known = total > 0
        divisor = dr.select(known, total, 1)
        shares = [dr.select(known, weight / divisor, 1 / len(lobes)) for weight in weights[1:]]
        shares.insert(0, 1 - sum(shares))
        return [(k, lobe, share) for (k, lobe), share in zip(lobes, shares, strict=True)]


def _enabled(ctx: mi.BSDFContext) -> list[tuple[int, Lobe]]:
    """Return the lobes that take part, with their places in ``LOBES``."""
    return [(k, x) for k, x in enumerate(LOBES) if ctx.is_enabled(getattr(mi.BSDFFlags, x.flag), k)]


def _within(x: mi.Float, least: float, most: float) -> mi.Float:
    """Return ``x`` between two limits; NaN gives the lower one."""
    return dr.select(x >= least, dr.minimum(x, most), least)
