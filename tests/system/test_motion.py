"""Motion blur: frames averaged, and rays of a film at times of their own."""

from __future__ import annotations

import dataclasses

import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering.film import SamplePattern
from mrt_mitsuba.scene.report import report_scene

SMALL = {"width": 96, "height": 72, "focaldist": 0}
WAY = (0.3, 0.1, 0.4)


pytestmark = pytest.mark.usefixtures("variant")


def _shifted(number: int, way: tuple[float, ...]):
    scene = report_scene(number)
    camera = scene.camera
    position, target = (tuple(np.add(point, way)) for point in (camera.position, camera.target))
    return dataclasses.replace(scene, camera=dataclasses.replace(camera, position=position, target=target))


def _times(aa: int = 4, repeats: int = 1, **shutter) -> np.ndarray:
    """Times of all rays, [64 pixels, rays of a pixel]."""
    places = SamplePattern("report", aa, 0, aa**2, repeats, **shutter)
    pixel, ray = np.divmod(np.arange(64 * places.size, dtype=np.uint32), places.size)
    return np.array(places.at(mi.UInt32(pixel), mi.UInt32(ray), 8, 8)[1]).reshape(64, -1)


@pytest.mark.parametrize("aa", [3, 4, 5, 8])
def test_place_and_time_do_not_go_together(aa):
    """A moving edge needs all places at all times; in the order of the lattice, rows correlate by 0.97."""
    times = _times(aa=aa, time_strata=aa**2, phase=0.5)[0]
    i, j = np.divmod(np.arange(aa**2), aa)
    for places in (i, j, i + j, i - j):
        assert abs(np.corrcoef(places, times)[0, 1]) < 0.35


@pytest.mark.parametrize(
    "options",
    [
        {"aa": 2, "aamode": "none"},
        {"aa": 2, "aamode": "sobel"},
        {"aa": 2, "aamode": "none", "focaldist": 2.0, "focalrange": 0.5},
        {"aa": 2, "aamode": "luma", "lattice": "centered"},
    ],
)
def test_frames_are_the_mean_of_renders_from_shifted_cameras(options):
    """One wavefront, frame after frame, with filters: always what the report does."""
    blurred = mrt.render(0, **{**SMALL, **options}, motion=WAY, motionsamples=3)
    frames = [mrt.render(_shifted(0, np.multiply(WAY, k / 3)), **{**SMALL, **options}) for k in range(3)]
    difference = np.abs(blurred.image - np.mean([frame.image for frame in frames], axis=0))
    # the same rays up to float32 rounding of their origins; an edge that flips in a pixel would be 5e-5
    assert np.median(difference) < 1e-6
    assert difference.mean() < 2e-5
    assert blurred.rays["primary"] == pytest.approx(sum(frame.rays["primary"] for frame in frames), rel=1e-3)


@pytest.mark.parametrize("lattice", ["report", "centered"])
def test_depth_is_that_of_the_moment_when_the_shutter_opens(lattice):
    options = {**SMALL, "aa": 2, "aamode": "none", "layers": ["depth"], "motionsamples": 4}
    depth, still = (
        mrt.render(0, **options, motion=way, lattice=lattice).layers["depth.Z"] for way in (WAY, None)
    )
    near = np.isfinite(depth) & np.isfinite(still) & (still < 5)
    assert np.median(np.abs(depth[near] - still[near])) <= 1e-4


@pytest.mark.parametrize("moments", [4, 10])
def test_a_film_has_as_many_moments_as_asked_for_in_each_place(moments):
    options = {"aa": 2, "aamode": "none", "lattice": "film", "focaldist": 0, "width": 8, "height": 6}
    rays = mrt.render(0, **options, motion=WAY, motionsamples=moments).rays["primary"] / 48
    assert rays == 4 * moments
