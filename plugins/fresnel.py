"""Fresnel reflectance of a smooth interface, as pure functions.

Every function takes Python floats or Dr.Jit arrays of any precision and returns the same kind. Cosines and
sines belong to the angle between a direction and the (micro-)normal, on the side of ``ext_ior``.

``sin2_theta`` may be given with ``cos_theta`` where the caller knows it better than ``1 - cos_theta**2``
does: near the normal that difference cancels.
"""

from __future__ import annotations

import drjit as dr

# Beyond this ratio of the indices, and below its inverse, an interface is a mirror to one part in 10⁸; the
# square of the ratio would leave float32 from 1.8e19 on
ETA_MAX = 1e9


def f0_from_ior(ext_ior, int_ior):
    """Return the reflectance at normal incidence, ``((η₂ − η₁) / (η₂ + η₁))²``, unitless."""
    return dr.square((int_ior - ext_ior) / (int_ior + ext_ior))


def fresnel_schlick(cos_theta, f0, sin2_theta=None):
    """Return Schlick's approximation ``F = F₀ + (1 − F₀)(1 − cos θ)⁵``.

    ``f0`` may be a scalar or a colour. Source: Schlick, "An Inexpensive BRDF Model for Physically-based
    Rendering", 1994, eq. 15.
    """
    # 1 - c = s² / (1 + c) keeps its leading digits where c is close to one
    one_minus_cos = 1 - cos_theta if sin2_theta is None else sin2_theta / (1 + cos_theta)
    return f0 + (1 - f0) * one_minus_cos**5


def fresnel_dielectric(cos_theta, ext_ior, int_ior, sin2_theta=None):
    """Return the unpolarised reflectance of a dielectric interface, in [0, 1]; 1 in total reflection.

    ``ext_ior`` is that of the side that the light comes from, at the angle of ``cos_theta``; ``sin2_theta``,
    if it is known, saves taking it from the cosine.

    The textbook form ``½(Rs + Rp)`` (Snell and Fresnel; see e.g. Pharr, Jakob and Humphreys, PBR 4th ed.,
    §9.3) with both numerators expanded by their conjugates, so that the factor ``1 − η²`` stands alone and
    nothing cancels when the two media are nearly alike: with η = int/ext and g = η cos θt = √(η² − sin²θ),

        rs = (cos θ − g) / (cos θ + g)   = (1 − η²) / (cos θ + g)²
        rp = (g − η² cos θ) / (g + η² cos θ) = (η² − 1)(1 − (1 + η²) cos²θ) / (g + η² cos θ)²

    g² itself is taken as (η² − 1) + cos²θ, of two numbers that may both be small, unless η² is small.
    """
    c2 = dr.square(cos_theta)
    s2 = (1 - cos_theta) * (1 + cos_theta) if sin2_theta is None else sin2_theta
    eta = dr.clip(int_ior / ext_ior, 1 / ETA_MAX, ETA_MAX)
    eta2 = dr.square(eta)
    eta2_minus_1 = dr.minimum((int_ior - ext_ior) / ext_ior, ETA_MAX) * (eta + 1)
    g2 = dr.select(eta2 < 0.5, eta2 - s2, eta2_minus_1 + c2)
    total = g2 <= 0
    g = dr.sqrt(dr.select(total, 1, g2))
    rs = eta2_minus_1 / dr.square(cos_theta + g)
    rp = eta2_minus_1 * (s2 - eta2 * c2) / dr.square(g + eta2 * cos_theta)
    return dr.select(total, 1, 0.5 * (dr.square(rs) + dr.square(rp)))
