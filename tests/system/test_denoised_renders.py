"""``denoise=True``: what it saves, what it leaves out, what it refuses."""

from __future__ import annotations

import sys

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from numpy.testing import assert_allclose, assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.adaptive.metric import METRICS
from mrt_mitsuba.validation.scenery import load_kind

SIZE = 96


@pytest.fixture(scope="module")
def calm() -> mi.Scene:
    mrt.register()
    return load_kind("calm", SIZE)


def test_the_noisy_mean_is_that_without_denoising(calm):
    plain = mrt.render(calm, aamode="noise", spp=64)
    found = mrt.render(calm, denoise=True, spp=64)
    noisy = np.stack([found.layers[f"noisy.{letter}"] for letter in "RGB"], -1)
    assert_array_equal(noisy, plain.image)
    weight = found.layers["denoised.Y"]
    assert weight.min() >= 0 and weight.max() <= 1
    assert_array_equal(found.image[weight == 0], noisy[weight == 0])
    assert found.rounds[-1].rmse == found.error.rmse < 0.9 * plain.error.rmse
    assert np.sqrt(np.mean(found.layers["error.Y"] ** 2)) == pytest.approx(found.error.rmse, rel=0.05)
    assert "denoised" in str(found.plan)
    assert_array_equal(mrt.render(calm, denoise=True, spp=64).image, found.image)


@pytest.mark.parametrize(("metric", "target"), [("linear", 0.0025), ("relative", 0.008), ("display", 0.0025)])
def test_a_target_takes_fewer_rays(calm, metric, target):
    """A third and more; and the true error is in the stated interval of 95 %."""
    truth = np.mean([np.array(mi.render(calm, spp=1024, seed=k)) for k in range(4)], 0)
    options = {"target": target, "metric": metric}
    plain = mrt.render(calm, **options)
    found = mrt.render(calm, denoise=True, **options)
    assert found.rounds[-1].spp < 0.67 * plain.rounds[-1].spp
    assert found.error.metric == metric
    # not by luck: a third of the way from its square to that of the upper end is within the target
    assert (2 * found.error.rmse**2 + found.error.high**2) / 3 <= found.error.target**2
    assert found.error.low <= METRICS[metric].rmse(found.image, truth) <= found.error.high
    assert found.options["denoise"] is True
    assert found.rounds[-1].rmse == found.error.rmse


def test_a_denoised_target_takes_rays_enough_to_show_what_is_rare():
    """The halves of 8 rays a pixel may agree where both are wrong."""
    mrt.register()
    scene = load_kind("gloss", 64)
    found = [
        mrt.render(scene, target=0.02, metric="display", denoise=True, seed=seed) for seed in range(505, 509)
    ]
    assert min(result.rounds[-1].spp for result in found) > 25


def test_what_does_not_pay_is_left_out(calm):
    """Of a chessboard far finer than pixels, a denoiser knows nothing that rays do not say sooner."""
    scene = load_kind("texture", SIZE)
    found = mrt.render(scene, target=0.003, denoise=True)
    plain = mrt.render(scene, target=0.003)
    assert "without denoising:" in str(found.plan)
    assert found.layers["denoised.Y"].max() == 0
    assert found.error.rmse <= found.error.target
    assert found.rounds[-1].spp < 1.2 * plain.rounds[-1].spp


def test_samples_that_a_filter_shares_are_denoised_before_it(calm):
    """Noise of pixels that share samples hardly is; and a target is reached, though whole groups of samples
    in whole regions are more than a round needs."""
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": SIZE, "height": SIZE, "rfilter": {"type": "gaussian"}}
    scene = mi.load_dict(box)
    options = {"integrator": "path", "target": "1.5%", "metric": "display"}
    found = mrt.render(scene, denoise=True, **options)
    assert found.error.rmse <= found.error.target
    assert found.layers["denoised.Y"].mean() > 0.5
    assert found.rounds[-1].spp < 0.8 * mrt.render(scene, **options).rounds[-1].spp
    box["sensor"]["film"]["rfilter"]["stddev"] = 1.0  # what is denoised must be as wide, or hardly counts
    wide = mrt.render(mi.load_dict(box), integrator="path", denoise=True, spp=64)
    assert wide.layers["denoised.Y"].mean() > 0.3


def test_mrt_adaptive_denoises(calm):
    nested = {"type": "mrt_adaptive", "spp": 64, "denoise": True, "nested": {"type": "path", "max_depth": 5}}
    shown = np.array(mi.render(calm, integrator=mi.load_dict(nested)))
    assert_allclose(shown[..., :3], mrt.render(calm, denoise=True, spp=64).image, atol=1e-6)


refused = Cases()
refused(dict(denoise=True), "denoise needs two half pictures: give target or spp")
refused(
    dict(denoise=True, spp=64, focaldist=2.0), "denoise with depth of field as a filter: write focaldist=0"
)
refused(dict(denoise=True, spp=2), "16 or more")
refused(dict(denoise="maybe", spp=64), "denoise='maybe'")


@pytest.mark.parametrize(("options", "words"), refused)
def test_refusals(calm, options, words):
    with pytest.raises(mrt.UsageError, match=words):
        mrt.render(calm, **options)


def test_a_missing_library_is_named_before_anything_is_traced(calm, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(mrt.MrtError, match=r"pip install 'mrt-mitsuba\[denoise\]'"):
        mrt.render(calm, denoise=True, spp=64, on_round=lambda round: pytest.fail("it traced"))
