"""Edge detectors and depth of field: known values, corners, and known geometry.

Whole pictures of the original program, with either detector and with its blur, are in ``regression``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from numpy.testing import assert_allclose, assert_array_equal
from scipy import ndimage
from scipy.special import comb

from mrt_mitsuba import UsageError
from mrt_mitsuba.filters import (
    blur_amount,
    gaussian_dof,
    geometry_edges,
    luma_edges,
    sobel_edges,
)

DETECTORS = [luma_edges, sobel_edges]


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
def test_detectors_give_the_report_s_values(variant):
    """Of random colours, by SciPy's filters in float64; only the border is never an edge."""
    image = np.random.default_rng(1).random((20, 30, 3)).astype(np.float32)
    inside = np.s_[1:-1, 1:-1]
    luma = np.sqrt(np.float64(image) @ [0.299, 0.587, 0.114])
    largest = ndimage.maximum_filter(luma, 3)
    contrast = largest - ndimage.minimum_filter(luma, 3) + 0.05
    found = luma_edges(image)
    assert_allclose(np.array(found.value)[inside], contrast[inside], atol=1e-6)  # roundings of luma up to 1
    edge = contrast >= np.maximum(0.0312, 0.125 * largest)
    assert_array_equal(np.array(found.mask)[inside], edge[inside])
    grey = np.trunc(255 * (np.float64(image) @ [0.07, 0.72, 0.21]))
    gradient = sum(abs(ndimage.sobel(grey, axis)) for axis in (0, 1))
    edges = sobel_edges(image)
    assert_array_equal(np.array(edges.value)[inside], gradient[inside])  # whole numbers
    for mask, value in ((found.mask, found.value), (edges.mask, edges.value)):
        for border in (np.array(mask), np.array(value)):
            border[inside] = 0
            assert not border.any()


def test_noise_of_the_channels_adds_up_as_if_it_were_one():
    step = np.zeros((5, 6, 3))
    step[:, 3:] = 40 / 255
    deviations = np.array([1.0, 2.0, 3.0]) / 255
    edges = sobel_edges(step, variance=np.broadcast_to(deviations**2, (5, 6, 3)))
    noise = np.sqrt(24) * (0.07 * 1 + 0.72 * 2 + 0.21 * 3)  # 24: squares of both kernels' weights
    assert edges.value[2, 3] == int(4 * 40 - 3 * noise)

    luma = luma_edges(step + 0.25, variance=np.broadcast_to(deviations**2, (5, 6, 3)))
    bright = 0.25 + 40 / 255
    dark = 0.25
    deviation = np.dot([0.299, 0.587, 0.114], deviations)
    nine = [1 / (4 * bright)] * 6 + [1 / (4 * dark)] * 3  # a right column of 3 dark pixels
    noise = deviation * np.sqrt(np.mean(nine))
    expected = np.sqrt(bright) - np.sqrt(dark) - 2 * 3 * noise + 0.05
    assert luma.value[2, 3] == pytest.approx(expected, abs=1e-6)  # float32 roundings, as above


@pytest.mark.parametrize("detector", DETECTORS)
def test_noise_of_unknown_size_leaves_its_neighbourhood_alone(detector):
    image = np.random.default_rng(0).random((8, 9, 3))
    variance = np.zeros_like(image)
    variance[4, 4] = np.nan
    edges = detector(image, variance=variance)
    expected = np.pad(np.ones((6, 7), bool), 1)
    expected[3:6, 3:6] = False
    expected[4, 4] = detector is sobel_edges  # whose kernels do not read their centre
    assert_array_equal(edges.mask, expected)
    assert np.isfinite(edges.value).all()


