"""One reflectance three times in float32: as in the report, as in Mitsuba, and as in this project.

All take local directions, alpha and the index of refraction as float32 arrays; the Fresnel term is the exact
dielectric one, outside index 1. Values are those of Mitsuba's convention, BSDF times cos θo; densities are of
sampling visible normals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mrt_mitsuba.plugins import fresnel, microfacet

# The report's form: everything from cosines, and the half vector made one unit long first


def report_tan2_theta(v: Any) -> Any:
    """Return tan² from the cosine of the vector made one unit long."""
    c2 = dr.square(dr.normalize(v).z)
    return (1 - c2) / c2


def report_smith_g1(v: Any, alpha: Any) -> Any:
    """Return Smith's G₁ from b = 1 / (alpha tan θ), with tan θ from the cosine."""
    tan_theta = dr.sqrt(dr.maximum(1 - dr.square(v.z), 0)) / v.z
    steep = tan_theta * alpha <= 0
    b = dr.select(steep, 2, 1 / dr.select(steep, 1, alpha * tan_theta))
    fit = (3.535 * b + 2.181 * b * b) / (1 + 2.276 * b + 2.577 * b * b)
    return dr.select(b < 1.6, fit, 1)


def report_fresnel(cos_theta: Any, ext_ior: Any, int_ior: Any, sin2_theta: Any = None) -> Any:
    """Return ½(Rs + Rp) from Snell's law; what is known of the sine is not used."""
    sin2_t = dr.square(ext_ior / int_ior) * (1 - dr.square(cos_theta))
    total = sin2_t > 1
    cos_t = dr.sqrt(dr.select(total, 0, 1 - sin2_t))
    rs = (ext_ior * cos_theta - int_ior * cos_t) / (ext_ior * cos_theta + int_ior * cos_t)
    rp = (ext_ior * cos_t - int_ior * cos_theta) / (ext_ior * cos_t + int_ior * cos_theta)
    return dr.select(total, 1, 0.5 * (rs * rs + rp * rp))


@dataclass(frozen=True)
class Terms:
    """Arrays of one value for each pair of directions."""

    d: Any
    g: Any
    value: Any
    pdf: Any


class Report:
    """The formulas of the report, term by term."""

    name = "report"

    def terms(self, wi: Any, wo: Any, alpha: Any, ior: Any) -> Terms:
        h = dr.normalize(wi + wo)
        d = microfacet.beckmann_d(report_tan2_theta(h), alpha)
        g_i, g_o = report_smith_g1(wi, alpha), report_smith_g1(wo, alpha)
        f = self.fresnel(dr.dot(wi, h), ior)
        return Terms(d, g_i * g_o, d * f * g_i * g_o / (4 * wi.z * wo.z) * wo.z, d * g_i / (4 * wi.z))

    def fresnel(self, cos_theta: Any, ior: Any) -> Any:
        return report_fresnel(cos_theta, 1, ior)


class Mitsuba:
    """The terms of ``roughconductor`` for a material without absorption, by Mitsuba's own functions.

    Mitsuba raises alpha to 1e-4.
    """

    name = "roughconductor"

    def terms(self, wi: Any, wo: Any, alpha: Any, ior: Any) -> Terms:
        microfacets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, alpha)
        h = dr.normalize(wi + wo)
        d, g = microfacets.eval(h), microfacets.G(wi, wo, h)
        value = d * g / (4 * wi.z) * self.fresnel(dr.dot(wi, h), ior)
        return Terms(d, g, value, d * microfacets.smith_g1(wi, h) / (4 * wi.z))

    def fresnel(self, cos_theta: Any, ior: Any) -> Any:
        return mi.fresnel_conductor(cos_theta, mi.Complex2f(ior, 0))


class Ours:
    """``mrt_bsdf`` and the functions it is made of."""

    name = "mrt_bsdf"

    def __init__(self) -> None:
        self.bsdf = mi.load_dict({"type": "mrt_bsdf", "fresnel": "dielectric", "diffuse_reflectance": 0.0})

    def terms(self, wi: Any, wo: Any, alpha: Any, ior: Any) -> Terms:
        d = microfacet.beckmann_d(microfacet.tan2_theta(wi + wo), alpha)
        g = microfacet.smith_g1(wi, alpha) * microfacet.smith_g1(wo, alpha)
        value, pdf = self._plugin(wi, wo, alpha, ior)
        return Terms(d, g, value, pdf)

    def _plugin(self, wi: Any, wo: Any, alpha: Any, ior: Any) -> tuple[Any, Any]:
        """Return the plugin itself, given one alpha and index for each pair of directions."""
        parameters = mi.traverse(self.bsdf)
        for name, values in (("alpha", alpha), ("int_ior", ior)):
            parameters[name] = type(parameters[name])(values)
        parameters.update()
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = wi
        value, pdf = self.bsdf.eval_pdf(mi.BSDFContext(mi.TransportMode.Radiance, 0xFFFFFFFF, 1), si, wo)
        return value[0], pdf

    def fresnel(self, cos_theta: Any, ior: Any) -> Any:
        return fresnel.fresnel_dielectric(cos_theta, 1, ior)
