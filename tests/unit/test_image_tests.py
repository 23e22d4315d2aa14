"""The image tests keep their error rate on equal pictures and have power on different ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mrt_mitsuba import UsageError
from mrt_mitsuba.validation.tools.image_tests import (
    Comparison,
    Estimate,
    compare,
    estimate,
    exact,
    flip,
    rel_rmse,
    sidak,
)

SHAPE = (24, 32, 3)
RENDERS = 8
NOISE = 0.1  # standard deviation of one render, relative to the picture


def truth() -> np.ndarray:
    """A picture with bright, dim and black places."""
    y, x = np.mgrid[:24, :32] / 24
    return np.stack([0.2 + x, 0.5 * y, np.maximum(x - 0.5, 0)], axis=-1)


def noisy(picture: np.ndarray, seed: int, draw: str = "normal") -> Estimate:
    """An estimate from noise of mean 0 and standard deviation NOISE times the picture."""
    random = np.random.default_rng(seed)
    size = (RENDERS, *picture.shape)
    noise = random.normal(size=size) if draw == "normal" else random.gamma(16, size=size) / 4 - 4
    return estimate(picture * (1 + NOISE * noise))


def pair(changed: np.ndarray, seed: int = 0, **options: float) -> Comparison:
    return compare(noisy(changed, 2 * seed), noisy(truth(), 2 * seed + 1), **options)


@pytest.mark.parametrize("draw", ["normal", "gamma"])
def test_equal_pictures_are_rejected_as_often_as_the_level_says(draw: str) -> None:
    """gamma: noise as skewed as a mean of 16 exponential samples, which a picture's noise resembles."""
    level, trials = 0.1, 300
    found = [
        compare(noisy(truth(), 2 * i, draw), noisy(truth(), 2 * i + 1, draw), level=level)
        for i in range(trials)
    ]
    # both bounds fail a right test once in ten thousand times; the seeds are fixed
    for name in ("pixel", "tile", "image"):
        rejected = sum(name in comparison.detected_by for comparison in found)
        low, high = stats.binom.interval(0.9998, trials, 1 - (1 - level) ** (1 / 3))
        assert low <= rejected <= high, name
    low, high = stats.binom.interval(0.9998, trials, level)
    assert low <= sum(c.rejects for c in found) <= high


SPOT, PATCH = np.ones(SHAPE), np.ones(SHAPE)
SPOT[5, 7] = (
    1.8  # 16 standard deviations of the difference of means: with 14 degrees of freedom it takes as many
)
PATCH[:16, :16] = 1.07  # one of four tiles: each of its pixels is off by 1.4 standard deviations only


@pytest.mark.parametrize(
    ("factor", "seen", "unseen"),
    [(1.02, "image", "pixel"), (SPOT, "pixel", "image"), (SPOT, "pixel", "tile"), (PATCH, "tile", "pixel")],
)
def test_each_question_sees_what_the_others_do_not(factor, seen: str, unseen: str) -> None:
    """A scale by the mean, a pixel by itself, a patch by its tile."""
    found = pair(factor * truth())
    assert seen in found.detected_by and unseen not in found.detected_by


def test_power_grows_with_the_level() -> None:
    """A difference must be larger to be seen at a level of 1e-6."""
    seen = [sum(pair(s * truth(), seed, level=1e-6).rejects for seed in range(20)) for s in (1.002, 1.05)]
    assert seen[0] <= 1 and seen[1] == 20


def test_a_picture_without_noise_is_compared_too() -> None:
    """The sky has no noise at all: there any difference counts, but that of rounding does not."""
    flat = exact(np.full(SHAPE, 0.3))
    assert not compare(exact(np.full(SHAPE, np.float32(0.3))), flat).rejects
    spot = np.full(SHAPE, 0.3)
    spot[3, 4, 1] += 1e-3
    assert compare(exact(spot), flat).detected_by[0] == "pixel"
    black = exact(np.zeros(SHAPE))
    assert compare(black, black).p == 1
    assert not compare(noisy(truth(), 1), exact(truth())).rejects
    assert compare(noisy(1.05 * truth(), 1), exact(truth())).rejects


def test_z_is_the_difference_over_its_deviation() -> None:
    a, b = noisy(truth(), 1), noisy(truth(), 2)
    where = truth() > 0.05  # in darker places, the floor for rounding shows
    expected = (a.mean - b.mean)[where] / np.sqrt(a.variance + b.variance)[where]
    np.testing.assert_allclose(compare(a, b).z[where], expected, rtol=1e-3)


def test_odd_sizes_leave_no_pixel_out() -> None:
    """The last tile is one pixel wide: an error in it, too small for the pixel test, must be seen."""
    a, b = np.full((17, 33, 1), 0.5), np.full((17, 33, 1), 0.5)
    a[:, 32] += 0.02
    variance = np.full(a.shape, 0.02**2)  # 0.7 standard deviations in each of the 17 pixels
    found = compare(Estimate(a, variance), Estimate(b, variance), tile=16)
    assert found.t["tile"] == pytest.approx(4 / np.sqrt(2), rel=1e-3)
    assert found.t["image"] == pytest.approx(17 * 0.02 / (0.02 * np.sqrt(2 * 17 * 33)), rel=1e-3)


def test_sidak() -> None:
    assert sidak(0.1, 2) == pytest.approx(1 - 0.9**2, rel=1e-12)
    assert sidak(1e-20, 1000) == pytest.approx(1e-17, rel=1e-12)  # 1 - 1e-20 is 1 in float64
    assert sidak(1.0, 3) == 1 and sidak(0.0, 3) == 0


def test_rel_rmse() -> None:
    assert rel_rmse(1.1 * truth() + 0.3, 1.1 * truth() + 0.3) == 0
    b = np.full(SHAPE, 2.0)
    assert rel_rmse(1.02 * b, b) == pytest.approx(0.04 / np.sqrt(4.01), rel=1e-12)


def test_flip_grows_with_the_error() -> None:
    reference = truth()
    assert flip(reference, reference) == 0
    errors = [flip(reference, s * reference) for s in (1.02, 1.2, 2.0)]
    assert 0 < errors[0] < errors[1] < errors[2] < 1


ONES = np.ones((8, 8, 3))


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (ONES, np.ones((8, 9, 3)), "one size"),
        (ONES[..., 0], ONES[..., 0], "one size"),
        (ONES, -ONES, ">= 0; the image"),
        (np.nan * ONES, ONES, ">= 0; the reference"),
        (0 * ONES, ONES, "black"),
    ],
)
def test_flip_says_what_it_cannot_compare(a, b, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        flip(a, b)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: estimate(np.ones((1, *SHAPE))), "two or more"),
        (lambda: exact(np.full(SHAPE, np.inf)), "infinite"),
        (lambda: Estimate(np.ones(SHAPE), -np.ones(SHAPE)), "negative variance"),
        (lambda: compare(exact(np.ones(SHAPE)), exact(np.ones((3, 3, 3)))), "sizes must be the same"),
    ],
)
def test_wrong_estimates_are_named(wrong, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        wrong()
