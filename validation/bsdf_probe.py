"""Questions put to a BSDF in its local frame, in the current variant: values, densities and albedos.

Directions are unit vectors [N, 3] or [3], used in float32; the normal is +z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrt_mitsuba.validation.laws.probe import Array, Lanes, Probe, direction, unit

RESOLUTION = 700  # of the quadrature of an albedo, on each axis


def rgb(value: float | Sequence[float]) -> dict[str, object]:
    """Return a colour, or a grey, as a Mitsuba dict."""
    return {"type": "rgb", "value": value if isinstance(value, float | int) else list(value)}


def at_angle(degrees: float) -> Array:
    """Return a direction at an angle to the normal, away from every axis and plane of symmetry."""
    theta = np.radians(degrees)
    return np.array([np.sin(theta) * 0.8, np.sin(theta) * 0.6, np.cos(theta)])


def pairs_about(cosine: Array, slope: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pairs of directions [N, 3] with half vectors of these slopes [N], at random azimuths, in float32.

    The first ones have these cosines [N] to the normal; the second ones may point down.
    """
    phi, psi = rng.uniform(0, 2 * np.pi, (2, len(cosine)))
    wi = direction(cosine, phi)
    m = np.stack([slope * np.cos(psi), slope * np.sin(psi), np.ones_like(slope)], axis=-1)
    m /= np.linalg.norm(m, axis=-1, keepdims=True)
    return wi, np.float32(2 * (wi * m).sum(axis=-1, keepdims=True) * m - wi)


def lobe_pairs(count: int, alpha: float) -> tuple[Array, Array]:
    """Pairs of random directions above the surface whose half vector lies within a slope of 4 alpha.

    Both cosines are at least 0.02. Beyond that slope the lobe is below e^-16 of its peak.
    """
    rng = np.random.default_rng(1)
    pairs = np.empty((2, 0, 3))
    while pairs.shape[1] < count:
        slope = alpha * 4 * np.sqrt(rng.random(4 * count))
        wi, wo = pairs_about(rng.uniform(0.02, 1, 4 * count), slope, rng)
        pairs = np.concatenate([pairs, np.stack([wi, wo])[:, wo[:, 2] > 0.02]], axis=1)
    return unit(pairs[0, :count]), unit(pairs[1, :count])


def evaluate(bsdf: Any, wi: Array, wo: Array) -> list[Array]:
    """Values f cos θo [N, channels] and density [N] of pairs of directions [N, 3]."""
    return Probe(bsdf).pair(Lanes(wi=wi, wo=wo, uv=np.zeros(2)))


def albedo(bsdf: Any, wi: Array) -> Array:
    """∫ f cos θo dωo [channels] by the midpoint rule in cos θo and φo, finer at the mirror azimuth.

    With ``RESOLUTION``² points the error is below 1e-4 for alpha >= 0.1.
    """
    middles = (np.arange(RESOLUTION) + 0.5) / RESOLUTION
    s = 2 * middles - 1
    phi = np.arctan2(-wi[1], -wi[0]) + np.pi * s * abs(s)
    value, _ = evaluate(bsdf, wi, direction(middles[:, None], phi).reshape(-1, 3))
    # dω = d cos dφ, dφ = 2π |s| ds, ds = 2 dv
    weight = np.broadcast_to(4 * np.pi * abs(s), (RESOLUTION, RESOLUTION)).ravel() / RESOLUTION**2
    return (np.float64(value) * weight[:, None]).sum(axis=0)


def relative_error(found: Array, expected: Array) -> Array:
    """|found / expected − 1| where the expected value is above 1e-7 of the largest, else 0. [N]"""
    counts = expected > 1e-7 * expected.max()
    return abs(np.where(counts, found, 1) / np.where(counts, expected, 1) - 1)
