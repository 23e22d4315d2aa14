"""Beckmann microfacets in the local frame (n = +z), as pure functions.

Directions are given by their local Cartesian components and need not be normalised where the docstring says
so: ratios of components carry the full precision of their inputs, cosines of nearly parallel unit vectors do
not. Everything works on Python floats and on Dr.Jit arrays of any precision. ``alpha`` is the roughness
(RMS slope × √2), unitless; a negative value is allowed, as in the original program: D sees α², G₁ its sign.
"""

from __future__ import annotations

import drjit as dr

# Beyond this tan² a normal is horizontal for every purpose; (1 + tan²)² would overflow float32 from 1.8e19 on
TAN2_MAX = 1e18


def tan2_theta(v):
    """Return tan² of the angle to ±z of ``v`` (any length), clamped to ``TAN2_MAX``."""
    z2 = dr.square(v.z)
    r2 = dr.square(v.x) + dr.square(v.y)
    horizontal = r2 >= TAN2_MAX * z2
    return dr.select(horizontal, TAN2_MAX, r2 / dr.select(horizontal, 1, z2))


def beckmann_d(tan2_theta_h, alpha):
    """Return Beckmann's normal distribution ``D = exp(−tan²θ/α²) / (π α² cos⁴θ)`` in 1/sr, for θ < 90°.

    Takes tan²θ of the half vector, not cos θ: with cos⁻²θ = 1 + tan²θ the only subtraction is gone.
    Source: Beckmann and Spizzichino 1963; Walter et al., "Microfacet Models for Refraction", 2007, eq. 25.
    """
    inv_alpha2 = 1 / dr.square(alpha)  # once for all directions at a point
    return dr.exp(-tan2_theta_h * inv_alpha2) * dr.square(1 + tan2_theta_h) * (dr.inv_pi * inv_alpha2)


def _smith_fit(v, alpha):
    """Return numerator over cos θ and denominator of the rational fit of Smith's G₁, and where it applies.

    With b = 1/(α tan θ) = z/a, a = α √(x² + y²), the fit (3.535 b + 2.181 b²)/(1 + 2.276 b + 2.577 b²) is
    multiplied through by a²: no division by tan θ, and the factor z = cos θ can be left out.
    """
    a = alpha * dr.sqrt(dr.square(v.x) + dr.square(v.y))
    fitted = (v.z < 1.6 * a) | (a < 0)
    numerator = dr.fma(3.535, a, 2.181 * v.z)
    denominator = dr.fma(a, a, v.z * dr.fma(2.276, a, 2.577 * v.z))
    return numerator, denominator, fitted


def smith_g1(v, alpha):
    """Return Smith's shadowing for Beckmann towards ``v`` (any length, v.z > 0), by a rational fit.

    b < 1.6: (3.535 b + 2.181 b²)/(1 + 2.276 b + 2.577 b²) with b = 1/(α tan θ), else 1 (relative error of the
    fit 0.35 %). The factor χ⁺((v·h)/(v·n)) is the caller's: it is 1 wherever both directions are above the
    surface. Just below b = 1.6 the fit is up to 1.00006.
    Source: Walter et al. 2007, eq. 27 and below.
    """
    numerator, denominator, fitted = _smith_fit(v, alpha)
    return dr.select(fitted, v.z * numerator, 1) / dr.select(fitted, denominator, 1)


def smith_g1_over_cos(v, alpha):
    """Return ``smith_g1(v) / cos θ`` for a unit vector ``v``, finite down to grazing directions."""
    numerator, denominator, fitted = _smith_fit(v, alpha)
    return dr.select(fitted, numerator, 1) / dr.select(fitted, denominator, v.z)


def visible_over_cos(v, alpha):
    """Return ``1 / ((1 + Λ) cos θ)`` for a unit vector ``v``, v.z > 0: the normaliser of the visible normals.

    Λ is Beckmann's own, with the error function; the rational fit of G₁ differs by up to 0.4 %, and a density
    with it would integrate to that much more or less. Times cos θ, no term cancels or overflows: with
    a = 1 / (α tan θ), (1 + Λ) cos θ = cos θ (1 + erf a) / 2 + α sin θ exp(−a²) / (2 √π).
    Source: Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", 2014, eq. 72.
    """
    across = dr.abs(alpha) * dr.sqrt(dr.square(v.x) + dr.square(v.y))
    normal = across <= 1e-6 * v.z  # there is nothing but the first term, which is cos θ
    a = v.z / dr.select(normal, 1, across)
    inclined = 0.5 * v.z * (1 + dr.erf(a)) + 0.5 / dr.sqrt(dr.pi) * across * dr.exp(-dr.square(a))
    return 1 / dr.select(normal, v.z, inclined)


def half_vector_angles(wi, wo):
    """Return (cos θd, sin²θd) between ``wi`` and the half vector of two unit vectors.

    Taken from |wi + wo| and |wi − wo| instead of a dot product with a normalised half vector, so that each
    stays accurate where it is small: |wi ± wo|² = 2 ± 2 cos 2θd.
    """
    return 0.5 * dr.norm(wi + wo), 0.25 * dr.squared_norm(wi - wo)


def microfacet_specular(wi, wo, tan2_theta_h, alpha):
    """Return ``D G / (4 cos θi cos θo)`` times cos θo, without Fresnel, in 1/sr; both z must be positive.

    The cosine of ``wi`` is divided out inside G₁ and that of ``wo`` never appears.
    Source: Walter et al. 2007, eq. 20.
    """
    g_over_cos = smith_g1_over_cos(wi, alpha) * smith_g1(wo, alpha)
    return 0.25 * beckmann_d(tan2_theta_h, alpha) * g_over_cos


def sample_beckmann(alpha, u1, u2, like):
    """Return a microfacet normal with density D cos θ for ``u1, u2`` in [0, 1); ``like``: the type of vector.

    Source: Walter et al. 2007, eq. 28, 29.
    """
    tan_theta = dr.abs(alpha) * dr.sqrt(-dr.log(1 - u1))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u2)
    return dr.normalize(like(cos_phi * tan_theta, sin_phi * tan_theta, 1))


def sample_beckmann_visible(wi, alpha, u, slopes, like):
    """Return a microfacet normal distributed as those visible from ``wi`` (unit, wi.z > 0).

    ``slopes(cos_theta, u)`` draws a visible slope for α = 1: ``mi.MicrofacetDistribution.sample_visible_11``.
    Source: Heitz and d'Eon, "Importance Sampling Microfacet-Based BSDFs using the Distribution of Visible
    Normals", 2014, §4: stretch, draw for unit roughness, rotate, unstretch.
    """
    a = dr.abs(alpha)
    stretched = dr.normalize(like(a * wi.x, a * wi.y, wi.z))
    slope = slopes(stretched.z, u)
    r = dr.sqrt(dr.square(stretched.x) + dr.square(stretched.y))
    straight = r <= 0
    inv_r = 1 / dr.select(straight, 1, r)
    cos_phi = dr.select(straight, 1, stretched.x * inv_r)
    sin_phi = dr.select(straight, 0, stretched.y * inv_r)
    slope_x = a * (cos_phi * slope.x - sin_phi * slope.y)
    slope_y = a * (sin_phi * slope.x + cos_phi * slope.y)
    return dr.normalize(like(-slope_x, -slope_y, 1))
