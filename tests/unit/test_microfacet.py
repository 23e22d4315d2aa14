"""Microfacet terms against the textbook formulas in 50 digits, and by the laws they obey."""

from __future__ import annotations

from itertools import product

import drjit.scalar
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mrt_mitsuba.plugins.microfacet import (
    beckmann_d,
    microfacet_specular,
    sample_beckmann,
    smith_g1,
    smith_g1_over_cos,
    tan2_theta,
)
from mrt_mitsuba.plugins.quadric_kinds import Columns
from mrt_mitsuba.validation.oracles import exact

Vector = drjit.scalar.Array3f64
ALPHAS = st.floats(1e-3, 2)
COSINES = st.floats(1e-6, 1)

# The negative ones of scene 2
NEGATIVE_ALPHAS = (-0.0432, -0.0432 + 0.1 / 3)


def direction(cos_theta: float, phi: float = 0.3) -> Vector:
    sin_theta = np.sqrt((1 - cos_theta) * (1 + cos_theta))
    return Vector(sin_theta * np.cos(phi), sin_theta * np.sin(phi), cos_theta)


def float32(values) -> drjit.scalar.ArrayXf:
    return drjit.scalar.ArrayXf(np.ascontiguousarray(values, dtype=np.float32))


def vectors32(values: np.ndarray) -> Columns:
    return Columns(float32(column) for column in values.T)


def relative_errors(found, truth: list) -> np.ndarray:
    pairs = zip(np.array(found), truth, strict=True)
    return np.array([float(abs(exact.number(a) - b) / b) if b else float(a) for a, b in pairs])


# ------------------------------------------------- Values --------------------------------------------------

# The grid of the course's table
TABLE = [(0.1, 0.1), *product((0.1, 0.3, 0.5, 0.7, 0.9), (0.01, 0.21, 0.41, 0.61, 0.81))]


def test_course_table_to_six_decimals() -> None:
    """Agree in float64 and float32 at the decimal numbers of the table."""
    truth = [float(exact.beckmann_d(str(c), str(alpha))) for c, alpha in TABLE]
    assert sum(t > 1e-3 for t in truth) == 9
    double = [beckmann_d(1 / c**2 - 1, alpha) for c, alpha in TABLE]
    # exp enlarges the rounding of its argument, some 1e-16, by the argument: up to 30 where D counts
    np.testing.assert_allclose(double, truth, rtol=1e-13, atol=1e-16)
    c, alpha = (float32(column) for column in zip(*TABLE, strict=True))
    np.testing.assert_allclose(np.array(beckmann_d(1 / (c * c) - 1, alpha)), truth, rtol=0, atol=5e-7)


@pytest.mark.parametrize("alpha", [0.02, 0.3, 1.5, *NEGATIVE_ALPHAS])
def test_whole_lobe_is_the_formula_of_the_report(alpha: float) -> None:
    """D G / (4 cos θi cos θo) · cos θo in float64, off the mirror direction and at grazing angles."""
    for cosines, phi in product([(0.9, 0.85), (0.3, 0.31), (0.01, 0.4)], [3.1, 2.9]):
        wi, wo = direction(cosines[0], 0), direction(cosines[1], phi)
        truth = exact.specular_bsdf(wi, wo, alpha, form="unity") * exact.number(wo[2])
        found = microfacet_specular(wi, wo, tan2_theta(wi + wo), alpha)
        # rounding of the directions, enlarged by tan²/alpha² up to 1e4
        assert found == pytest.approx(float(truth), rel=1e-10, abs=1e-300)


# -------------------------------------------------- Laws ---------------------------------------------------


@given(cos_theta=COSINES, alpha=st.one_of(ALPHAS, st.sampled_from(NEGATIVE_ALPHAS)))
def test_g1_is_that_of_fifty_digits(cos_theta: float, alpha: float) -> None:
    """With the sign of alpha, which D does not have; of a vector of any length."""
    v = direction(cos_theta)
    assume(abs(v[2] / np.hypot(v[0], v[1]) / alpha - 1.6) > 1e-12 if cos_theta < 1 else alpha > 0)
    truth = float(exact.smith_g1(v, alpha))
    assert smith_g1(v, alpha) == pytest.approx(truth, rel=1e-12)
    assert smith_g1(v * 7, alpha) == pytest.approx(truth, rel=1e-12)
    assert smith_g1_over_cos(v, alpha) == pytest.approx(truth / cos_theta, rel=1e-12)
    assert beckmann_d(0.001, alpha) == beckmann_d(0.001, -alpha)
    assert smith_g1(Vector(0, 0, 1), alpha) == 1  # straight up there is no sign: b is infinite


@given(alpha=st.floats(-1, 1).filter(lambda a: abs(a) > 1e-6), u1=st.floats(0, 0.999), u2=st.floats(0, 1))
def test_drawn_normals_invert_the_distribution(alpha: float, u1: float, u2: float) -> None:
    """The share of normals steeper than the drawn one is 1 − u1: exp(−tan²θ / alpha²)."""
    m = sample_beckmann(alpha, u1, u2, Vector)
    assert np.linalg.norm(m) == pytest.approx(1, abs=1e-15)
    assert np.exp(-tan2_theta(m) / alpha**2) == pytest.approx(1 - u1, rel=1e-12)
    if u1 > 1e-6:
        angle = np.arctan2(m.y, m.x) / (2 * np.pi)
        assert abs((angle - u2 + 0.5) % 1 - 0.5) < 1e-9
