"""What a film's filter makes of noise, against pictures that Mitsuba makes of random numbers."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import sensor
from numpy.testing import assert_allclose

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.canvas import Canvas
from mrt_mitsuba.rendering.film import Film

pytestmark = pytest.mark.usefixtures("variant")

SIDE = 256
SPP = 16


def white_noise(film_sensor: mi.Sensor) -> np.ndarray:
    """A picture [H, W] of independent random numbers, one a ray, of mean 0 and variance 1."""

    class Uniform(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            value = 12**0.5 * (sampler.next_1d() - 0.5)
            return mi.Spectrum(value), mi.Bool(True), []

    scene = mi.load_dict({"type": "scene", "sensor": film_sensor})
    return np.array(mi.render(scene, integrator=Uniform(mi.Properties()), spp=SPP))[..., 0]


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"])
def test_noise_under_a_filter_has_its_variance_and_correlation(rfilter):
    look = mi.load_dict(sensor([0, 0, 1], [0, 0, 0], (SIDE, SIDE), rfilter=rfilter))
    film = Film(look)
    inner = white_noise(look)[8:-8, 8:-8]
    # A variance of 57,600 values, each correlated with at most ten others, is known to 2 %
    assert inner.var() * SPP == pytest.approx(film.filter_variance_ratio, rel=0.06)
    power = np.abs(np.fft.fft2(inner / inner.std())) ** 2 / inner.size
    # Exponential at each frequency: the mean square is twice the square of the mean, the spectrum
    assert np.mean(power**2) / 2 == pytest.approx(film.correlation, rel=0.08)
    alike = np.ones((1, *film.shape))
    assert_allclose(film.filtered_variance(alike), alike, rtol=1e-6)


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian", "mitchell"])
def test_filtered_means_are_as_wide_as_the_filter(rfilter):
    """A bright pixel keeps its sum, and its second moment with that of a pixel is the filter's."""
    mrt.register()
    film = Film(mi.load_dict(sensor([0, 0, 1], [0, 0, 0], (9, 9), rfilter=rfilter)))
    means = np.zeros((9, 9, 1), np.float32)
    means[4, 4] = 1
    along = film.filtered_means(means)[..., 0].sum(0)
    assert along.sum() == pytest.approx(1)
    position = np.linspace(-4, 4, 10_001)
    values = np.array(film.rfilter.eval(mi.Float(position.tolist()))) if film.reach else abs(position) < 0.5
    expected = (values * position**2).sum() / values.sum()
    assert (along * np.arange(-4, 5) ** 2).sum() + 1 / 12 == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_moments_of_a_canvas(variant, rfilter):
    """Sums of colours and squares, and the mean colour of the brightest ray, of two puts."""
    film = Film(mi.load_dict(sensor([0, 0, 1], [0, 0, 0], (3, 2), rfilter=rfilter)))
    rng = np.random.default_rng(0)
    canvas = Canvas(film, np.full((1, 6), 6), 3, moments=True)
    drawn = rng.random((2, 3, 18), np.float32)  # [puts, channels, rays], three rays in each pixel
    pixel = np.repeat(np.arange(6), 3)
    place = np.stack([pixel % 3, pixel // 3]) + rng.random((2, 18))
    for values in drawn:
        if variant.startswith("scalar"):
            canvas.put(place, list(values), np.full(6, 3))
        else:
            canvas.put(mi.Point2f(place), [mi.Float(channel) for channel in values], np.full(6, 3))
    colors = np.moveaxis(drawn.reshape(2, 3, 6, 3), 0, 2).reshape(3, 6, 6)  # [channels, pixels, rays]
    assert_allclose(canvas.total.reshape(3, 6), colors.sum(-1), rtol=1e-6)
    assert_allclose(canvas.square.reshape(3, 6), (colors**2).sum(-1), rtol=1e-6)
    assert_allclose(canvas.peak.ravel(), colors.mean(0).max(-1), rtol=1e-6)
    if rfilter == "box":
        assert_allclose((canvas.sums / canvas.weights).reshape(3, 6), colors.mean(-1), rtol=1e-6)


SETTINGS = Cases()
SETTINGS({"spp": 16})
SETTINGS({"spp": 4, "aamode": "sobel", "aa": 2, "focaldist": 1.0})
SETTINGS({"spp": 2, "aamode": "luma", "aa": 2, "lattice": "report"})
SETTINGS({"spp": 32, "aamode": "noise"})
SETTINGS({"target": 0.05, "maxspp": 64})
SETTINGS({"target": "5%", "maxspp": 64})


@pytest.mark.filterwarnings("ignore::mrt_mitsuba.errors.MrtWarning")
@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e38])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize("options", SETTINGS)
def test_values_that_are_not_finite_spoil_no_error(options, rfilter, bad):
    """A ray in fifty; nothing but warnings of our own is said, and errors and targets are numbers."""

    class Bad(mi.SamplingIntegrator):
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            value = sampler.next_1d()
            return mi.Spectrum(dr.select(value < 0.02, bad, value)), mi.Bool(True), []

    look = sensor([0, 0, 1], [0, 0, 0], (12, 9), rfilter=rfilter)
    scene = {"type": "scene", "sensor": look, "light": {"type": "constant"}}
    result = mrt.render(mi.load_dict(scene), integrator=Bad(mi.Properties()), **options)
    if error := result.error:
        assert np.isfinite([error.rmse, error.low, error.target or 0]).all()
        assert error.high >= error.rmse


def test_light_beyond_float32_is_infinite_where_it_is_seen():
    """In pixels around the picture, too, whose rays weigh nothing there: infinity times 0 is no number."""
    look = sensor([0, 0, 1], [0, 0, 0], (12, 9), rfilter="gaussian")
    look["film"]["sample_border"] = True
    light = {"type": "constant", "radiance": {"type": "rgb", "value": 3e38}}
    result = mrt.render({"type": "scene", "sensor": look, "light": light}, integrator="path", spp=4)
    assert np.isposinf(result.image).all()
    assert result.rays["primary"] == 4 * (12 + 4) * (9 + 4)  # those that the filter reaches from
