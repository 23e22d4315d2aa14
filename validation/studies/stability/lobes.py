"""Pairs of float32 directions on a grid of roughness, grazing angle and angle off the mirror direction."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from mpmath import mp, mpf

from mrt_mitsuba.validation.checks.probe import Lanes
from mrt_mitsuba.validation.oracles import exact

ALPHAS = 10.0 ** np.arange(-8, 3)
COSINES = np.array([1, 0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7])
# Edges of the cells of tan²θh / alpha², minus the logarithm of exp(-…): the last is where D is 1e-20 of its
# peak
STEEPNESS = np.array([0, 0.1, 1, 4, 9, -np.log(1e-7), 25, 35, -np.log(1e-20)])
IORS = np.array([1.5, 1.33, 3, 1 + 1e-7, 1 - 1e-7, 0.5, 1e-3, 1e6], np.float32)

CANDIDATES = 3000  # for each roughness and cosine, of which a few are kept for each cell


@dataclass(frozen=True)
class Lobes(Lanes):
    """N pairs of directions: what their float32 components say, and so the sum that is their half vector."""

    wi: np.ndarray  # float32 [N, 3]
    wo: np.ndarray  # float32 [N, 3]
    alpha: np.ndarray  # float32 [N]
    ior: np.ndarray  # float32 [N]
    steepness: np.ndarray  # float64 [N], tan²θh / alpha²
    cell: np.ndarray  # int [N, 3], in ALPHAS, COSINES and STEEPNESS

    def __len__(self) -> int:
        return len(self.alpha)

    @property
    def in_bound(self) -> np.ndarray:
        """Where the bound on errors applies: alpha from 1e-4 to 1, D at least 1e-7 of its peak. [N]"""
        alpha = self.cell[:, 0]
        first, last = np.searchsorted(ALPHAS, 0.9e-4), np.searchsorted(ALPHAS, 0.9)
        return (alpha >= first) & (alpha <= last) & (self.steepness <= STEEPNESS[5])


def _draw(rng: np.random.Generator, a: int, c: int, per_cell: int) -> Lobes:
    """Return pairs of one cell of roughness and cosine: most near the mirror direction, some anywhere."""
    alpha = np.float32(ALPHAS[a])
    wi = _directions(rng, np.full(CANDIDATES, COSINES[c]))
    near = rng.random((CANDIDATES, 1)) < 0.8
    # mirrored in normals of all steepnesses
    tan = alpha * np.sqrt(rng.uniform(0, STEEPNESS[-1], CANDIDATES) * rng.random(CANDIDATES))
    psi = rng.uniform(0, 2 * np.pi, CANDIDATES)
    m = np.stack([tan * np.cos(psi), tan * np.sin(psi), np.ones(CANDIDATES)], axis=1)
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    anywhere = _directions(rng, 10 ** rng.uniform(np.log10(COSINES[-1]), 0, CANDIDATES))
    wo = np.where(near, 2 * (wi * m).sum(axis=1, keepdims=True) * m - wi, anywhere)
    wi, wo = wi.astype(np.float32), wo.astype(np.float32)
    up = wo[:, 2] > 0.5 * COSINES[-1]
    wi, wo = wi[up], wo[up]
    h = wi.astype(np.float64) + wo  # exact to one rounding of float64
    steepness = (h[:, 0] ** 2 + h[:, 1] ** 2) / h[:, 2] ** 2 / np.float64(alpha) ** 2
    bins = np.searchsorted(STEEPNESS, steepness, side="right") - 1
    keep = np.concatenate([np.flatnonzero(bins == k)[:per_cell] for k in range(len(STEEPNESS) - 1)])
    cell = np.stack([np.full(len(keep), a), np.full(len(keep), c), bins[keep]], axis=1)
    ior = rng.choice(IORS, len(keep))
    return Lobes(wi[keep], wo[keep], np.full(len(keep), alpha), ior, steepness[keep], cell)


def _directions(rng: np.random.Generator, cosines: np.ndarray) -> np.ndarray:
    phi = rng.uniform(0, 2 * np.pi, len(cosines))
    sines = np.sqrt((1 - cosines) * (1 + cosines))
    return np.stack([sines * np.cos(phi), sines * np.sin(phi), cosines], axis=1)


# ------------------------------------------- The truth in 50 digits ---------------------------------------


@lru_cache(maxsize=4)
def lobes_with_truth(per_cell: int, seed: int = 1) -> tuple[Lobes, dict[str, np.ndarray]]:
    """Return up to ``per_cell`` pairs in every cell that float32 directions reach, and what they should give.

    The truth has 50 digits, rounded to float64: ``d``, ``g``, ``value``, ``pdf``, the ``gradient`` of the
    value with respect to alpha, and as its ``slope`` the sum of the sizes of the terms of that gradient.
    """
    rng = np.random.default_rng(seed)
    parts = [_draw(rng, a, c, per_cell) for a in range(len(ALPHAS)) for c in range(len(COSINES))]
    lobes = Lobes(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Lobes)))
    rows = [_exact(*pair) for pair in zip(lobes.wi, lobes.wo, lobes.alpha, lobes.ior, strict=True)]
    return lobes, dict(zip(("d", "g", "value", "pdf", "gradient", "slope"), np.array(rows).T, strict=True))


@mp.workdps(exact.DIGITS)
def _exact(wi: np.ndarray, wo: np.ndarray, alpha: float, ior: float) -> tuple[float, ...]:
    a = exact.number(alpha)
    x, y, z = (exact.number(p) + exact.number(q) for p, q in zip(wi, wo, strict=True))
    tan2 = (x * x + y * y) / (z * z)
    d = exact.beckmann_d(1 / mp.sqrt(1 + tan2), a)
    g_i, slope_i = _g1_and_slope(wi, a)
    g_o, slope_o = _g1_and_slope(wo, a)
    # Components are not rounded again: the cosine between the directions is that of them made one unit long
    sides = zip(exact.unit(list(wi)), exact.unit(list(wo)), strict=True)
    cos_d = mp.sqrt(sum((p + q) ** 2 for p, q in sides)) / 2
    f = exact.fresnel("dielectric", cos_d, 1, ior)
    z_i = exact.number(wi[2])
    value = d * f * g_i * g_o / (4 * z_i)
    # d ln D / d alpha = 2 (tan²/alpha² - 1) / alpha, and those of G₁
    steep = tan2 / a**2
    logarithmic = 2 * (steep - 1) / a + slope_i / g_i + slope_o / g_o
    size = 2 * (steep + 1) / a + abs(slope_i) / g_i + abs(slope_o) / g_o
    density = d / (4 * exact.visible_cos(wi, a))
    return tuple(map(float, (d, g_i * g_o, value, density, value * logarithmic, value * size)))


def _g1_and_slope(v: np.ndarray, alpha: mpf) -> tuple[mpf, mpf]:
    """Return G₁ and its derivative with respect to alpha, by a difference far finer than float64."""
    g = exact.smith_g1(v, alpha)
    if g == 1:
        return g, mpf(0)
    step = alpha * mpf("1e-20")
    return g, (exact.smith_g1(v, alpha + step) - g) / step
