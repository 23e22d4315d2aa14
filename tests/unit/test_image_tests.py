"""The image tests keep their error rate on equal pictures and have power on different ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mrt_mitsuba import UsageError
from mrt_mitsuba.validation.tools.image_tests import Comparison, compare

SHAPE = (24, 32, 3)
Y, X = np.mgrid[:24, :32] / 24
TRUTH = np.stack([0.2 + X, 0.5 * Y, np.maximum(X - 0.5, 0)], axis=-1)  # bright, dim and black places


def noisy(picture: np.ndarray, seed: int, draw: str = "normal") -> np.ndarray:
    """Eight renders with noise of mean 0 and a tenth of the picture as standard deviation."""
    random, size = np.random.default_rng(seed), (8, *picture.shape)
    noise = random.normal(size=size) if draw == "normal" else random.gamma(16, size=size) / 4 - 4
    return picture * (1 + 0.1 * noise)


def pair(changed: np.ndarray, seed: int = 0, draw: str = "normal", level: float = 1e-3) -> Comparison:
    return compare(noisy(changed, 2 * seed, draw), noisy(TRUTH, 2 * seed + 1, draw), level=level)


@pytest.mark.parametrize("draw", ["normal", "gamma"])
def test_equal_pictures_are_rejected_as_often_as_the_level_says(draw: str) -> None:
    """gamma: noise as skewed as a mean of 16 exponential samples, which a picture's noise resembles."""
    level, trials = 0.1, 300
    found = [pair(TRUTH, i, draw, level) for i in range(trials)]
    counts = {name: sum(name in c.detected_by for c in found) for name in ("pixel", "tile", "image")}
    # both bounds fail a right test once in ten thousand times; the seeds are fixed
    for name, count in [*counts.items(), ("all", sum(c.rejects for c in found))]:
        rate = level if name == "all" else 1 - (1 - level) ** (1 / 3)
        low, high = stats.binom.interval(0.9998, trials, rate)
        assert low <= count <= high, name


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
    assert seen in found.detected_by and unseen not in found.detected_by
    assert found.p < 1e-3 and found.t[seen] > 4


def test_a_picture_without_noise_is_compared_too() -> None:
    """The sky has no noise at all: there any difference counts, but that of rounding does not."""
    flat = np.full((8, *SHAPE), 0.3)
    assert not compare(flat.astype(np.float32), flat).rejects
    spot = flat.copy()
    spot[:, 3, 4, 1] += 1e-3
    assert compare(spot, flat).detected_by[0] == "pixel"
    assert compare(0 * flat, 0 * flat).p == 1
    assert not compare(noisy(TRUTH, 1), [TRUTH, TRUTH]).rejects
    assert compare(noisy(1.05 * TRUTH, 1), [TRUTH, TRUTH]).rejects


def test_t_is_welchs_of_sums_of_cells() -> None:
    a, b = np.random.default_rng(0).normal(0.5, 0.02, (2, 6, 17, 33, 1))
    found = compare(a, b, tile=16)
    whole = stats.ttest_ind(a.sum(axis=(1, 2, 3)), b.sum(axis=(1, 2, 3)), equal_var=False)
    assert found.t["image"] == pytest.approx(abs(whole.statistic), rel=1e-3)
    assert found.p_values["image"] == pytest.approx(whole.pvalue, rel=1e-2)
    relative = (a.mean(axis=0) - b.mean(axis=0)) ** 2 / (b.mean(axis=0) ** 2 + 0.01)
    assert found.rel_rmse == pytest.approx(np.sqrt(relative.mean()), rel=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [(TRUTH[None], "two or more"), (TRUTH, "two or more"), (np.ones((2, 3, 3, 3)), "of one size"),
     (np.full((2, *SHAPE), np.inf), "infinite")],
)  # fmt: skip
def test_wrong_renders_are_named(wrong, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        compare(wrong, np.ones((2, *SHAPE)))
