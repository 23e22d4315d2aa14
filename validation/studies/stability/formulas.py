"""One reflectance three times in float32: as in the report, as in Mitsuba, and as in this project.

All take local directions, alpha and the index of refraction as float32 arrays; the Fresnel term is the exact
dielectric one, outside index 1. They return ``d``, ``g``, ``value`` (by Mitsuba's convention, BSDF times
cos θo) and ``pdf`` (of sampling visible normals), one number for each pair of directions.
"""

from __future__ import annotations

from collections.abc import Callable
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


Terms = dict[str, Any]


def report(wi: Any, wo: Any, alpha: Any, ior: Any) -> Terms:
    """Return the formulas of the report, term by term."""
    h = dr.normalize(wi + wo)
    d, f = microfacet.beckmann_d(report_tan2_theta(h), alpha), report_fresnel(dr.dot(wi, h), 1, ior)
    g_i, g_o = report_smith_g1(wi, alpha), report_smith_g1(wo, alpha)
    value = d * f * g_i * g_o / (4 * wi.z * wo.z) * wo.z
    return {"d": d, "g": g_i * g_o, "value": value, "pdf": d * g_i / (4 * wi.z)}


def roughconductor(wi: Any, wo: Any, alpha: Any, ior: Any) -> Terms:
    """Return Mitsuba's own terms for a material without absorption; they raise alpha to 1e-4."""
    microfacets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, alpha)
    h = dr.normalize(wi + wo)
    d, g = microfacets.eval(h), microfacets.G(wi, wo, h)
    value = d * g / (4 * wi.z) * mi.fresnel_conductor(dr.dot(wi, h), mi.Complex2f(ior, 0))
    return {"d": d, "g": g, "value": value, "pdf": d * microfacets.smith_g1(wi, h) / (4 * wi.z)}


def mrt_bsdf(wi: Any, wo: Any, alpha: Any, ior: Any) -> Terms:
    """Return value and density of the plugin, given one alpha and index a pair, and of its functions."""
    bsdf = mi.load_dict({"type": "mrt_bsdf", "fresnel": "dielectric", "diffuse_reflectance": 0.0})
    parameters = mi.traverse(bsdf)
    for name, values in (("alpha", alpha), ("int_ior", ior)):
        parameters[name] = type(parameters[name])(values)
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = wi
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(mi.TransportMode.Radiance, 0xFFFFFFFF, 1), si, wo)
    d = microfacet.beckmann_d(microfacet.tan2_theta(wi + wo), alpha)
    g = microfacet.smith_g1(wi, alpha) * microfacet.smith_g1(wo, alpha)
    return {"d": d, "g": g, "value": value[0], "pdf": pdf}


# For each formula its terms, and its Fresnel term by cosine and index
FORMULAS: dict[str, tuple[Callable[..., Terms], Callable[[Any, Any], Any]]] = {
    "report": (report, lambda cos, ior: report_fresnel(cos, 1, ior)),
    "roughconductor": (roughconductor, lambda cos, ior: mi.fresnel_conductor(cos, mi.Complex2f(ior, 0))),
    "mrt_bsdf": (mrt_bsdf, lambda cos, ior: fresnel.fresnel_dielectric(cos, 1, ior)),
}
