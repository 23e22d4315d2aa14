"""What a law makes of the errors that it is given."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mrt_mitsuba.validation.laws.bsdf import LAWS
from mrt_mitsuba.validation.laws.law import Law


def weights() -> Law:
    return Law("weights", figures=LAWS["weights"].figures)


@pytest.mark.parametrize("place", [0, 5, 9])
@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1.0])
def test_one_error_of_many_that_is_no_number_or_too_large_breaks_the_law(place, wrong):
    errors = np.zeros(10)
    law = weights()
    law.hold("density", errors)
    assert law.holds
    errors[place] = wrong
    law.hold("density", errors)
    assert not law.holds
    assert law.worst.measured == pytest.approx(wrong, nan_ok=True)


def test_a_law_that_measured_nothing_does_not_hold():
    law = weights()
    assert not law.holds
    law.skipped = "it makes no sense here"
    assert law.holds
