"""``mrt_bsdf`` against Mitsuba's ``roughconductor``: values, densities and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Literal

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rendering.film import derived_seed
from mrt_mitsuba.validation.bsdf_probe import evaluate, lobe_pairs, relative_error
from mrt_mitsuba.validation.compare import compare, p_values
from mrt_mitsuba.validation.laws.probe import is_scalar
from mrt_mitsuba.validation.scenery import load_room
from mrt_mitsuba.validation.study import Study, Values
from mrt_mitsuba.validation.timing import timed_in_turns

TITLE = "The BSDF against Mitsuba's roughconductor"

DISTRIBUTIONS = ("beckmann", "ggx")
ALPHAS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
# Of relative differences: exp of up to 16, of arguments that are right to a few roundings; roughconductor
# normalises Beckmann's visible normals by the rational fit of G₁, which is off by up to 0.4 %
LIMITS = {"value": 2e-5, "density of visible normals": 5e-3, "density of plain D sampling": 2e-5}
SCALAR_PAIRS = 60  # scalar variants take milliseconds for each
SHORT = 0.02  # of |ωi + ωo|²: above, Mitsuba's density is right to 3e-6
SAME = "pixels that differ, with the same random numbers"
RELATIVE = "relRMSE of the pictures"
P_VALUE = "probability of so much between equal pictures"
LEVEL = 1e-3  # probability with which a test of pictures rejects equal ones


def run(study: Study, *, quick: bool) -> None:
    """Run all parts; ``compare_roughconductor`` does the pictures of one roughness."""
    study.texts.append("With F = 1 and no diffuse part, mrt_bsdf and roughconductor are the same function.")
    pointwise(study, quick=quick)
    rendered(study, quick=quick)


def ours(alpha: float, distribution: str = "beckmann", *, visible: bool = True) -> Values:
    """``mrt_bsdf`` with F = 1 and no diffuse part."""
    lobe = {"fresnel": "unity", "diffuse_reflectance": 0.0, "distribution": distribution}
    return {"type": "mrt_bsdf", **lobe, "alpha": alpha, "sample_visible": visible}


def theirs(alpha: float, distribution: str = "beckmann", *, visible: bool = True) -> Values:
    """``roughconductor`` with F = 1."""
    lobe = {"material": "none", "distribution": distribution}
    return {"type": "roughconductor", **lobe, "alpha": alpha, "sample_visible": visible}


def compare_pointwise(alpha: float, distribution: str = "beckmann", *, count: int) -> dict[str, float]:
    """Return the largest relative differences over ``count`` random pairs of directions, by ``LIMITS``.

    Of plain D sampling's density only where |ωi + ωo|² > ``SHORT``: Mitsuba's divides by ωo·h and so feels
    the rounding of the length of ωo, by 6e-8 / |ωi + ωo|².
    """
    wi, wo = lobe_pairs(count, alpha)
    values = []
    densities = []
    for visible in (True, False):
        bsdfs = [mi.load_dict(of(alpha, distribution, visible=visible)) for of in (ours, theirs)]
        one, other = (evaluate(bsdf, wi, wo) for bsdf in bsdfs)
        values.append(relative_error(one[0], other[0]))
        densities.append(relative_error(one[1], other[1]))
    of_visible, of_plain = densities
    long = ((wi.astype(float) + wo) ** 2).sum(axis=-1) >= SHORT
    figures = (np.max(values), of_visible.max(), of_plain[long].max())
    return {name: float(x) for name, x in zip(LIMITS, figures, strict=True)}


def pointwise(study: Study, *, quick: bool) -> None:
    """Compare values and densities, over roughness and in every variant that can run here."""
    rows = []
    before = runtime.use()
    variants = runtime.usable_variants()
    if quick:  # every colour mode once, and one scalar variant
        variants = [name for name in variants if not name.startswith("scalar") or name == runtime.SLOW]
    for variant in study.each("points", variants):
        runtime.use(variant)
        pairs = SCALAR_PAIRS if is_scalar() else 5_000 if quick else 200_000
        for distribution in DISTRIBUTIONS:
            of = {"variant": variant, "distribution": distribution, "pairs": pairs}
            for alpha in ALPHAS:
                found = compare_pointwise(alpha, distribution, count=pairs)
                rows.append({**of, "alpha": alpha, **found})
    runtime.use(before)
    study.records("pointwise", "Largest relative differences from roughconductor", rows)
    why = "exp of up to 16, of arguments right to roundings; roughconductor's fit of G₁ as a normaliser"
    for name, limit in LIMITS.items():
        worst = np.max([row[name] for row in rows])
        study.at_most(f"{name}, relative, {len(variants)} variants", worst, limit, why)


@dataclass(frozen=True)
class RoughconductorComparison:
    """Ours against Mitsuba's, of one roughness. ``images``: "ours", "theirs", "difference" [H, W, 3]."""

    alpha: float
    errors: Mapping[str, float]  # by name, unitless
    timings: Mapping[str, float]  # seconds: the median of renders, kernels compiled before; and their ratio
    images: Mapping[str, NDArray[np.float32]]

    @property
    def equal(self) -> bool:
        """True if neither single points nor the pictures distinguish them."""
        unlikely = self.errors[P_VALUE] < LEVEL  # NaN without SciPy
        return not unlikely and all(self.errors[name] <= limit for name, limit in LIMITS.items())

    def __str__(self) -> str:
        verdict = "equal" if self.equal else "different"
        rows = {**self.errors, "time, ours / theirs": self.timings["ratio"]}
        lines = [f"  {name:<44} {value:.4g}" for name, value in rows.items()]
        return "\n".join([f"mrt_bsdf and roughconductor, alpha = {self.alpha:g}: {verdict}", *lines])


