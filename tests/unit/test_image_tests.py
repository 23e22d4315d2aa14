"""The image tests keep their error rate on equal pictures and have power on different ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy import stats

from mrt_mitsuba import UsageError
from mrt_mitsuba.validation.tools.compare import p_values

SHAPE = (24, 32, 3)
Y, X = np.mgrid[:24, :32] / 24
TRUTH = np.stack([0.2 + X, 0.5 * Y, np.maximum(X - 0.5, 0)], axis=-1)  # bright, dim and black places


def noisy(picture: np.ndarray, seed: int, draw: str = "normal") -> np.ndarray:
    """Eight renders with noise of mean 0 and a tenth of the picture as standard deviation."""
    random, size = np.random.default_rng(seed), (8, *picture.shape)
    noise = random.normal(size=size) if draw == "normal" else random.gamma(16, size=size) / 4 - 4
    return picture * (1 + 0.1 * noise)


def least(ours: ArrayLike, theirs: ArrayLike) -> float:
    return min(p_values(ours, theirs).values())


def pair(changed: np.ndarray, seed: int = 0, draw: str = "normal") -> dict[str, float]:
    return p_values(noisy(changed, 2 * seed, draw), noisy(TRUTH, 2 * seed + 1, draw))


@pytest.mark.parametrize("draw", ["normal", "gamma"])
def test_equal_pictures_are_rejected_as_often_as_the_level_says(draw: str) -> None:
    """gamma: noise as skewed as a mean of 16 exponential samples, which a picture's noise resembles."""
    level, trials = 0.1, 300
    found = np.array([list(pair(TRUTH, i, draw).values()) for i in range(trials)])
    # bounds fail a right test once in ten thousand times; the seeds are fixed
    one = 1 - (1 - level) ** (1 / 3)
    for p, rate in zip((*found.T, found.min(axis=1)), (one, one, one, level), strict=True):
        low, high = stats.binom.interval(0.9998, trials, rate)
        assert low <= (p < level).sum() <= high


SPOT, PATCH, EDGE = np.ones((3, *SHAPE))
SPOT[5, 7] = 1.8  # 16 standard deviations of the difference of means
PATCH[:16, :16] = 1.07  # one of four tiles: each of its pixels is off by 1.4 standard deviations only
EDGE[16:, 16:] = 1.09  # the last tile, which is half as high


@pytest.mark.parametrize(
    ("factor", "seen", "unseen"),
    [(1.02, "image", "pixel"), (SPOT, "pixel", "image"), (SPOT, "pixel", "tile"), (PATCH, "tile", "pixel"),
     (EDGE, "tile", "pixel")],
)  # fmt: skip
def test_each_question_sees_what_the_others_do_not(factor, seen: str, unseen: str) -> None:
    """A scale by the mean, a pixel by itself, a patch by its tile."""
    found = pair(factor * TRUTH)
    assert found[seen] < 1e-3 < found[unseen]


def test_a_picture_without_noise_is_compared_too() -> None:
    """The sky has no noise at all: there any difference counts, but that of rounding does not."""
    flat = np.full((8, *SHAPE), 0.3)
    assert least(flat.astype(np.float32), flat) > 0.1
    spot = flat.copy()
    spot[:, 3, 4, 1] += 1e-3
    assert p_values(spot, flat)["pixel"] < 1e-3
    assert least(0 * flat, 0 * flat) == 1
    assert least(noisy(1.05 * TRUTH, 1), [TRUTH, TRUTH]) < 1e-3 < least(noisy(TRUTH, 1), [TRUTH, TRUTH])


def test_p_values_are_welchs_of_sums_of_cells() -> None:
    a, b = np.random.default_rng(0).normal(0.5, 0.02, (2, 6, 17, 33, 1))
    p = stats.ttest_ind(a.sum(axis=(1, 2, 3)), b.sum(axis=(1, 2, 3)), equal_var=False).pvalue
    assert p_values(a, b, tile=16)["image"] == pytest.approx(1 - (1 - p) ** 3, rel=1e-2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [(TRUTH[None], "two or more"), (TRUTH, "two or more"), (np.ones((2, 3, 3, 3)), "of one size"),
     (np.full((2, *SHAPE), np.inf), "infinite")],
)  # fmt: skip
def test_wrong_renders_are_named(wrong, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        p_values(wrong, np.ones((2, *SHAPE)))
