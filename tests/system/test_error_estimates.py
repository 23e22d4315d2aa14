"""The error that a render estimates of its own picture: is it right where the noise is known?"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.film import Film
from mrt_mitsuba.validation.scenery import load_kind

pytestmark = pytest.mark.usefixtures("variant")


def noise(color: tuple[float, float, float] = (0.5, 0.5, 0.5), rare: float = 0.0) -> Any:
    """An integrator that sees noise from 0 to twice a mean colour, which no sequence can make less.

    ``rare``: the share of rays that meet 200 in addition.
    """

    class Noise(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            first, second = (_low_digits(sampler.next_1d()) for _ in range(2))
            bright = dr.select(second < rare, mi.Float(200), 0)
            return mi.Spectrum(2 * first * mi.Color3f(color) + bright), mi.Bool(True), []

        def to_string(self) -> str:
            return "Noise[]"

    return Noise(mi.Properties())


def _low_digits(number: mi.Float) -> mi.Float:
    """A number in [0, 1) made of the digits that no stratum decides."""
    scaled = number * 2.0**12
    return scaled - dr.floor(scaled)


def camera(width: int, height: int, rfilter: str = "box", **of_filter: float) -> mi.Scene:
    """A scene of nothing but a camera."""
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": rfilter, **of_filter}}
    return mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}})


def _rmse(image: np.ndarray, truth: Any) -> float:
    return math.sqrt(np.mean(np.square(image - truth, dtype=np.float64)))


@pytest.mark.parametrize("share", [0.9, 0.75, 0.6])
def test_a_target_takes_as_many_rays_as_independent_noise_needs(share):
    """In a picture so large that its first eight rays a pixel are enough to judge by.

    Targets are aimed at 5 % lower, and 30,000 squares tell an RMSE to half a percent.
    """
    target = share * math.sqrt(1 / 12 / 4)  # half of the rays of each half picture's mean
    result = mrt.render(camera(208, 152), integrator=noise(), target=target, seed=1)
    assert len(result.rounds) <= 4
    assert 0.9 < _rmse(result.image, 0.5) / target < 1.03
    assert 0.9 < result.error.rmse / target < 1.03


@pytest.mark.slow
def test_intervals_of_four_pixels_hold_as_often_as_they_say():
    """The upper end is exceeded by a fortieth or less: with a chance of 0.3 %, so in 400 renders by more than
    eight once in 10⁵ sets of seeds. Without its widening, by 4.8 %: by so few, once in a hundred."""
    scene = camera(2, 2)
    integrator = noise()
    errors = []
    for seed in range(400):
        result = mrt.render(scene, integrator=integrator, aamode="noise", spp=16, seed=seed)
        errors.append((_rmse(result.image, 0.5), result.error.low, result.error.rmse, result.error.high))
    true, low, rmse, high = np.transpose(errors)
    assert np.sum(true > high) <= 8
    assert np.sum(true < low) <= 40  # 4.7 %: 19 and five deviations
    assert np.sqrt(np.mean(rmse**2)) == pytest.approx(np.sqrt(np.mean(true**2)), rel=0.1)


def test_intervals_reach_farther_up_the_fewer_squares_there_are():
    ratios = []
    for side in (2, 8, 64):
        error = mrt.render(camera(side, side), integrator=noise(), aamode="noise", spp=16, seed=2).error
        ratios.append(math.log(error.high / error.rmse) / math.log(error.rmse / error.low))
    assert ratios[0] > 1.5
    assert ratios[0] > ratios[1] > ratios[2]
    assert ratios[2] == pytest.approx(1, abs=0.05)


def test_pixels_that_take_rays_take_all_that_the_filter_reaches_from():
    """The left half is noisy, the right one black: without rays from there, what lies next to it would come
    out too bright, by a tenth and more."""

    def half(amount: float) -> Any:
        class Half(mi.SamplingIntegrator):
            def sample(
                self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
            ) -> Any:
                value = 1 + amount * (2 * _low_digits(sampler.next_1d()) - 1)
                return mi.Spectrum(dr.select(ray.d.x > 0, value, 0)), mi.Bool(True), []

            def to_string(self) -> str:
                return "Half[]"

        return Half(mi.Properties())

    scene = camera(40, 48, "gaussian", stddev=2.0)
    truth = mrt.render(scene, integrator=half(0), aamode="none", spp=1024)
    found = mrt.render(scene, integrator=half(1), aamode="noise", spp=128)
    profile = truth.image[..., 0].mean(0)
    assert (abs(profile - 0.5) < 0.45).sum() >= 4  # the border is as wide as the filter
    assert np.ptp(found.layers["samples.Y"]) > 32
    # 48 rows of a hundred rays of deviation 0.6: known to 0.01
    assert abs(found.image[..., 0].mean(0) - profile).max() < 0.04


@pytest.mark.parametrize(
    ("color", "luminance"), [((1, 0, 0), 0.2127), ((0, 1, 0), 0.7152), ((0, 0, 1), 0.0722)]
)
def test_a_share_of_the_mean_luminance_sees_colours_as_srgb_does(color, luminance):
    """To which pilot rays are good by 1 % in this picture."""
    result = mrt.render(camera(64, 48), integrator=noise(color), target="20%", seed=1)
    assert result.error.target == pytest.approx(0.2 * luminance, rel=0.04)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (3, 1)])
@pytest.mark.parametrize("goal", [{"aamode": "noise", "spp": 40}, {"target": 0.1}, {"target": "30%"}])
@pytest.mark.filterwarnings("ignore::mrt_mitsuba.MrtWarning")
def test_a_film_may_be_smaller_than_a_chessboard(size, rfilter, goal):
    """A field without pixels shares nothing, and nothing is divided by its noise."""
    for seed in range(4):
        result = mrt.render(camera(*size, rfilter), integrator=noise(), seed=seed, **goal)
        assert np.isfinite(result.image).all()
        assert result.rounds[-1].spp >= 8


@pytest.mark.parametrize("options", [{"aamode": "noise"}, {"denoise": True}], ids=str)
def test_a_header_says_that_an_error_has_no_upper_end(options):
    with pytest.warns(mrt.MrtWarning, match="a few rays dominate the error"):
        result = mrt.render(camera(24, 16), integrator=noise(rare=0.0005), spp=64, seed=1, **options)
    assert result.error.high == math.inf
    assert result.header()["mrt:error"]["high"] is None


# ----------------------------------- Blur, NaN -----------------------------------


def test_a_filter_widens_the_interval_by_the_correlation_of_pixels():
    """Of the same number of pixels, a Gaussian film has fewer that are independent."""
    widths = []
    for rfilter in ("box", "gaussian"):
        error = mrt.render(camera(64, 48, rfilter), integrator=noise(), aamode="noise", spp=32).error
        widths.append(math.log(error.rmse / error.low))
    correlation = Film(camera(8, 8, "gaussian").sensors()[0]).correlation
    assert correlation > 1.5
    assert widths[1] / widths[0] == pytest.approx(math.sqrt(correlation), rel=0.15)


def test_stated_errors_are_those_of_the_blurred_picture():
    """A floor and a ball out of focus: a blur averages noise, and leaves what is sharp as it is."""
    scene = load_kind("calm", 48)
    options = {"aamode": "noise", "spp": 32, "focaldist": 3.0, "focalrange": 1.0}
    seen: list[Any] = []
    results = [mrt.render(scene, seed=seed, on_round=seen.append, **options) for seed in range(16)]
    assert np.array_equal(seen[-1].image, results[-1].image)
    true = np.var([result.image for result in results], axis=0, ddof=1).mean(-1)
    stated = np.mean([result.layers["error.Y"] ** 2 for result in results], axis=0)
    sharp = np.mean([mrt.render(scene, seed=0, **options | {"focaldist": 0}).layers["error.Y"] ** 2])
    assert stated.mean() < 0.8 * sharp  # the blur matters
    assert stated.mean() == pytest.approx(true.mean(), rel=0.25)
    for tenth in np.array_split(np.argsort(stated, axis=None), 10):
        ratio = (true.ravel()[tenth].mean() + 1e-9) / (stated.ravel()[tenth].mean() + 1e-9)  # rounding
        assert 1 / 3 < math.sqrt(ratio) < 3
    variance = np.mean([[result.layers[f"variance.{c}"] for c in "RGB"] for result in results])
    assert variance == pytest.approx(stated.mean(), rel=1e-3)


def corner(value: float) -> Any:
    """An integrator whose rays are NaN or infinite in one corner."""

    class Corner(type(noise())):  # type: ignore[misc]
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            color = mi.Spectrum(0.2 + 0.6 * _low_digits(sampler.next_1d()))
            corner = (ray.d.x > 0.2) & (ray.d.y > 0.15)
            return dr.select(corner, value, color), mi.Bool(True), []

    return Corner(mi.Properties())


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize("more", [{}, {"metric": "display"}, {"metric": "relative", "target": 0.01}], ids=str)
def test_invalid_rays_leave_target_and_interval_as_they_are(value, rfilter, more):
    """They are named in a warning."""
    scene = camera(32, 24, rfilter)
    with pytest.warns(mrt.MrtWarning, match=f"radiance of {value} was met in [0-9]+ pixels"):
        result = mrt.render(scene, integrator=corner(value), **{"target": 0.005, **more})
    error = result.error
    assert error.low < error.rmse <= error.target < 2 * error.high < math.inf
    stated = math.sqrt(np.mean(result.layers["error.Y"] ** 2))
    assert stated == pytest.approx(error.rmse, rel=0.3)  # where it is invalid, it is none, or borrowed
    assert not np.isfinite(result.image).all()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_denoiser_leaves_invalid_pixels_as_they_are(value):
    with pytest.warns(mrt.MrtWarning, match=f"radiance of {value}"):
        result = mrt.render(camera(32, 24), integrator=corner(value), denoise=True, spp=64)
    noisy = np.stack([result.layers[f"noisy.{letter}"] for letter in "RGB"], -1)
    assert result.layers["denoised.Y"].max() > 0.5
    assert np.array_equal(np.isnan(result.image), np.isnan(noisy))