def test_geometry_leaves_a_floor_alone_up_to_its_horizon():
    """However steeply it is seen; the camera looks along +z, one unit above it."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 40), np.linspace(0.45, -0.45, 30))
    slope = y / np.sqrt(x**2 + y**2 + 1)
    depth = np.where(slope < 0, 1 / np.maximum(-slope, 1e-9), np.inf)
    edges = geometry_edges(np.tile([0.0, 1.0, 0.0], (30, 40, 1)), depth)
    assert edges.mask[14:16, 1:-1].all()  # the rows on both sides of the horizon, but for the border
    assert edges.mask.sum() == 2 * 38
    assert not edges.value[:, [0, -1]].any()


def face(columns: slice = slice(0, 0), normal: Any = (0, 0, 1), depth: float = 3.0) -> tuple[np.ndarray, ...]:
    """Normals and distances of a wall that is seen from in front, other ones in some columns."""
    normals = np.tile([0.0, 0.0, 1.0], (5, 8, 1))
    depths = np.full((5, 8), 3.0)
    normals[:, columns] = normal
    depths[:, columns] = depth
    return normals, depths


def tilted(degrees: float) -> tuple[float, float, float]:
    return np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))


geometry = Cases()
geometry({"normal": tilted(19.9)}, {}, False)
geometry({"normal": tilted(20.1)}, {}, True)
geometry({"normal": tilted(20.1)}, {"crease_angle": 30}, False)
# inverse distances 1/3 and (1 − step)/3, relative to the largest
geometry({"depth": 3 / (1 - 0.019)}, {}, False)
geometry({"depth": 3 / (1 - 0.021)}, {}, True)
geometry({"depth": 3 / (1 - 0.021)}, {"depth_step": 0.03}, False)
for miss in (np.inf, 0.0, -1.0):
    geometry({"depth": miss, "normal": np.nan}, {}, True)


@pytest.mark.parametrize(("change", "options", "is_edge"), geometry)
def test_geometry_decides_by_angle_step_and_miss(change, options, is_edge):
    edges = geometry_edges(*face(slice(4, None), **change), **options)
    assert edges.mask[2].tolist() == [False] * 3 + [is_edge] * 2 + [False] * 3
    assert np.isfinite(edges.value).all()


def test_geometry_sees_a_step_in_every_direction():
    normal, depth = face()
    depth[2, 4] = 2.9
    around = np.pad(np.ones((3, 3)), [(1, 1), (3, 2)])
    assert_array_equal(geometry_edges(normal, depth).mask, around)


def scene(size: tuple[int, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours, and distances in sixteenths from 0 to 14 in patches and speckles, with misses of all kinds."""
    rng = np.random.default_rng(seed)
    patches = rng.integers(0, 16 * 14, (3, 4)) / 16
    rows = np.arange(size[0]) * 3 // size[0]
    columns = np.arange(size[1]) * 4 // size[1]
    depth = patches[rows][:, columns]
    speckles = rng.random(size) < 0.2
    depth[speckles] = rng.choice([1 / 16, 1, 2.5, 6, 12, 0, -1, np.inf], speckles.sum())
    return rng.uniform(-1, 1, (*size, 3)).astype(np.float32), depth


@pytest.mark.parametrize(
    ("reach", "expected"), [({}, [0, 1, 8, 8, 8]), ({"focal_range": np.inf}, [0, 0, 8, 8, 8])]
)
def test_amount_of_bad_depths_and_misses(reach, expected):
    """A depth that is no number is sharp, a miss blurred whatever the range, which is two unless given."""
    depth = np.array([[np.nan, 5.0, np.inf, 0.0, -3.0]])
    amount = blur_amount(depth, focal_distance=2.0, **reach)
    assert amount.dtype == np.float32
    assert amount.tolist() == [expected]
    assert not blur_amount(depth, focal_distance=None).any()


@pytest.mark.parametrize("k", [1, 3, 8])
def test_a_point_is_spread_by_pascal_s_triangle(k):
    """Over the pixels in whose windows [-k, k) it lies, rows counted from the bottom; a fraction is cut."""
    image = np.zeros((41, 41, 3), np.float32)
    image[20, 20] = 1
    depth = np.full((41, 41), 1 + k + 0.75 * (k < 8))
    found = gaussian_dof(image, depth, focal_distance=1.0, focal_range=0)[..., 0]
    pascal = comb(2 * k - 1, np.arange(2 * k))[::-1] / 2 ** (2 * k - 1)
    expected = np.zeros((41, 41))
    expected[20 - k : 20 + k, 21 - k : 21 + k] = np.outer(pascal, pascal)
    assert_allclose(found, expected, atol=2e-7)


def test_weights_begin_anew_at_the_lower_and_the_left_border():
    """Of the line 1 5 10 10 5 1, what is inside takes the first entries."""
    image = np.zeros((20, 30, 3), np.float32)
    image[-1] = 1
    for picture in (image, np.rot90(image, -1)):  # the row at the bottom; the column on the left
        depth = np.full(picture.shape[:2], 4.0)
        found = gaussian_dof(picture, depth, focal_distance=1.0, focal_range=0)
        assert_allclose(found[picture > 0], 1 / 16, atol=1e-7)


