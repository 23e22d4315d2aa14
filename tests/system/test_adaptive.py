"""Adaptive sampling at the edges of what can be asked: sizes, amounts, noise, progress."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import sensor
from numpy.testing import assert_allclose, assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.progress import Progress

pytestmark = pytest.mark.usefixtures("variant")


SIZES = [(1, 1), (2, 2), (1, 7), (7, 1), (3, 3), (5, 2), (37, 23)]


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("aamode", ["none", "luma", "sobel", "geometry"])
def test_any_size_renders(width, height, aamode):
    result = mrt.render(3, width=width, height=height, aa=2, aamode=aamode)
    assert result.image.shape == (height, width, 3)
    assert np.isfinite(result.image).all()
    if aamode != "none":
        refined = result.layers["samples.Y"] > 1
        assert result.rays["primary"] == width * height + refined.sum() * 3
        border = np.ones((height, width), bool)
        border[1:-1, 1:-1] = False
        assert not refined[border].any()


@pytest.mark.parametrize("aa", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("lattice", ["report", "centered"])
def test_any_amount_refines_to_full_supersampling(aa, lattice):
    options = {"width": 33, "height": 21, "aa": aa, "lattice": lattice, "focaldist": 0}
    full = mrt.render(1, **options, aamode="none")
    adaptive = mrt.render(1, **options, aamode="sobel")
    assert full.rays["primary"] == 33 * 21 * aa**2
    if aa == 1:
        assert_array_equal(adaptive.image, full.image)
        return
    refined = adaptive.layers["samples.Y"] > 1
    assert 0 < refined.sum() < refined.size
    # a centered lattice of even size does not hold the pixel's centre: its first sample is traced in addition
    further = aa**2 - 1 if lattice == "report" or aa % 2 else aa**2
    assert adaptive.rays["primary"] == 33 * 21 + refined.sum() * further
    assert set(adaptive.layers["samples.Y"][refined]) == {aa**2}
    one = mrt.render(1, **{**options, "aa": 1}, aamode="none").image
    assert_array_equal(adaptive.image[~refined], one[~refined])
    # the same up to 64 values summed in another order
    assert_allclose(adaptive.image[refined], full.image[refined], atol=1e-5)


class _Recorded(Progress):
    def __init__(self):
        self.stages = {}

    @contextmanager
    def stage(self, title, total, message=""):
        self.stages[title] = [total, 0, message]

        def advance(steps):
            self.stages[title][1] += steps

        yield advance


def test_every_pass_reports_its_progress_to_the_end():
    progress = _Recorded()
    result = mrt.render(3, width=40, height=30, aa=2, aamode="sobel", progress=progress)
    refined = int((result.layers["samples.Y"] > 1).sum())
    assert progress.stages == {
        "Rendering": [1200, 1200, ""],
        "Edges": [1200, 1200, ""],
        "Anti-aliasing": [refined, refined, "Computing Anti aliasing.."],
        "Depth of field": [1200, 1200, "Computing depth of field.."],
    }


@pytest.mark.parametrize(
    ("rfilter", "lattice"), [("box", "report"), ("box", "film"), ("gaussian", "film"), ("mitchell", "film")]
)
def test_the_noise_that_a_filter_averages_hides_fewer_edges(rfilter, lattice):
    """A bright half behind a veil that stops every other ray; its edge is as strong as the pixels' own
    variance lets it be, which other seeds show."""
    black = {"type": "diffuse", "reflectance": 0.0}
    veil = {"type": "mask", "opacity": 0.5, "nested": black}
    nodes: dict[str, Any] = {"type": "scene", "integrator": {"type": "path"}}
    nodes["sensor"] = sensor([0, 0, 0], [0, 0, -1], (48, 36), rfilter=rfilter)
    nodes["veil"] = {"type": "sphere", "radius": 1, "bsdf": veil}
    aside = mi.ScalarTransform4f().translate([10, 0, -9]).scale(10)
    nodes["half"] = {"type": "rectangle", "to_world": aside, "emitter": {"type": "area", "radiance": 1.0}}
    scene = mi.load_dict(nodes)
    options = {"aa": 1, "aamode": "sobel", "spp": 64, "lattice": lattice}
    results = [mrt.render(scene, seed=seed, layers=["edges"], **options) for seed in range(24)]
    variance = np.var([result.image for result in results], axis=0, ddof=1)
    expected = [mrt.filters.sobel_edges(result.image, variance=variance).value for result in results]
    found = [result.layers["edges.Y"] for result in results]
    assert np.mean(expected) > 1
    assert np.mean(found) == pytest.approx(np.mean(expected), rel=0.05)
