"""Oren and Nayar's rough matte surface: functions of arrays or plain numbers.

Directions are unit vectors in the local frame, above the surface; the normal
is +z.
"""

from __future__ import annotations

from typing import Any

import drjit as dr


def oren_nayar_weights(sigma: Any) -> tuple[Any, Any]:
    """A and B of the model; ``sigma`` >= 0: deviation of slopes, radians."""
    sigma2 = dr.square(sigma)
    return 1 - 0.5 * sigma2 / (sigma2 + 0.33), 0.45 * sigma2 / (sigma2 + 0.09)


def oren_nayar_cos(wi: Any, wo: Any, sigma: Any) -> Any:
    """f cos θo of a white surface, in 1/sr.

    The paper has A + B max(0, cos Δφ) sin θ> tan θ<, of the larger and the
    smaller angle. The product of the sines and the cosine is x x' + y y', and
    tan θ< divides by the larger cosine: no angle, and nothing to go wrong
    where an azimuth is undefined. That cosine is at least cos θo, so the
    ratio is at most one. Source: Oren and Nayar, "Generalization of Lambert's
    Reflectance Model", SIGGRAPH 1994, the qualitative model.
    """
    a, b = oren_nayar_weights(sigma)
    towards = dr.maximum(wi.x * wo.x + wi.y * wo.y, 0)
    ratio = wo.z / dr.maximum(wi.z, wo.z)
    return dr.inv_pi * (a * wo.z + b * towards * ratio)
