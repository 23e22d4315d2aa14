"""Metrics of an error: linear, relative, and as a screen shows it."""

from __future__ import annotations

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.adaptive.metric import METRICS
from mrt_mitsuba.adaptive.target import METRIC_NAMES
from mrt_mitsuba.files.images import to_8bit


def _pair(size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """A picture from dark to beyond white, and the same with small noise."""
    rng = np.random.default_rng(1)
    true = np.geomspace(1e-3, 4, 3 * size).reshape(1, size, 3)
    return true * (1 + 0.03 * rng.normal(size=true.shape)), true


def test_every_metric_has_its_name():
    assert tuple(METRICS) == METRIC_NAMES


def test_errors_are_those_that_others_define():
    noisy, true = _pair()
    found = mrt.compare(np.float32(noisy), np.float32(true))
    assert METRICS["linear"].rmse(noisy, true) == pytest.approx(found.rmse, rel=1e-4)
    assert METRICS["relative"].rmse(noisy, true) == pytest.approx(found.rel_mse**0.5, rel=1e-4)
    shown = [to_8bit(np.float32(picture), "srgb") / 255.0 for picture in (noisy, true)]
    rounding = np.square(1 / 255) / 6  # of two pictures of 8 bits
    expected = np.square(shown[0] - shown[1]).mean() - rounding
    assert METRICS["display"].rmse(noisy, true) ** 2 == pytest.approx(expected, abs=rounding)


def test_a_screen_shows_the_dark_in_proportion():
    """sRGB is linear up to 0.0031308, and goes on without a step."""
    dark = np.float32([0, 0.001, 0.003, 0.00314])
    np.testing.assert_allclose(METRICS["display"].encode(dark), 12.92 * dark, rtol=1e-4)


@pytest.mark.parametrize("name", METRICS)
def test_weights_turn_small_linear_errors_into_those_of_the_metric(name):
    noisy, true = _pair()
    metric = METRICS[name]
    weights = metric.weights(true, 1e-3 * true)
    expected = np.sqrt((weights * np.square(noisy - true)).mean())
    assert metric.rmse(noisy, true) == pytest.approx(expected, rel=0.03)
    assert (weights[true > 1.01] == 0).all() == (name == "display")


@pytest.mark.parametrize("name", METRICS)
def test_halves_estimate_the_error_of_their_mean(name):
    rng = np.random.default_rng(2)
    true = rng.uniform(0.05, 1.5, (100, 100, 3))
    halves = true + 0.02 * rng.normal(size=(2, *true.shape))
    metric = METRICS[name]
    estimated = metric.squared_errors(*halves).mean() ** 0.5
    assert estimated == pytest.approx(metric.rmse(halves.mean(0), true), rel=0.05)
