"""The filters on pictures that are constant, tiny, damaged or of huge range."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np

from mrt_mitsuba import filters
from mrt_mitsuba.validation.studies.stability.cases import Cases, both_variants
from mrt_mitsuba.validation.tools.study import Study

SHAPES = ((1, 1), (1, 17), (17, 1), (2, 2), (3, 3), (1, 2), (40, 30))
BLUR = {"focal_distance": 2.0, "focal_range": 0.5}
MODES = ("report", "corrected")

# A blurred pixel is a weighted mean of at most 16² others: sums of as many float32 products
MEAN = 64 * 2.0**-24

Edges = Callable[[np.ndarray, np.ndarray], Any]
EDGES: dict[str, Edges] = {
    "luma": lambda image, depth: filters.luma_edges(image),
    "sobel": lambda image, depth: filters.sobel_edges(image),
    "geometry": lambda image, depth: filters.geometry_edges(
        image * 0 + np.array([0, 0, 1], np.float32), depth
    ),
}


def run(study: Study, *, quick: bool) -> None:
    """Make the table of cases, in both kinds of variants."""
    del quick  # all of it is quick
    cases = Cases(study, "filters", "Filters")
    for suffix in both_variants():
        for name, what, expected, limit, measure in CASES:
            cases.at_most(name + suffix, what, expected, measure(), limit)
    why = "the smallest weights are 2⁻³⁰: their products are below the least normal float32 and become 0"
    cases.beyond_float32("constant pictures of 1e-30, blur", "relative change", constant_blur((1e-30,)), why)
    cases.close()


def _constant(shape: Sequence[int], value: float) -> np.ndarray:
    return np.full((*shape, 3), value, np.float32)


def _blurred(image: np.ndarray, depth: np.ndarray, mode: str, **changes: Any) -> np.ndarray:
    return np.asarray(filters.gaussian_dof(image, depth, mode=mode, **{**BLUR, **changes}))


def _noise(shape: Sequence[int], seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random((*shape, 3)).astype(np.float32)


def _depths(shape: Sequence[int], seed: int = 2) -> np.ndarray:
    """Return distances on both sides of the focus, and some misses."""
    depth = np.random.default_rng(seed).uniform(0.1, 12, shape).astype(np.float32)
    depth[np.random.default_rng(seed + 1).random(shape) < 0.1] = np.inf
    return depth


# ------------------------------------------------ Figures --------------------------------------------------


def constant_blur(values: Sequence[float]) -> float:
    return max(
        np.abs(_blurred(_constant(shape, value), _depths(shape), mode) / value - 1).max()
        for shape, value, mode in product(SHAPES, values, MODES)
    )


def constant_edges() -> float:
    return sum(
        np.asarray(find(_constant(shape, value), np.full(shape, 3, np.float32)).mask).sum()
        for shape, value, find in product(SHAPES, (0.5, 100.0, 1e6), EDGES.values())
    )


def outside_range() -> float:
    excess = 0.0
    for shape, mode in product(SHAPES, MODES):
        image = _noise(shape) * np.float32(1e20) - np.float32(3e19)
        out, low, high = _blurred(image, _depths(shape), mode), image.min(), image.max()
        excess = max(excess, np.maximum(low - out, out - high).max() / max(abs(low), abs(high)))
    return excess


def spread_of_damage(value: float) -> float:
    image, depth = _noise((40, 30)), _depths((40, 30))
    image[20, 15, 1] = value
    return sum((~np.isfinite(_blurred(image, depth, mode)).all(axis=-1)).sum() - 1 for mode in MODES)


def damage_kept() -> float:
    image, depth = _noise((40, 30)), _depths((40, 30))
    image[20, 15, 1] = np.nan
    return any(not np.isnan(_blurred(image, depth, mode)[20, 15, 1]) for mode in MODES)


def damage_reported(value: float) -> float:
    wrong = 0
    for name, find in EDGES.items():
        image, depth = _constant((12, 10), 0.5), np.full((12, 10), 3, np.float32)
        if name == "geometry":
            depth[6, 5] = np.nan
        else:
            image[6, 5, 2] = value
        found = find(image, depth)
        expected = np.zeros((12, 10), bool)
        expected[5:8, 4:7] = True
        wrong += (np.isinf(np.asarray(found.value)) != expected).sum()
        wrong += (~np.asarray(found.mask)[expected]).sum()
    return wrong


def border() -> float:
    image, depth = _noise((40, 30)), np.full((40, 30), 2.0, np.float32)
    depth[18:22, 13:17] = 30.0
    cut, changes = (slice(4, -4), slice(4, -4)), []
    for mode in MODES:
        inner, outer = _blurred(image[cut], depth[cut], mode), _blurred(image, depth, mode)
        changes += [inner[0] - outer[4, 4:-4], inner[-1] - image[-5, 4:-4]]
    return np.abs(changes).max()


def huge_range() -> float:
    image = (10 ** np.random.default_rng(5).uniform(-38, 34, (20, 20, 3))).astype(np.float32)
    depth = (10 ** np.random.default_rng(6).uniform(-30, 30, (20, 20))).astype(np.float32)
    return sum(
        (~np.isfinite(_blurred(image, depth, mode, focal_distance=f, focal_range=r))).sum()
        for mode, f, r in product(MODES, (1e-30, 1.0, 1e30), (0.0, 1e-30, 1e30, np.inf))
    )


def edges_finite() -> float:
    rng = np.random.default_rng(7)
    image = (10 ** rng.uniform(-38, 34, (20, 20, 3)) * rng.choice([-1, 1], (20, 20, 3))).astype(np.float32)
    depth = (10 ** rng.uniform(-37, 37, (20, 20))).astype(np.float32)
    return sum(np.isnan(np.asarray(find(image, depth).value)).sum() for find in EDGES.values())


# -------------------------------------------------- Cases --------------------------------------------------

SAME, LOCAL = "the same", "none: damage stays local"

# One row for each case: name, what its figure is, what is expected, limit, and how it is found
CASES: tuple[tuple[str, str, str, float, Callable[[], float]], ...] = (
    ("constant pictures, blur", "1×1 … 40×30, values 1e-25, 0.3, 1e30: relative change", "a mean of equals",
     MEAN, lambda: constant_blur((1e-25, 0.3, 1e30))),
    ("constant pictures, edges", "1×1 … 40×30, values 0.5, 100, 1e6: edge pixels, all detectors", "none", 0,
     constant_edges),
    ("range of a blur", "values to 1e20, negative ones too: how far means leave their range", "not at all",
     MEAN, outside_range),
    ("NaN in a picture, blur", "other pixels that are not finite afterwards", LOCAL, 0,
     lambda: spread_of_damage(np.nan)),
    ("infinity in a picture, blur", SAME, LOCAL, 0, lambda: spread_of_damage(np.inf)),
    ("NaN in a picture, kept", "1 if the pixel itself is hidden", "it stays to be seen", 0, damage_kept),
    ("NaN in a picture, edges", "pixels not marked in its 3×3, or marked elsewhere",
     "none: reported, and local", 0, lambda: damage_reported(np.nan)),
    ("infinity in a picture, edges", SAME, "none", 0, lambda: damage_reported(np.inf)),
    ("blur in the middle", "change at the border", "none", 0, border),
    ("huge ranges, blur", "values that are not finite, pictures 1e-38 … 1e34, depths 1e-30 … 1e30", "none", 0,
     huge_range),
    ("huge ranges, edges", "NaN among the values, pictures to ±1e34", "none", 0, edges_finite),
)  # fmt: skip