@pytest.mark.parametrize("amount", [0.5, 2, 8])
def test_a_point_becomes_a_disc_as_wide_as_pascal_s_triangle(amount):
    image = np.zeros((41, 41, 3), np.float32)
    image[20, 20] = 1
    depth = np.full((41, 41), 1 + amount)
    found = gaussian_dof(image, depth, focal_distance=1.0, focal_range=0, mode="corrected")[..., 0]
    assert found.sum() == pytest.approx(1, abs=1e-5)
    variance = (found * (np.arange(41) - 20) ** 2).sum()
    expected = (2 * amount - 1) / 4 if amount >= 1 else amount**2 / 4
    assert variance == pytest.approx(expected, rel=0.1)  # a small disc on a grid of pixels


def test_a_blurred_foreground_covers_and_a_background_does_not():
    """What is sharp takes nothing from behind it; in the middle of a foreground nothing shows through."""
    image = np.zeros((41, 41, 3), np.float32)
    image[:, 20:] = 1
    for first, second in ((3.0, 9.0), (9.0, 3.0), (3.0, 3.5)):  # the left half, the right one
        depth = np.where(np.arange(41) < 20, first, second) * np.ones((41, 1))
        found = gaussian_dof(image, depth, focal_distance=first, focal_range=0, mode="corrected")[20, :, 0]
        assert_allclose(found[30:35], 1, atol=1e-6)
        assert (found[15:20] > 0.01).any() == (second < first)
        assert not found[:10].any()


def test_what_is_in_focus_neither_blurs_nor_gives():
    image, depth = scene((30, 40), 2)
    depth[:, 20:] = 3
    blurred = gaussian_dof(image, depth, focal_distance=3.0, focal_range=0.5)
    assert_array_equal(blurred[:, 20:], image[:, 20:])
    brighter = np.where(np.arange(40)[:, None] < 20, image, image + 9)
    found = gaussian_dof(brighter, depth, focal_distance=3.0, focal_range=0.5)
    assert_array_equal(found[:, :20], blurred[:, :20])


@pytest.mark.parametrize("mode", ["report", "corrected"])
def test_a_bad_colour_gives_nothing(mode):
    image = np.full((25, 30, 3), 0.75)
    image[12, 15, 2] = image[3, 0, 0] = np.nan
    good = np.isfinite(image).all(axis=-1)
    for amount in (np.full((25, 30), 8.0), np.arange(750.0).reshape(25, 30) % 9):
        found = gaussian_dof(image, 1 + amount, focal_distance=1.0, focal_range=0, mode=mode)
        # the weights of what is left add up to one, but for the rounding of their sums of 61 terms at most
        assert_allclose(found[good], 0.75, rtol=61 * 6e-8)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb"], indirect=True)
def test_lists_and_tensors_are_pictures(variant):
    image, depth = scene((40, 50), 1)
    for given in (image.tolist(), mi.TensorXf(image)):
        assert_array_equal(sobel_edges(given).mask, sobel_edges(image).mask)
        assert_array_equal(
            gaussian_dof(given, depth, focal_distance=3.0), gaussian_dof(image, depth, focal_distance=3.0)
        )


IMAGE = np.zeros((4, 5, 3))
DEPTH = np.zeros((4, 5))
SHAPES = [(), (4, 5), (4, 5, 4), (3, 4, 5, 3), (0, 5, 3)]
wrong = Cases()
for find in DETECTORS:
    for shape in SHAPES:
        wrong(partial(find, np.zeros(shape)), "image has shape")
wrong(partial(luma_edges, IMAGE, variance=IMAGE[:, 1:]), r"variance has shape \(4, 4, 3\); expected \[4")
wrong(partial(geometry_edges, IMAGE, DEPTH, crease_angle=0), "crease_angle=0")
wrong(partial(geometry_edges, IMAGE, DEPTH, depth_step=np.nan), "depth_step=nan")
wrong(partial(sobel_edges, IMAGE, threshold=np.nan), "threshold is not a")
wrong(partial(gaussian_dof, IMAGE, DEPTH, focal_distance=1, focal_range=np.nan), "focal_range is not a")
wrong(partial(gaussian_dof, IMAGE, DEPTH.T, focal_distance=1), r"shape \(5, 4\); expected \[4, 5\]")


@pytest.mark.parametrize(("call", "message"), wrong)
def test_wrong_arguments_are_named(call, message):
    with pytest.raises(UsageError, match=message):
        call()
