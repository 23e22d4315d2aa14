"""The report's formulas as the textbooks write them, in 50 digits: the truth for the float32 functions.

Arguments are numbers of any kind, taken at their exact binary value, or decimal strings; results are ``mpf``
of ``mp``. Vectors are triples and need not be normalised; the normal is +z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpmath.ctx_mp import MPContext

mp = MPContext()  # of its own: others' digits stay as they are
mp.dps = 50
mpf = mp.mpf

Number = Any  # an ``mpf``, a number of any kind at its exact binary value, or a decimal string

FRESNEL_FORMS = ("dielectric", "schlick", "unity")


def number(x: Number) -> Number:
    """A number or decimal string as ``mpf``; binary numbers of any precision are not rounded."""
    return mpf(x if isinstance(x, (str, mpf)) else float(x))


def unit(v: Sequence[Number]) -> list[Number]:
    """A vector made one unit long."""
    components = [number(x) for x in v]
    length = mp.sqrt(sum(x * x for x in components))
    return [x / length for x in components]


def f0_from_ior(ext_ior: Number, int_ior: Number) -> Number:
    n1 = number(ext_ior)
    n2 = number(int_ior)
    return ((n2 - n1) / (n2 + n1)) ** 2


def fresnel_schlick(cos_theta: Number, f0: Number) -> Number:
    return number(f0) + (1 - number(f0)) * (1 - number(cos_theta)) ** 5


def fresnel_dielectric(cos_theta: Number, ext_ior: Number, int_ior: Number) -> Number:
    """½(Rs + Rp) by Snell's law; 1 under total reflection."""
    c = number(cos_theta)
    n1 = number(ext_ior)
    n2 = number(int_ior)
    sin2_t = (n1 / n2) ** 2 * (1 - c * c)
    if sin2_t > 1:
        return mpf(1)
    cos_t = mp.sqrt(1 - sin2_t)
    rs = ((n1 * c - n2 * cos_t) / (n1 * c + n2 * cos_t)) ** 2
    rp = ((n1 * cos_t - n2 * c) / (n1 * cos_t + n2 * c)) ** 2
    return (rs + rp) / 2


def fresnel(form: str, cos_theta: Number, ext_ior: Number, int_ior: Number) -> Number:
    """One of ``FRESNEL_FORMS``; Schlick's with F₀ from the indices."""
    if form == "dielectric":
        return fresnel_dielectric(cos_theta, ext_ior, int_ior)
    return fresnel_schlick(cos_theta, f0_from_ior(ext_ior, int_ior)) if form == "schlick" else mpf(1)


def steepness(v: Sequence[Number], alpha: Number) -> Number:
    """1 / (alpha tan θ) of a direction above the surface, infinite along the normal."""
    x, y, z = map(number, v)
    across = number(alpha) * mp.sqrt(x * x + y * y)
    return z / across if across else mp.inf


class Beckmann:
    """Beckmann's microfacets, with the rational fit of Smith's G₁ by Walter et al. (2007)."""

    @staticmethod
    def d(cos_theta_h: Number, alpha: Number) -> Number:
        """The density of normals; Walter et al., eq. 25."""
        c = number(cos_theta_h)
        a = number(alpha)
        return mp.exp(-(1 / c**2 - 1) / a**2) / (mp.pi * a**2 * c**4)

    @staticmethod
    def g1(v: Sequence[Number], alpha: Number) -> Number:
        """The rational fit, for a direction above the surface; Walter et al., eq. 27."""
        b = steepness(v, alpha)
        if b >= mpf("1.6"):
            return mpf(1)
        return (mpf("3.535") * b + mpf("2.181") * b**2) / (1 + mpf("2.276") * b + mpf("2.577") * b**2)

    @staticmethod
    def visible_cos(v: Sequence[Number], alpha: Number) -> Number:
        """(1 + Λ) cos θ of a direction above the surface, with Beckmann's own Λ (Heitz 2014, eq. 72)."""
        a = steepness(v, alpha)
        smith = (mp.exp(-a * a) / (a * mp.sqrt(mp.pi)) - mp.erfc(a)) / 2
        return (1 + smith) * number(v[2])


class GGX:
    """Microfacets of Trowbridge and Reitz with Smith's G₁ (Walter et al. 2007)."""

    @staticmethod
    def d(cos_theta_h: Number, alpha: Number) -> Number:
        """The density of normals; Walter et al., eq. 33."""
        c = number(cos_theta_h)
        a = number(alpha)
        return a**2 / (mp.pi * c**4 * (a**2 + 1 / c**2 - 1) ** 2)

    @staticmethod
    def g1(v: Sequence[Number], alpha: Number) -> Number:
        """Smith's shadowing of a direction above the surface; Walter et al., eq. 34."""
        return 2 / (1 + mp.sqrt(1 + 1 / steepness(v, alpha) ** 2))

    @staticmethod
    def visible_cos(v: Sequence[Number], alpha: Number) -> Number:
        """(1 + Λ) cos θ of a direction above the surface; Λ is that of ``g1`` (Heitz 2014, eq. 72)."""
        return number(v[2]) / GGX.g1(v, alpha)


DISTRIBUTIONS: dict[str, type[Beckmann | GGX]] = {"beckmann": Beckmann, "ggx": GGX}


class Lobe(NamedTuple):
    """The specular lobe without Fresnel, in exact numbers."""

    d: Number
    value: Number  #: D G / (4 cos θi)


def lobe(wi: Sequence[Number], wo: Sequence[Number], alpha: Number, distribution: str = "beckmann") -> Lobe:
    """The lobe for directions above the surface; their half vector is the sum of their components."""
    x, y, z = (number(p) + number(q) for p, q in zip(wi, wo, strict=True))
    tan2 = (x * x + y * y) / (z * z)
    microfacets = DISTRIBUTIONS[distribution]
    d = microfacets.d(1 / mp.sqrt(1 + tan2), alpha)
    g = microfacets.g1(wi, alpha) * microfacets.g1(wo, alpha)
    return Lobe(d, d * g / (4 * number(wi[2])))
