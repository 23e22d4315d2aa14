"""The noise of float32 functions, of which a known amount was made."""

from __future__ import annotations

import numpy as np
import pytest

from mrt_mitsuba.validation.laws.noise import ALLOWANCE, ROUNDING, measure

STEP = 2.0**-23  # from one float32 number between 1 and 2 to the next
COUNT = 400


@pytest.mark.parametrize("slope", [0.0, 50.0, 400.0])
@pytest.mark.parametrize("deviation", [100.0, 1000.0])
def test_lost_digits_are_those_that_inputs_do_not_explain(slope, deviation):
    """A line with random numbers added: ``slope`` and ``deviation`` in roundings, by steps of the input."""
    rng = np.random.default_rng(5)

    def noisy(inputs: np.ndarray) -> np.ndarray:
        steps = (inputs[:, 0].astype(np.float64) - 1.5) / STEP
        return 1 + ROUNDING * (slope * steps + deviation * rng.normal(size=len(steps)))

    found = measure(noisy, np.full((COUNT, 1), 1.5, np.float32), lambda inputs: inputs)
    # A rounded input is off by half a step at most, evenly: 1/12 of a squared step; it is rounded twice
    explained = 2 * slope / np.sqrt(12)
    assert np.median(found.noise) == pytest.approx(deviation, rel=0.2)
    assert np.median(found.lost) == pytest.approx(deviation / np.hypot(explained, ALLOWANCE), rel=0.3)
