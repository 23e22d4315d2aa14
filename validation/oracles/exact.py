"""The report's formulas as the textbooks write them, in 50 digits: the truth for the float32 functions.

Arguments are numbers of any kind, taken at their exact binary value, or decimal strings; results are ``mpf``.
Vectors are triples and need not be normalised.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpmath import mp, mpf

DIGITS = 50

FRESNEL_FORMS = ("dielectric", "schlick", "unity")


def number(x: Any) -> mpf:
    """Return a number or decimal string as ``mpf``; binary numbers of any precision are not rounded."""
    return mpf(x) if isinstance(x, (str, mpf)) else mpf(float(x))


def unit(v: Sequence[Any]) -> list[mpf]:
    """Return a vector made one unit long."""
    components = [number(x) for x in v]
    length = mp.sqrt(sum(x * x for x in components))
    return [x / length for x in components]


@mp.workdps(DIGITS)
def half_vector(a: Sequence[Any], b: Sequence[Any]) -> list[mpf]:
    """Return the unit vector halfway between two directions."""
    return unit([x + y for x, y in zip(unit(a), unit(b), strict=True)])


@mp.workdps(DIGITS)
def f0_from_ior(ext_ior: Any, int_ior: Any) -> mpf:
    n1, n2 = number(ext_ior), number(int_ior)
    return ((n2 - n1) / (n2 + n1)) ** 2


@mp.workdps(DIGITS)
def fresnel_schlick(cos_theta: Any, f0: Any) -> mpf:
    return number(f0) + (1 - number(f0)) * (1 - number(cos_theta)) ** 5


@mp.workdps(DIGITS)
def fresnel_dielectric(cos_theta: Any, ext_ior: Any, int_ior: Any) -> mpf:
    """Return ½(Rs + Rp) by Snell's law; 1 under total reflection."""
    c, n1, n2 = number(cos_theta), number(ext_ior), number(int_ior)
    sin2_t = (n1 / n2) ** 2 * (1 - c * c)
    if sin2_t > 1:
        return mpf(1)
    cos_t = mp.sqrt(1 - sin2_t)
    rs = ((n1 * c - n2 * cos_t) / (n1 * c + n2 * cos_t)) ** 2
    rp = ((n1 * cos_t - n2 * c) / (n1 * cos_t + n2 * c)) ** 2
    return (rs + rp) / 2


@mp.workdps(DIGITS)
def beckmann_d(cos_theta_h: Any, alpha: Any) -> mpf:
    c, a = number(cos_theta_h), number(alpha)
    return mp.exp(-(1 / c**2 - 1) / a**2) / (mp.pi * a**2 * c**4)


@mp.workdps(DIGITS)
def smith_g1(v: Sequence[Any], alpha: Any) -> mpf:
    """Return the rational fit of Walter et al. for a direction above the surface, whose normal is +z."""
    x, y, z = (number(c) for c in v)
    tan_theta = mp.sqrt(x * x + y * y) / z
    if tan_theta == 0:
        return mpf(1)
    b = 1 / (number(alpha) * tan_theta)
    if b >= mpf("1.6"):
        return mpf(1)
    return (mpf("3.535") * b + mpf("2.181") * b**2) / (1 + mpf("2.276") * b + mpf("2.577") * b**2)


@mp.workdps(DIGITS)
def visible_cos(v: Sequence[Any], alpha: Any) -> mpf:
    """Return (1 + Λ) cos θ of a direction above the surface, with Beckmann's own Λ (Heitz 2014, eq. 72)."""
    x, y, z = (number(c) for c in v)
    across = number(alpha) * mp.sqrt(x * x + y * y)
    if across == 0:
        return z
    a = z / across
    return z + (mp.exp(-a * a) * across / mp.sqrt(mp.pi) - z * mp.erfc(a)) / 2


@mp.workdps(DIGITS)
def fresnel(form: str, cos_theta: Any, ext_ior: Any, int_ior: Any) -> mpf:
    """Return one of ``FRESNEL_FORMS``; Schlick's with F₀ from the indices."""
    if form == "dielectric":
        return fresnel_dielectric(cos_theta, ext_ior, int_ior)
    if form == "schlick":
        return fresnel_schlick(cos_theta, f0_from_ior(ext_ior, int_ior))
    return mpf(1)


@mp.workdps(DIGITS)
def specular_bsdf(wi: Sequence[Any], wo: Sequence[Any], alpha: Any, *, form: str, int_ior: Any = 1) -> mpf:
    """Return D F G / (4 cos θi cos θo) for directions above the surface with normal +z; outside index 1."""
    i, o, h = unit(wi), unit(wo), half_vector(wi, wo)
    cos_d = sum(a * b for a, b in zip(i, h, strict=True))
    f = fresnel(form, cos_d, 1, int_ior)
    return beckmann_d(h[2], alpha) * f * smith_g1(i, alpha) * smith_g1(o, alpha) / (4 * i[2] * o[2])
