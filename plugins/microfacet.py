"""Distributions of microfacet normals in the local frame (n = +z), as pure functions.

Directions are given by their local Cartesian components and need not be normalised where the docstring says
so: ratios of components carry the full precision of their inputs, cosines of nearly parallel unit vectors do
not. Everything works on Python floats and on Dr.Jit arrays of any precision. ``alpha`` is the roughness
(RMS slope × √2 of Beckmann's), unitless; a negative value is allowed, as in the original program: D sees α²,
Beckmann's G₁ its sign.

A distribution has D, G₁ and samples of normals, of all of them or of the visible ones. ``u`` holds two
numbers in [0, 1); ``like`` is the type of vector to return.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

# Beyond this tan² a normal is horizontal for every purpose; (1 + tan²)² would overflow float32 from 1.8e19 on
TAN2_MAX = 1e18


def tan2_theta(v):
    """Return tan² of the angle to ±z of ``v`` (any length), clamped to ``TAN2_MAX``."""
    z2 = dr.square(v.z)
    r2 = dr.square(v.x) + dr.square(v.y)
    horizontal = r2 >= TAN2_MAX * z2
    return dr.select(horizontal, TAN2_MAX, r2 / dr.select(horizontal, 1, z2))


@dataclass(frozen=True)
class Beckmann:
    """Beckmann's distribution, with the rational fit of Smith's G₁ that the original program has.

    ``visible_slopes(cos_theta, u)`` draws a visible slope for α = 1, as
    ``mi.MicrofacetDistribution.sample_visible_11`` does.
    """

    visible_slopes: Callable[[Any, Any], Any] | None = None

    def d(self, tan2_theta_h, alpha):
        """Return the density of normals ``D = exp(−tan²θ/α²) / (π α² cos⁴θ)`` in 1/sr, for θ < 90°.

        Takes tan²θ of the half vector, not cos θ: with cos⁻²θ = 1 + tan²θ the only subtraction is gone.
        Source: Beckmann and Spizzichino 1963; Walter et al., "Microfacet Models for Refraction", 2007,
        eq. 25.
        """
        inv_alpha2 = 1 / dr.square(alpha)  # once for all directions at a point
        return dr.exp(-tan2_theta_h * inv_alpha2) * dr.square(1 + tan2_theta_h) * (dr.inv_pi * inv_alpha2)

    def _fit(self, v, alpha):
        """Return numerator over cos θ and denominator of the fit of G₁, and where it applies.

        With b = 1/(α tan θ) = z/a, a = α √(x² + y²), the fit (3.535 b + 2.181 b²)/(1 + 2.276 b + 2.577 b²) is
        multiplied through by a²: no division by tan θ, and the factor z = cos θ can be left out.
        """
        a = alpha * dr.sqrt(dr.square(v.x) + dr.square(v.y))
        fitted = (v.z < 1.6 * a) | (a < 0)
        numerator = dr.fma(3.535, a, 2.181 * v.z)
        denominator = dr.fma(a, a, v.z * dr.fma(2.276, a, 2.577 * v.z))
        return numerator, denominator, fitted

    def g1(self, v, alpha):
        """Return Smith's shadowing towards ``v`` (any length, v.z > 0), by a rational fit.

        b < 1.6: (3.535 b + 2.181 b²)/(1 + 2.276 b + 2.577 b²) with b = 1/(α tan θ), else 1 (relative error of
        the fit 0.35 %). The factor χ⁺((v·h)/(v·n)) is the caller's: it is 1 wherever both directions are
        above the surface. Just below b = 1.6 the fit is up to 1.00006.
        Source: Walter et al. 2007, eq. 27 and below.
        """
        numerator, denominator, fitted = self._fit(v, alpha)
        return dr.select(fitted, v.z * numerator, 1) / dr.select(fitted, denominator, 1)

    def g1_over_cos(self, v, alpha):
        """Return ``g1(v) / cos θ`` for a unit vector ``v``, finite down to grazing directions."""
        numerator, denominator, fitted = self._fit(v, alpha)
        return dr.select(fitted, numerator, 1) / dr.select(fitted, denominator, v.z)

    def visible_over_cos(self, v, alpha):
        """Return ``1 / ((1 + Λ) cos θ)`` for a unit vector ``v``, v.z > 0: the normaliser of visible normals.

        Λ is Beckmann's own, with the error function; the rational fit of G₁ differs by up to 0.4 %, and a
        density with it would integrate to that much more or less. Times cos θ, no term cancels or overflows:
        with a = 1 / (α tan θ), (1 + Λ) cos θ = cos θ (1 + erf a) / 2 + α sin θ exp(−a²) / (2 √π).
        Source: Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", 2014, eq. 72.
        """
        across = dr.abs(alpha) * dr.sqrt(dr.square(v.x) + dr.square(v.y))
        normal = across <= 1e-6 * v.z  # there is nothing but the first term, which is cos θ
        a = v.z / dr.select(normal, 1, across)
        inclined = 0.5 * v.z * (1 + dr.erf(a)) + 0.5 / dr.sqrt(dr.pi) * across * dr.exp(-dr.square(a))
        return 1 / dr.select(normal, v.z, inclined)

    def sample(self, alpha, u, like):
        """Return a normal with density D cos θ. Source: Walter et al. 2007, eq. 28, 29."""
        return _normal(dr.abs(alpha) * dr.sqrt(-dr.log(1 - u.x)), u.y, like)

    def sample_visible(self, wi, alpha, u, like):
        """Return a normal distributed as those visible from ``wi`` (unit, wi.z > 0).

        Source: Heitz and d'Eon, "Importance Sampling Microfacet-Based BSDFs using the Distribution of Visible
        Normals", 2014, §4: stretch, draw for unit roughness, rotate, unstretch.
        """
        a = dr.abs(alpha)
        stretched = dr.normalize(like(a * wi.x, a * wi.y, wi.z))
        slope = self.visible_slopes(stretched.z, u)
        r = dr.sqrt(dr.square(stretched.x) + dr.square(stretched.y))
        straight = r <= 0
        inv_r = 1 / dr.select(straight, 1, r)
        cos_phi = dr.select(straight, 1, stretched.x * inv_r)
        sin_phi = dr.select(straight, 0, stretched.y * inv_r)
        slope_x = a * (cos_phi * slope.x - sin_phi * slope.y)
        slope_y = a * (sin_phi * slope.x + cos_phi * slope.y)
        return dr.normalize(like(-slope_x, -slope_y, 1))


class GGX:
    """The distribution of Trowbridge and Reitz, with Smith's G₁; only the size of α counts."""

    def d(self, tan2_theta_h, alpha):
        """Return the density of normals ``D = α² / (π cos⁴θ (α² + tan²θ)²)`` in 1/sr, for θ < 90°.

        As the square of a quotient, which overflows for no α from 1e-8 to 1e6, and in which nothing cancels.
        Source: Walter et al. 2007, eq. 33.
        """
        return dr.inv_pi * dr.square(alpha * (1 + tan2_theta_h) / (dr.square(alpha) + tan2_theta_h))

    def g1(self, v, alpha):
        """Return Smith's shadowing ``2 / (1 + √(1 + α² tan²θ))`` towards ``v`` (any length, v.z > 0).

        Source: Walter et al. 2007, eq. 34.
        """
        return v.z * self.g1_over_cos(v, alpha)

    def g1_over_cos(self, v, alpha):
        """Return ``g1(v) / cos θ`` for a unit vector ``v``, finite down to grazing directions."""
        across2 = dr.square(alpha) * (dr.square(v.x) + dr.square(v.y))
        return 2 / (v.z + dr.sqrt(dr.square(v.z) + across2))

    def visible_over_cos(self, v, alpha):
        """Return ``1 / ((1 + Λ) cos θ)``, the normaliser of visible normals: G₁ is 1 / (1 + Λ) here."""
        return self.g1_over_cos(v, alpha)

    def sample(self, alpha, u, like):
        """Return a normal with density D cos θ. Source: Walter et al. 2007, eq. 35, 36."""
        return _normal(dr.abs(alpha) * dr.sqrt(u.x / (1 - u.x)), u.y, like)

    def sample_visible(self, wi, alpha, u, like):
        """Return a normal distributed as those visible from ``wi`` (unit, wi.z > 0).

        For α = 1 the normal is half of ``wi`` and a direction that is uniform in a spherical cap. With
        c = 1 + wi.z, the cap's heights are z = (1 − u) c − wi.z, so that 1 − z = u c and 1 + z = (1 − wi.z) +
        (1 − u) c: nothing cancels, also near the normal.
        Source: Dupuy and Benyoub, "Sampling Visible GGX Normals with Spherical Caps", 2023.
        """
        a = dr.abs(alpha)
        w = dr.normalize(like(a * wi.x, a * wi.y, wi.z))
        c = 1 + w.z
        above = (1 - u.x) * c
        r = dr.sqrt(u.x * (dr.square(w.x) + dr.square(w.y) + above * c))
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
        return dr.normalize(like(a * (r * cos_phi + w.x), a * (r * sin_phi + w.y), above))


def _normal(tan_theta, turn, like):
    """Return the unit vector at an angle to +z, given by its tangent, and an azimuth of 2π ``turn``."""
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * turn)
    return dr.normalize(like(cos_phi * tan_theta, sin_phi * tan_theta, 1))


def half_vector_angles(wi, wo):
    """Return (cos θd, sin²θd) between ``wi`` and the half vector of two unit vectors.

    Taken from |wi + wo| and |wi − wo| instead of a dot product with a normalised half vector, so that each
    stays accurate where it is small: |wi ± wo|² = 2 ± 2 cos 2θd.
    """
    return 0.5 * dr.norm(wi + wo), 0.25 * dr.squared_norm(wi - wo)


def microfacet_specular(distribution, wi, wo, tan2_theta_h, alpha):
    """Return ``D G / (4 cos θi cos θo)`` times cos θo, without Fresnel, in 1/sr; both z must be positive.

    The cosine of ``wi`` is divided out inside G₁ and that of ``wo`` never appears.
    Source: Walter et al. 2007, eq. 20.
    """
    g_over_cos = distribution.g1_over_cos(wi, alpha) * distribution.g1(wo, alpha)
    return 0.25 * distribution.d(tan2_theta_h, alpha) * g_over_cos
