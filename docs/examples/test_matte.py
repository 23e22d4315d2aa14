"""What a BSDF has to prove: values, samples, energy, variants, messages."""

from __future__ import annotations

import mrt_mitsuba as mrt  # first: it chooses the LLVM library

# isort: split
import mitsuba as mi
import numpy as np
import pytest

import matte
from mrt_mitsuba.validation.bsdf_probe import (
    albedo,
    at_angle,
    evaluate,
    unit,
)


@pytest.fixture(autouse=True)
def plugins():
    mi.set_variant("llvm_ad_rgb")
    mrt.register()
    matte.register()


def bsdf(**parameters):
    return mi.load_dict({"type": "matte", "reflectance": 1.0, **parameters})


def textbook(wi, wo, sigma):
    """f cos θo as the paper writes it, with angles, in float64."""
    a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    theta_i, theta_o = np.arccos(wi[:, 2]), np.arccos(wo[:, 2])
    phi = np.arctan2(wi[:, 1], wi[:, 0]) - np.arctan2(wo[:, 1], wo[:, 0])
    large, small = np.maximum(theta_i, theta_o), np.minimum(theta_i, theta_o)
    shape = a + b * np.maximum(0, np.cos(phi)) * np.sin(large) * np.tan(small)
    return shape * wo[:, 2] / np.pi


def test_values_are_those_of_the_paper():
    pairs = np.random.default_rng(1).normal(size=(2, 10_000, 3))
    pairs[:, :, 2] = (
        np.abs(pairs[:, :, 2]) + 1e-3
    )  # arccos, in the expected value, fails below
    wi, wo = map(unit, pairs)
    value, _ = evaluate(bsdf(sigma=0.4), wi, wo)
    expected = textbook(wi.astype(float), wo.astype(float), 0.4)
    np.testing.assert_allclose(
        value[:, 0], expected, rtol=2e-6
    )  # 16 float32 roundings


@pytest.mark.parametrize("sigma", [0.0, 0.4])
def test_it_obeys_the_laws_of_any_bsdf(sigma):
    """Sampling, weights, energy, reciprocity, derivatives and more."""
    found = mrt.check_bsdf({"type": "matte", "sigma": sigma}, quick=True)
    assert found.passed, str(found)


def test_nothing_gives_back_more_than_the_model_admits():
    """At the horizon it is A + B / 2, at most 1.015, between 0.1 and 0.3."""
    sigmas = (0, 0.1, 0.2, 0.5, 2)
    assert (
        max(albedo(bsdf(sigma=sigma), at_angle(89))[0] for sigma in sigmas)
        < 1.016
    )


def scene():
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    film = {
        "type": "hdrfilm",
        "width": 8,
        "height": 6,
        "rfilter": {"type": "box"},
    }
    return {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": look,
            "film": film,
        },
        "lamp": {"type": "mrt_light", "position": [2, 3, 4]},
        "ball": {"type": "sphere", "bsdf": {"type": "matte", "sigma": 0.5}},
    }


def test_all_variants_draw_the_same():
    pictures = []
    for variant in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
        mi.set_variant(variant)
        pictures.append(mrt.render(scene(), aa=1, lattice="centered").image)
    assert pictures[0].max() > 0.1
    # in another order of float32 operations
    np.testing.assert_allclose(pictures[1], pictures[0], atol=1e-6)
    np.testing.assert_array_equal(pictures[2], pictures[0])


def test_a_wrong_value_is_named():
    with pytest.raises(
        RuntimeError, match=r'"sigma" is -1\.0, but must be .* >= 0'
    ):
        bsdf(sigma=-1.0)
