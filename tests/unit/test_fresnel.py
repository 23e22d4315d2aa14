"""Fresnel terms against the textbook formulas in 50 digits, and by the laws they obey."""

from __future__ import annotations

import drjit.scalar
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from mpmath import mp
from numpy.testing import assert_allclose, assert_array_equal

from mrt_mitsuba.plugins.fresnel import f0_from_ior, fresnel_dielectric, fresnel_schlick
from mrt_mitsuba.validation.oracles import exact

COSINES = st.floats(0, 1)
INDICES = st.floats(0.2, 8)
# In float64 some twenty roundings of 1.1e-16 on numbers of about 1, enlarged tenfold near the critical angle
ROUNDING = 2e-14


def float32(values) -> drjit.scalar.ArrayXf:
    return drjit.scalar.ArrayXf(np.asarray(values, dtype=np.float32))


def test_sine_serves_where_the_cosine_is_rounded_to_one():
    """Near the normal there still are Schlick's (1 − cos θ)⁵ and a critical angle."""
    s2 = float32(10 ** np.linspace(-12, -4, 80))
    sines = [exact.number(s) for s in np.array(s2)]
    c = float32([mp.sqrt(1 - s) for s in sines])
    assert (np.array(c) == 1).sum() > 40
    truth = [float((s / (1 + mp.sqrt(1 - s))) ** 5) for s in sines]
    # the fifth power of three roundings; below 1e-37 float32 ends
    assert_allclose(np.array(fresnel_schlick(c, 0, s2)), truth, rtol=2e-6, atol=1e-37)
    ones = float32(np.ones(80))
    reflected = fresnel_dielectric(c, ones, 1e-5 * ones, s2)
    assert_array_equal(np.array(reflected) == 1, np.array(s2) >= 1e-10)


@given(cos_theta=COSINES, n1=INDICES, n2=INDICES)
@example(cos_theta=0.0, n1=1.0, n2=1.5)
@example(cos_theta=1.0, n1=1.0, n2=1.5)
@example(cos_theta=0.5, n1=1.3, n2=1.3)
def test_float64_is_that_of_fifty_digits(cos_theta, n1, n2):
    """And so between 0 and 1, the same from both sides, and decided by the ratio of the indices."""
    # next to the critical angle, F changes with the root of what is missing
    beyond = n1**2 * (1 - cos_theta**2) - n2**2
    assume(abs(beyond) > 1e-6 * n1**2)
    truth = float(exact.fresnel_dielectric(cos_theta, n1, n2))
    assert fresnel_dielectric(cos_theta, n1, n2) == pytest.approx(truth, rel=1e-9, abs=ROUNDING)
    f0 = float(exact.f0_from_ior(n1, n2))
    assert f0_from_ior(n1, n2) == pytest.approx(f0, rel=1e-13, abs=1e-30)
    assert fresnel_schlick(cos_theta, f0) == pytest.approx(exact.fresnel_schlick(cos_theta, f0), rel=ROUNDING)
