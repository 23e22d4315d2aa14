"""Edge detectors and depth of field against the float64 loops, at their corners, and on known geometry."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

import numpy as np
import pytest
from cases import Cases
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mrt_mitsuba import UsageError, runtime
from mrt_mitsuba.filters import (
    blur_amount,
    gaussian_dof,
    geometry_edges,
    luma_edges,
    sobel_edges,
)
from mrt_mitsuba.validation.oracles import filters as reference

needs_llvm = pytest.mark.skipif(runtime.obstacle("llvm_ad_rgb") is not None, reason="no LLVM to run kernels")
BACKENDS = [pytest.param("llvm", marks=needs_llvm), pytest.param("llvm.ad", marks=needs_llvm), "scalar"]
DETECTORS = [luma_edges, sobel_edges]

SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))


def tensor(backend: str, array: np.ndarray) -> Any:
    return importlib.import_module(f"drjit.{backend}").TensorXf(np.ascontiguousarray(array, dtype=np.float32))


def picture(size: tuple[int, int], seed: int, low: float, high: float) -> np.ndarray:
    """Patches of one colour, so that flat neighbourhoods and edges both occur, with some speckles."""
    rng = np.random.default_rng(seed)
    patches = rng.uniform(low, high, (3, 3, 3))
    rows = np.arange(size[0]) * 3 // size[0]
    columns = np.arange(size[1]) * 3 // size[1]
    image = patches[rows][:, columns]
    speckles = rng.random(size) < 0.1
    image[speckles] = rng.uniform(low, high, (speckles.sum(), 3))
    return image.astype(np.float32)


# Float32 errors of the value, and of a distance to the threshold that may decide otherwise. Luma: √Y of three
# products, four roundings of 6e-8, L ≤ 2, twice. Sobel: whole numbers, once five roundings of 1020 agree.
TOLERANCES = {luma_edges: (1e-6, 2e-6), sobel_edges: (0, 4e-4)}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("detector", DETECTORS)
@given(data=st.data(), size=SIZES, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_detectors_equal_the_loops(backend, detector, data, size, seed):
    """Weights, thresholds, truncation towards zero and the border that is never an edge, at any size."""
    spans = [(0, 0.02), (0, 0.3), (0, 1), (0, 4)]
    if detector is sobel_edges:
        spans += [(-0.02, 0.02), (-2, 4)]
    image = picture(size, seed, *data.draw(st.sampled_from(spans)))
    found = detector(tensor(backend, image))
    mask, value, margin = getattr(reference, detector.__name__)(image)
    assert found.mask.shape == found.value.shape == size
    atol, least = TOLERANCES[detector]
    decided = margin > least
    assert_allclose(np.array(found.value)[decided], value[decided], atol=atol, rtol=0)
    assert_array_equal(np.array(found.mask)[decided], mask[decided])


@pytest.mark.parametrize("detector", DETECTORS)
def test_the_comparison_with_the_loops_decides_nearly_every_pixel(detector):
    mask, _, margin = getattr(reference, detector.__name__)(picture((40, 50), 1, 0, 1))
    assert (margin > TOLERANCES[detector][1]).mean() > 0.95
    assert 0.1 < mask[1:-1, 1:-1].mean() < 0.9


def test_noise_of_the_channels_adds_up_as_if_it_were_one():
    step = np.zeros((5, 6, 3))
    step[:, 3:] = 40 / 255
    deviations = np.array([1.0, 2.0, 3.0]) / 255
    edges = sobel_edges(step, variance=np.broadcast_to(deviations**2, (5, 6, 3)), noise_sigmas=2)
    noise = np.sqrt(24) * (0.07 * 1 + 0.72 * 2 + 0.21 * 3)  # 24: squares of both kernels' weights
    assert edges.value[2, 3] == int(4 * 40 - 2 * noise)

    luma = luma_edges(step + 0.25, variance=np.broadcast_to(deviations**2, (5, 6, 3)), noise_sigmas=2)
    bright = 0.25 + 40 / 255
    dark = 0.25
    deviation = np.dot([0.299, 0.587, 0.114], deviations)
    nine = [1 / (4 * bright)] * 6 + [1 / (4 * dark)] * 3  # a right column of 3 dark pixels
    noise = deviation * np.sqrt(np.mean(nine))
    expected = np.sqrt(bright) - np.sqrt(dark) - 2 * 2 * noise + 0.05
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


SIXTEENTH = st.integers(0, 16 * 14).map(lambda n: n / 16)  # exact in float32, as are all amounts made of them
SMALL_SIZES = st.tuples(st.integers(1, 30), st.integers(1, 20))
SEEDS = st.integers(0, 2**32 - 1)
FOCUS = st.fixed_dictionaries({"focal_distance": SIXTEENTH.filter(bool), "focal_range": SIXTEENTH})
ANY_PICTURE = given(size=st.one_of(st.just((37, 41)), SMALL_SIZES), seed=SEEDS, focus=FOCUS)


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


@pytest.mark.parametrize("backend", BACKENDS)
@ANY_PICTURE
@settings(max_examples=25)
def test_report_equals_the_loops(backend, size, seed, focus):
    """Windows of every size, cut at borders; what is in focus gives nothing; below k = 1 nothing is taken."""
    image, depth = scene(size, seed)
    found = np.array(gaussian_dof(tensor(backend, image), tensor(backend, depth), **focus))
    amount = reference.blur_amount(depth, **focus)
    # sums of up to 16 weighted values along rows, 16 along columns, and a quotient: 33 roundings of 6e-8
    assert_allclose(found, reference.gaussian_dof(image, amount), atol=2e-6, rtol=0)
    assert_array_equal(found[amount < 1], image[amount < 1])


def test_a_bad_colour_gives_nothing():
    image = np.full((25, 30, 3), 0.75)
    image[12, 15, 2] = image[3, 0, 0] = np.nan
    good = np.isfinite(image).all(axis=-1)
    for amount in (np.full((25, 30), 8.0), np.arange(750.0).reshape(25, 30) % 9):
        found = gaussian_dof(image, 1 + amount, focal_distance=1.0, focal_range=0)
        # the weights of what is left add up to one, but for the rounding of their sums of 61 terms at most
        assert_allclose(found[good], 0.75, rtol=61 * 6e-8)


@pytest.mark.parametrize("backend", BACKENDS)
def test_arrays_give_arrays_of_their_kind(backend):
    module = importlib.import_module(f"drjit.{backend}")
    (image, depth) = scene((40, 50), 1)
    plain, listed, found = map(sobel_edges, (image, image.tolist(), tensor(backend, image)))
    assert isinstance(plain.mask, np.ndarray)
    assert plain.mask.dtype == bool
    assert isinstance(plain.value, np.ndarray)
    assert plain.value.dtype == np.float32
    assert type(found.mask) is module.TensorXb
    assert type(found.value) is module.TensorXf
    assert_array_equal(listed.mask, plain.mask)
    given_image = tensor(backend, image)
    options = {"focal_distance": 3.0, "focal_range": 0.5}
    blurred = gaussian_dof(image, depth, **options)
    first = gaussian_dof(given_image, depth, **options)
    second = gaussian_dof(given_image, depth, **options)
    assert isinstance(blurred, np.ndarray)
    assert blurred.dtype == np.float32
    assert type(first) is module.TensorXf
    assert first.shape == (40, 50, 3)
    assert_array_equal(np.array(first), np.array(second))
    # the same operations in the same order, but for fused multiply-adds: a rounding for each term
    assert_allclose(np.array(first), blurred, atol=61 * 6e-8)
    assert_array_equal(np.array(given_image), image)


IMAGE = np.zeros((4, 5, 3))
DEPTH = np.zeros((4, 5))
SHAPES = [(), (4, 5), (4, 5, 4), (3, 4, 5, 3), (0, 5, 3)]
wrong = Cases()
for find in DETECTORS:
    for shape in SHAPES:
        wrong(partial(find, np.zeros(shape)), "image has shape")
wrong(partial(luma_edges, IMAGE, variance=IMAGE[:, 1:]), r"variance has shape \(4, 4, 3\); expected \[4")
wrong(partial(sobel_edges, IMAGE, variance=IMAGE, noise_sigmas=-1), "noise_sigmas=-1")
wrong(partial(sobel_edges, IMAGE, threshold=np.nan), "threshold is not a number")
wrong(partial(geometry_edges, IMAGE, DEPTH[:2]), "depth has shape")
wrong(partial(geometry_edges, IMAGE, DEPTH, crease_angle=0), "crease_angle=0")
wrong(partial(gaussian_dof, IMAGE, DEPTH, focal_distance=np.nan), "focal_distance is not a number")
wrong(partial(gaussian_dof, IMAGE, DEPTH, focal_distance=1, focal_range=np.nan), "focal_range is not a")
wrong(partial(gaussian_dof, IMAGE, DEPTH.T, focal_distance=1), r"shape \(5, 4\); expected \[4, 5\]")


@pytest.mark.parametrize(("call", "message"), wrong)
def test_wrong_arguments_are_named(call, message):
    with pytest.raises(UsageError, match=message):
        call()