def compare_roughconductor(
    alpha: float = 0.1,
    *,
    distribution: Literal["beckmann", "ggx"] = "beckmann",
    size: int = 96,
    spp: int = 8,
    renders: int = 32,
    pairs: int = 20_000,
) -> RoughconductorComparison:
    """Compare ``mrt_bsdf`` (F = 1, no diffuse part) with Mitsuba's ``roughconductor``.

    ``size``: width of the pictures in pixels; ``spp``: samples per pixel of each of the ``renders``, whose
    mean and variance are compared; ``pairs``: of directions for the comparison point by point.

    The probability that the pictures are equal needs SciPy (extra ``validation``), and is NaN without.
    Works in a vectorised variant, which becomes current.
    Raises ``UsageError`` for a roughness or a distribution that ``roughconductor`` does not take.
    """
    if distribution not in DISTRIBUTIONS:
        raise UsageError(f"distribution={distribution!r}: one of {', '.join(DISTRIBUTIONS)}")
    if not 0 < alpha <= 1:
        raise UsageError(f"alpha={alpha!r}: roughconductor is compared for a roughness in (0, 1]")
    runtime.use(runtime.FAST)
    lamp = {"type": "point", "position": [1.5, 4, 1], "intensity": {"type": "rgb", "value": 15.0}}

    def load(bsdf: Callable[..., Values], visible: bool) -> mi.Scene:
        ball = bsdf(alpha, distribution, visible=visible)
        return load_room(size, size * 3 // 4, bsdf=ball, lamp=lamp, view={"fov": 30})

    scenes = [load(bsdf, True) for bsdf in (ours, theirs)]

    def render(index: int, turn: int) -> NDArray[np.float32]:
        return np.array(mi.render(scenes[index], spp=spp, seed=derived_seed(0, side=index + 1, turn=turn)))

    runs = timed_in_turns([partial(render, i) for i in range(2)], renders)
    pictures = np.array([side for side, _ in runs])  # [2, renders, H, W, 3]
    seconds, other_seconds = (float(np.median(times)) for _, times in runs)
    first, second = pictures.mean(axis=1, dtype=np.float64)
    # Drawn from D, whose density is the same in both. A path that rounding sends past the other side of an
    # edge goes on differently; anything else would show in most pixels of the ball
    plain = (load(bsdf, False) for bsdf in (ours, theirs))
    one, other = (np.array(mi.render(scene, spp=16, seed=1)) for scene in plain)
    differ = (abs(one - other) > 1e-4 * np.maximum(other, other.mean())).any(axis=-1)
    errors = {
        **compare_pointwise(alpha, distribution, count=pairs),
        RELATIVE: compare(first, second).rel_mse ** 0.5,
        P_VALUE: min(p_values(*pictures).values()) if find_spec("scipy") else math.nan,
        SAME: float(differ.mean()),
    }
    timings = {"ours": seconds, "theirs": other_seconds, "ratio": seconds / other_seconds}
    first, second, difference = np.array([first, second, first - second], np.float32)
    images = {"ours": first, "theirs": second, "difference": difference}
    return RoughconductorComparison(alpha, errors, timings, images)


def rendered(study: Study, *, quick: bool) -> None:
    """Compare pictures: equal with equal random numbers, alike with others; ``stock`` has the mistakes."""
    size, renders = (64, 64) if quick else (128, 96)
    for alpha in study.each("pictures", (0.3,) if quick else (0.03, 0.1, 0.3)):
        found = compare_roughconductor(alpha, size=size, renders=renders)
        at = f"alpha {alpha:g}"
        why = "paths that rounding sends past an edge; the ball covers a third of the picture"
        study.at_most(f"share of {SAME}, {at}", found.errors[SAME], 5e-3, why)
        what = f"p of the difference with independent numbers, {at}"
        why = "pixels, tiles and the picture"
        study.at_least(what, found.errors[P_VALUE], LEVEL, why)
        one, other, difference = found.images.values()
        sheet = np.concatenate([one, other, 20 * abs(difference)], axis=1)
        caption = f"Independent samples: the difference is noise, relRMSE {found.errors[RELATIVE]:.2g}. "
        caption += f"Time, ours over theirs: {found.timings['ratio']:.2f}."
        study.picture(f"pictures-{alpha:g}", f"Ours, Mitsuba's, |difference| × 20; {at}", sheet, caption)
