"""Depth of field: the report's filter against the float64 loops, the corrected one against a lens."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrt_mitsuba import UsageError, runtime
from mrt_mitsuba.filters import blur_amount, gaussian_dof
from mrt_mitsuba.validation.oracles import filters as reference

needs_llvm = pytest.mark.skipif(runtime.obstacle("llvm_ad_rgb") is not None, reason="no LLVM to run kernels")
BACKENDS = [pytest.param("llvm", marks=needs_llvm), pytest.param("llvm.ad", marks=needs_llvm), "scalar"]
MODES = ["report", "corrected"]

# Float32 sums of up to 16 weighted values along rows, 16 along columns, and a quotient: 33 roundings of 6e-8.
REPORT_TOLERANCE = 2e-6

SIXTEENTH = st.integers(0, 16 * 14).map(
    lambda n: n / 16
)  # exact in float32, and so is every amount made of them
ANY_PICTURE = given(
    size=st.one_of(st.just((37, 41)), st.tuples(st.integers(1, 30), st.integers(1, 20))),
    seed=st.integers(0, 2**32 - 1),
    focal_distance=SIXTEENTH.filter(bool),
    focal_range=SIXTEENTH,
)


def tensor(backend: str, array: np.ndarray) -> Any:
    return importlib.import_module(f"drjit.{backend}").TensorXf(np.ascontiguousarray(array, dtype=np.float32))


def depths(size: tuple[int, int], seed: int) -> np.ndarray:
    """Distances in sixteenths from 0 to 14 in patches and speckles, with misses of all kinds."""
    rng = np.random.default_rng(seed)
    patches = rng.integers(0, 16 * 14, (3, 4)) / 16
    depth = patches[np.arange(size[0]) * 3 // size[0]][:, np.arange(size[1]) * 4 // size[1]]
    speckles = rng.random(size) < 0.2
    depth[speckles] = rng.choice([1 / 16, 1, 2.5, 6, 12, 0, -1, np.inf], speckles.sum())
    return depth


def colours(size: tuple[int, int], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (*size, 3)).astype(np.float32)


def far(*, amount: np.ndarray | float) -> np.ndarray:
    """Distances behind a focus at 1 with range 0 that give these amounts."""
    return 1 + np.asarray(amount, dtype=np.float64)


def near(*, amount: np.ndarray | float) -> np.ndarray:
    """Distances before a focus at 10 with range 0 that give these amounts."""
    return 10 - np.asarray(amount, dtype=np.float64)


def blurred(image: np.ndarray, depth: np.ndarray, *, focal_distance: float = 1.0, mode: str) -> np.ndarray:
    return gaussian_dof(image, depth, focal_distance=focal_distance, focal_range=0, mode=mode)


# ---- amount ----


@given(
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    seed=st.integers(0, 2**32 - 1),
    focal_distance=SIXTEENTH.filter(bool),
    focal_range=st.one_of(SIXTEENTH, st.sampled_from([1e30, math.inf])),
)
@settings(max_examples=40, deadline=None)
def test_amount_equals_the_definition(
    size: tuple[int, int], seed: int, focal_distance: float, focal_range: float
) -> None:
    depth = depths(size, seed)
    amount = blur_amount(depth, focal_distance=focal_distance, focal_range=focal_range)
    assert amount.dtype == np.float32
    # sixteenths: no rounding anywhere
    np.testing.assert_array_equal(amount, reference.blur_amount(depth, focal_distance, focal_range))


@pytest.mark.parametrize(
    ("reach", "expected"), [({}, [0, 1, 8, 8, 8]), ({"focal_range": math.inf}, [0, 0, 8, 8, 8])]
)
def test_amount_of_bad_depths_and_misses(reach: dict[str, float], expected: list[float]) -> None:
    """A depth that is no number is sharp, a miss blurred whatever the range, which is two unless given."""
    depth = np.array([[np.nan, 5.0, np.inf, 0.0, -3.0]])
    assert blur_amount(depth, focal_distance=2.0, **reach).tolist() == [expected]


# ---- the report's filter ----


@pytest.mark.parametrize("backend", BACKENDS)
@ANY_PICTURE
@settings(max_examples=25)
def test_report_equals_the_loops(
    backend: str, size: tuple[int, int], seed: int, focal_distance: float, focal_range: float
) -> None:
    """Windows of every size, cut at borders; what is in focus gives nothing; below k = 1 nothing is taken."""
    image, depth = colours(size, seed), depths(size, seed)
    found = gaussian_dof(
        tensor(backend, image), tensor(backend, depth), focal_distance=focal_distance, focal_range=focal_range
    )
    amount = reference.blur_amount(depth, focal_distance, focal_range)
    np.testing.assert_allclose(
        np.array(found), reference.gaussian_dof(image, amount), atol=REPORT_TOLERANCE, rtol=0
    )
    np.testing.assert_array_equal(np.array(found)[amount < 1], image[amount < 1])


# ---- both modes ----


@pytest.mark.parametrize("mode", MODES)
def test_a_bad_colour_gives_nothing(mode: str) -> None:
    image = np.full((25, 30, 3), 0.75)
    image[12, 15, 2] = image[3, 0, 0] = np.nan
    good = np.isfinite(image).all(axis=-1)
    for depth in (far(amount=np.full((25, 30), 8)), far(amount=np.arange(750).reshape(25, 30) % 9)):
        found = blurred(image, depth, mode=mode)
        # the weights of what is left add up to one, but for the rounding of their sums of 61 terms at most
        np.testing.assert_allclose(found[good], 0.75, rtol=61 * 6e-8)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mode", MODES)
def test_backends_agree_repeat_and_leave_their_input(backend: str, mode: str) -> None:
    image, depth = colours((40, 50), 1), depths((40, 50), 1)
    options = {"focal_distance": 3.0, "focal_range": 0.5, "mode": mode}
    plain = gaussian_dof(image, depth, **options)
    assert isinstance(plain, np.ndarray) and plain.dtype == np.float32
    given_image = tensor(backend, image)
    first, second = (gaussian_dof(given_image, depth, **options) for _ in range(2))
    assert type(first) is type(given_image) and first.shape == (40, 50, 3)
    np.testing.assert_array_equal(np.array(first), np.array(second))
    # the same operations in the same order, but for fused multiply-adds: as many roundings as there are terms
    np.testing.assert_allclose(np.array(first), plain, atol=61 * 6e-8)
    np.testing.assert_array_equal(np.array(given_image), image)
    assert (plain != image).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "lens"}, "unknown depth-of-field mode 'lens'; use one of report, corrected"),
        ({"focal_distance": math.nan}, "focal_distance is not a number"),
        ({"focal_range": math.nan}, "focal_range is not a number"),
        ({"depth": np.ones((5, 4))}, r"depth has shape \(5, 4\); expected \[4, 5\]"),
        ({"image": np.ones((4, 5))}, "image has shape"),
    ],
)
def test_wrong_arguments_are_named(change: dict[str, Any], message: str) -> None:
    arguments = {"image": np.zeros((4, 5, 3)), "depth": np.ones((4, 5)), "focal_distance": 1.0, **change}
    with pytest.raises(UsageError, match=message):
        gaussian_dof(**arguments)


# ---- the corrected filter ----


@ANY_PICTURE
@settings(max_examples=12)
def test_corrected_equals_the_loops(
    size: tuple[int, int], seed: int, focal_distance: float, focal_range: float
) -> None:
    """Discs of all sizes on both sides of the focus, layers near and far apart, borders."""
    image, depth = colours(size, seed), depths(size, seed)
    found = gaussian_dof(
        image, depth, focal_distance=focal_distance, focal_range=focal_range, mode="corrected"
    )
    radius = reference.disc_radius(reference.blur_amount(depth, focal_distance, focal_range))
    radius[(depth > 0) & (depth < focal_distance)] *= -1
    # float32 sums of up to 81 terms, and quotients of them
    np.testing.assert_allclose(found, reference.corrected_dof(image, radius), atol=5e-6)


def disc_share(distance: float, radius: float) -> float:
    """The share of a disc beyond a straight line at a distance from its centre (negative: most of it)."""
    ratio = np.clip(distance / radius, -1, 1)
    return float((math.acos(ratio) - ratio * math.sqrt(1 - ratio**2)) / math.pi)


@pytest.mark.parametrize("amount", [2.0, 5.0, 8.0])
def test_a_blurred_foreground_covers_and_uncovers_like_before_a_lens(amount: float) -> None:
    """A white half plane near the camera, over a black picture in focus: the lens sees its share."""
    image = np.zeros((21, 40, 3))
    image[:, 20:] = 1
    depth = np.full((21, 40), 10.0)
    depth[:, 20:] = near(amount=amount)
    found = blurred(image, depth, focal_distance=10.0, mode="corrected")[10, :, 0]
    radius = math.sqrt(2 * amount - 1)
    for column in range(40):
        truth = disc_share(19.5 - column, radius)  # the outline runs between columns 19 and 20
        # pixels instead of a smooth disc, and a rim one pixel wide: a tenth at the smallest radius, 1.7
        assert found[column] == pytest.approx(truth, abs=0.16 / radius)
    assert found[20 + math.ceil(radius)] == 1 and found[19 - math.ceil(radius)] == 0


@pytest.mark.parametrize("amount", [1.0, 2.5, 4.0, 8.0])
@pytest.mark.parametrize("side", [near, far])
def test_a_point_becomes_a_disc_of_the_stated_size(amount: float, side: Callable[..., np.ndarray]) -> None:
    image = np.zeros((31, 31, 3))
    image[15, 15] = 1
    focus = 10.0 if side is near else 1.0
    found = blurred(image, np.full((31, 31), side(amount=amount)), focal_distance=focus, mode="corrected")[
        ..., 0
    ]
    row, column = np.mgrid[-15:16, -15:16]
    core = math.sqrt(2 * amount - 23 / 16) - 0.5
    assert found.sum() == pytest.approx(1, abs=1e-5)  # light is kept; 61 roundings
    assert (found * column).sum() == pytest.approx(0, abs=1e-5)  # and centred
    assert (found * row).sum() == pytest.approx(0, abs=1e-5)
    assert found[np.hypot(row, column) >= core + 1].max() == 0
    assert np.ptp(found[np.hypot(row, column) <= core]) < 1e-7  # an even disc
    # as wide as Pascal's line of 2a entries, but for the coarseness of pixels: worst at a = 1.2, by 14 %
    assert (found * column**2).sum() == pytest.approx((2 * amount - 1) / 4, rel=0.1)
