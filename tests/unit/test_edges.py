"""The edge detectors against the float64 loops, at their corners, under noise, and on known geometry."""

from __future__ import annotations

import importlib
import subprocess
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrt_mitsuba import UsageError, runtime
from mrt_mitsuba.filters import edges_image, geometry_edges, luma_edges, sobel_edges
from mrt_mitsuba.validation.oracles import filters_reference as reference

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
    rows, columns = np.arange(size[0]) * 3 // size[0], np.arange(size[1]) * 3 // size[1]
    image = patches[rows][:, columns]
    speckles = rng.random(size) < 0.1
    image[speckles] = rng.uniform(low, high, (speckles.sum(), 3))
    return image.astype(np.float32)


def grey(values: Any) -> np.ndarray:
    """A picture whose report grey, before truncation, is the given number."""
    return np.repeat(np.asarray(values, dtype=np.float64)[..., None], 3, axis=-1) / 255


def bump(size: tuple[int, int] = (7, 9), *, base: float, value: float) -> np.ndarray:
    """One value everywhere but at row 3, column 4."""
    plane = np.full(size, base, dtype=np.float64)
    plane[3, 4] = value
    return plane


# ---- exact to the report ----


@pytest.mark.parametrize("backend", BACKENDS)
@given(size=SIZES, seed=st.integers(0, 2**32 - 1), high=st.sampled_from([0.3, 1.0, 4.0]))
@settings(max_examples=40, deadline=None)
def test_luma_equals_the_loops(backend: str, size: tuple[int, int], seed: int, high: float) -> None:
    image = picture(size, seed, 0, high)
    found, truth = luma_edges(tensor(backend, image)), reference.luma_edges(image)
    # √Y of three products in float32: four roundings of 6e-8 relative, L ≤ 2, twice in a difference
    np.testing.assert_allclose(np.array(found.value), truth.value, atol=1e-6, rtol=0)
    decided = truth.margin > 2e-6
    np.testing.assert_array_equal(np.array(found.mask)[decided], truth.mask[decided])


@pytest.mark.parametrize("backend", BACKENDS)
@given(size=SIZES, seed=st.integers(0, 2**32 - 1), span=st.sampled_from([(0, 0.02), (0, 1), (-2, 4)]))
@settings(max_examples=40, deadline=None)
def test_sobel_equals_the_loops(
    backend: str, size: tuple[int, int], seed: int, span: tuple[float, float]
) -> None:
    image = picture(size, seed, *span)
    found, truth = sobel_edges(tensor(backend, image)), reference.sobel_edges(image)
    # 255·Y in float32: five roundings of 6e-8 relative, at most 1020; from there on whole numbers, exactly
    decided = truth.margin > 4e-4
    np.testing.assert_array_equal(np.array(found.value)[decided], truth.value[decided])
    np.testing.assert_array_equal(np.array(found.mask)[decided], truth.mask[decided])


@pytest.mark.parametrize("detector", DETECTORS)
def test_the_comparison_with_the_loops_decides_nearly_every_pixel(detector: Any) -> None:
    image = picture((40, 50), 1, 0, 1)
    truth = getattr(reference, detector.__name__)(image)
    decided = truth.margin > (2e-6 if detector is luma_edges else 4e-4)
    assert decided.mean() > 0.95
    assert 0.1 < truth.mask[1:-1, 1:-1].mean() < 0.9
    found = detector(image)
    np.testing.assert_array_equal(found.mask[decided], truth.mask[decided])


def test_luma_leaves_alone_what_is_below_the_threshold_and_no_more() -> None:
    flat = np.zeros((3, 3, 3))
    # value and threshold are the same float32 number: "left alone if r < threshold", so this is an edge
    at = luma_edges(flat, contrast_offset=0.5, absolute_threshold=0.5)
    below = luma_edges(flat, contrast_offset=0.5, absolute_threshold=0.5001)
    assert at.mask[1, 1] and not below.mask[1, 1]


def test_luma_threshold_grows_with_the_brightest_neighbour() -> None:
    # flat: value 0.05 against 0.125 L, so the report refines every flat place darker than L = 0.4
    dark, bright = (luma_edges(np.full((3, 3, 3), luma**2)) for luma in (0.399, 0.401))
    assert dark.mask[1, 1] and not bright.mask[1, 1]
    assert bright.value[1, 1] == np.float32(0.05)


def test_luma_counts_a_negative_sum_as_black() -> None:
    image = np.full((5, 5, 3), 1.0)
    image[2, 2] = 0
    black = luma_edges(image)
    image[2, 2] = -3
    negative = luma_edges(image)
    np.testing.assert_array_equal(negative.value, black.value)
    np.testing.assert_array_equal(negative.mask, black.mask)


def test_sobel_needs_more_than_its_threshold() -> None:
    step = grey(np.tile([10.5, 10.5, 11.5, 11.5, 11.5], (5, 1)))
    edges = sobel_edges(step)
    assert edges.value[2].tolist() == [0, 4, 4, 0, 0]  # one grey level times 1 + 2 + 1
    assert edges.mask[2].tolist() == [False, True, True, False, False]
    assert not sobel_edges(step, threshold=4).mask.any()
    assert sobel_edges(step, threshold=3.99).mask[2].tolist() == [False, True, True, False, False]


@pytest.mark.parametrize(
    ("base", "value", "is_edge"),
    [
        (10.2, 10.9, False),  # the same whole number
        (10.9, 11.1, True),
        (0.6, -0.6, False),  # towards zero, both are 0; floor would give 0 and -1
        (-10.2, -10.9, False),
        (-10.9, -11.1, True),
        (-0.9, -1.1, True),
        (1000.2, 1000.9, False),  # beyond white
        (1000.9, 1001.1, True),
    ],
)
def test_sobel_truncates_like_c(base: float, value: float, is_edge: bool) -> None:
    edges = sobel_edges(grey(bump(base=base, value=value)))
    around = np.zeros((7, 9), dtype=bool)
    around[2:5, 3:6] = True
    around[3, 4] = False  # the kernels do not read their centre
    np.testing.assert_array_equal(edges.mask, around & is_edge)


def test_sobel_weighs_the_channels() -> None:
    for channel, weight in enumerate((0.07, 0.72, 0.21)):
        image = np.zeros((5, 6, 3))
        image[:, 3:, channel] = 0.999
        assert sobel_edges(image).value[2, 3] == 4 * int(255 * 0.999 * weight)


@pytest.mark.parametrize("detector", DETECTORS)
def test_the_border_is_never_refined(detector: Any) -> None:
    image = np.random.default_rng(0).random((8, 11, 3))
    edges = detector(image)
    assert edges.mask[1:-1, 1:-1].all()
    assert edges.mask.sum() == 6 * 9
    assert edges.value.sum() == edges.value[1:-1, 1:-1].sum()


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2), (2, 9), (3, 2)])
def test_pictures_that_are_all_border_have_no_edges(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((*size, 3))
    for edges in (luma_edges(image), sobel_edges(image), geometry_edges(image, image[..., 0])):
        assert edges.mask.shape == edges.value.shape == size
        assert not edges.mask.any() and not edges.value.any()


# ---- numbers that are none ----


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_pixel_marks_its_neighbourhood_and_nothing_else(
    backend: str, detector: Any, bad: float
) -> None:
    image = picture((9, 10), 3, 0, 1)
    clean = detector(tensor(backend, image))
    image[4, 6, 1] = bad
    marred = detector(tensor(backend, image))
    near = np.zeros((9, 10), dtype=bool)
    near[3:6, 5:8] = True
    mask, value = np.array(marred.mask), np.array(marred.value)
    assert mask[near].all() and np.isposinf(value[near]).all()
    np.testing.assert_array_equal(mask[~near], np.array(clean.mask)[~near])
    np.testing.assert_array_equal(value[~near], np.array(clean.value)[~near])


@pytest.mark.parametrize("detector", DETECTORS)
def test_a_picture_of_bad_pixels_is_all_edges(detector: Any) -> None:
    edges = detector(np.full((5, 6, 3), np.nan))
    assert edges.mask[1:-1, 1:-1].all() and not edges.mask[0].any()
    assert np.isposinf(edges.value[1:-1, 1:-1]).all() and not edges.value[0].any()


# ---- noise ----


def noisy(mean: np.ndarray, samples: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mean, and estimated variance of the mean, of exponential samples: skewed, like a path tracer's."""
    values = mean[None, ..., None] * rng.exponential(1, (samples, *mean.shape, 1)) * np.ones(3)
    return values.mean(0), values.var(0, ddof=1) / samples


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("level", [0.05, 0.3, 0.8])
@pytest.mark.parametrize("samples", [4, 16, 64])
def test_noise_is_no_edge(detector: Any, level: float, samples: int) -> None:
    image, variance = noisy(np.full((150, 200), level), samples, np.random.default_rng(samples))
    inner = (slice(1, -1), slice(1, -1))
    assert detector(image).mask[inner].mean() > 0.95  # what the detector makes of it untold
    # three deviations leave 0.5 % for normal noise (|Gx| + |Gy|: 4 × 0.135 %); 4 skewed samples reach 1.3 %
    assert detector(image, variance=variance).mask[inner].mean() < (0.02 if samples == 4 else 0.008)
    # the limit is not that far because the detector is blind: at one deviation it still fires
    assert detector(image, variance=variance, noise_sigmas=1).mask[inner].mean() > 0.2


@pytest.mark.parametrize("detector", DETECTORS)
def test_an_edge_above_the_noise_is_found(detector: Any) -> None:
    rng = np.random.default_rng(5)
    deviation = 0.01
    mean = np.full((100, 60), 0.3)
    mean[:, 30:] += 12 * deviation
    image = mean[..., None] + deviation * rng.standard_normal((100, 60, 1)) * np.ones(3)
    edges = detector(image, variance=np.full((100, 60, 3), deviation**2))
    assert edges.mask[1:-1, 29:31].mean() > 0.99
    assert edges.mask[1:-1, 1:28].mean() < 0.008


def test_noise_of_the_channels_adds_up_as_if_it_were_one() -> None:
    step = np.zeros((5, 6, 3))
    step[:, 3:] = 40 / 255
    deviations = np.array([1.0, 2.0, 3.0]) / 255
    edges = sobel_edges(step, variance=np.broadcast_to(deviations**2, (5, 6, 3)), noise_sigmas=2)
    noise = np.sqrt(24) * (0.07 * 1 + 0.72 * 2 + 0.21 * 3)  # 24: squares of both kernels' weights
    assert edges.value[2, 3] == int(4 * 40 - 2 * noise)

    luma = luma_edges(step + 0.25, variance=np.broadcast_to(deviations**2, (5, 6, 3)), noise_sigmas=2)
    bright, dark = 0.25 + 40 / 255, 0.25
    deviation = 0.299 * deviations[0] + 0.587 * deviations[1] + 0.114 * deviations[2]
    noise = deviation * np.sqrt((6 / (4 * bright) + 3 / (4 * dark)) / 9)  # a right column of 3 dark pixels
    expected = np.sqrt(bright) - np.sqrt(dark) - 2 * 2 * noise + 0.05
    assert luma.value[2, 3] == pytest.approx(expected, abs=1e-6)  # float32 roundings, as above


@pytest.mark.parametrize("detector", DETECTORS)
def test_noise_of_unknown_size_leaves_its_neighbourhood_alone(detector: Any) -> None:
    image = np.random.default_rng(0).random((8, 9, 3))
    variance = np.zeros_like(image)
    variance[4, 4] = np.nan
    edges = detector(image, variance=variance)
    near = np.zeros((8, 9), dtype=bool)
    near[3:6, 3:6] = True
    if detector is sobel_edges:
        near[4, 4] = False  # the kernels do not read their centre
    inner = np.zeros((8, 9), dtype=bool)
    inner[1:-1, 1:-1] = True
    np.testing.assert_array_equal(edges.mask, inner & ~near)
    assert np.isfinite(edges.value).all()


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("value", [0.0, 0.1, 0.9])
def test_without_noise_a_flat_picture_has_no_edges_once_variance_is_given(
    detector: Any, value: float
) -> None:
    image = np.full((6, 7, 3), value)
    assert not detector(image, variance=np.zeros_like(image)).mask.any()


# ---- geometry ----


def ball_over_a_floor(height: int = 90, width: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, distances and the thing hit (-1: nothing), for a camera at (0, 1, 0) looking along +z."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * 2 - 1, 1 - (np.arange(height) + 0.5) / height * 2)
    ray = np.stack([x * 0.6, y * 0.6 * height / width, np.ones_like(x)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    with np.errstate(divide="ignore"):
        floor = np.where(ray[..., 1] < 0, -1 / ray[..., 1], np.inf)
    to_ball = np.array([0.2, 0.1, 5.0])
    along = ray @ to_ball
    inside = along**2 - to_ball @ to_ball + 0.8**2
    ball = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
    depth = np.minimum(floor, ball)
    thing = np.where(np.isinf(depth), -1, np.where(ball < floor, 1, 0))
    on_ball = (ray * np.where(thing == 1, ball, 0)[..., None] - to_ball) / 0.8
    normal = np.where((thing == 1)[..., None], on_ball, [0.0, 1.0, 0.0])
    return normal, depth, thing


def test_geometry_finds_the_outlines_and_leaves_surfaces_alone() -> None:
    normal, depth, thing = ball_over_a_floor()
    edges = geometry_edges(normal, depth)
    changes = np.zeros(thing.shape, dtype=bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            changes[1:-1, 1:-1] |= np.roll(thing, (dy, dx), (0, 1))[1:-1, 1:-1] != thing[1:-1, 1:-1]
    assert changes.sum() > 300
    assert edges.mask[changes].all()
    floor = (thing == 0) & ~changes
    assert floor.sum() > 3000
    assert not edges.mask[floor].any()  # up to the horizon, where the distance grows without limit
    sky = (thing == -1) & ~changes
    assert not edges.mask[sky].any()
    facing = (thing == 1) & ~changes & (normal[..., 2] < -0.6)  # what is not seen edge-on
    assert facing.sum() > 300
    assert not edges.mask[facing].any()


def test_geometry_creases_by_their_angle() -> None:
    depth = np.full((5, 8), 3.0)
    for angle, is_edge in ((19.9, False), (20.1, True)):
        normal = np.zeros((5, 8, 3))
        normal[:, :, 2] = 1
        normal[:, 4:] = [np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))]
        edges = geometry_edges(normal, depth)
        assert edges.mask[2].tolist() == [False, False, False, is_edge, is_edge, False, False, False]
        # 1 − cos in float32 has an error of 1e-7 against 0.06
        expected = (1 - np.cos(np.radians(angle))) / (1 - np.cos(np.radians(20)))
        assert edges.value[2, 3] == pytest.approx(expected, rel=1e-5)
        wider = geometry_edges(normal, depth, crease_angle=30)
        assert not wider.mask.any()


def test_geometry_steps_by_their_height() -> None:
    normal = np.broadcast_to([0.0, 0.0, 1.0], (5, 8, 3))
    for step, is_edge in ((0.019, False), (0.021, True)):
        depth = np.full((5, 8), 1.0)
        depth[:, 4:] = 1 / (1 - step)  # inverse distances 1 and 1 − step, relative to the largest
        edges = geometry_edges(normal, depth)
        assert edges.mask[2].tolist() == [False, False, False, is_edge, is_edge, False, False, False]
        assert not geometry_edges(normal, depth, depth_step=0.03).mask.any()


def test_geometry_sees_a_step_in_every_direction() -> None:
    depth = bump(base=2.0, value=1.9)
    edges = geometry_edges(np.broadcast_to([0.0, 0.0, 1.0], (7, 9, 3)), depth)
    around = np.zeros((7, 9), dtype=bool)
    around[2:5, 3:6] = True
    np.testing.assert_array_equal(edges.mask, around)


@pytest.mark.parametrize("miss", [np.inf, 0.0, -1.0])
def test_geometry_ignores_normals_where_nothing_is_hit(miss: float) -> None:
    depth = np.full((7, 8), 2.0)
    depth[:, 4:] = miss
    normal = np.broadcast_to([0.0, 0.0, 1.0], (7, 8, 3)).copy()
    normal[:, 4:] = np.nan
    edges = geometry_edges(normal, depth)
    assert edges.mask[3].tolist() == [False, False, False, True, True, False, False, False]
    assert np.isfinite(edges.value).all()


@pytest.mark.parametrize("which", ["depth", "normal"])
def test_geometry_keeps_bad_numbers_local(which: str) -> None:
    normal, depth, _ = ball_over_a_floor(30, 40)
    clean = geometry_edges(normal, depth)
    {"depth": depth, "normal": normal}[which][20, 10] = np.nan
    marred = geometry_edges(normal, depth)
    near = np.zeros(depth.shape, dtype=bool)
    near[19:22, 9:12] = True
    assert marred.mask[near].all() and np.isposinf(marred.value[near]).all()
    np.testing.assert_array_equal(marred.value[~near], clean.value[~near])


# ---- kinds of arrays, errors ----


def test_numpy_gives_numpy_and_tensors_give_tensors() -> None:
    image = picture((6, 7), 0, 0, 1)
    plain = sobel_edges(image)
    assert isinstance(plain.mask, np.ndarray) and plain.mask.dtype == bool
    assert isinstance(plain.value, np.ndarray) and plain.value.dtype == np.float32
    given_as_list = sobel_edges(image.tolist())
    np.testing.assert_array_equal(given_as_list.mask, plain.mask)


@pytest.mark.parametrize("backend", BACKENDS)
def test_tensors_give_tensors_of_their_backend(backend: str) -> None:
    module = importlib.import_module(f"drjit.{backend}")
    image = picture((6, 7), 0, 0, 1)
    edges = luma_edges(tensor(backend, image))
    assert type(edges.mask) is module.TensorXb and edges.mask.shape == (6, 7)
    assert type(edges.value) is module.TensorXf and edges.value.shape == (6, 7)
    np.testing.assert_array_equal(np.array(edges.mask), luma_edges(image).mask)


@pytest.mark.parametrize(
    ("variant", "backend"), [("scalar_rgb", "scalar"), pytest.param("llvm_ad_rgb", "llvm", marks=needs_llvm)]
)
def test_numpy_is_computed_in_the_backend_of_the_variant(
    run_python: Callable[..., subprocess.CompletedProcess[str]], variant: str, backend: str
) -> None:
    code = """
import sys
import mrt_mitsuba
import mitsuba as mi
import numpy as np
from mrt_mitsuba import filters
from mrt_mitsuba.filters.grid import Grid

mi.set_variant(sys.argv[1])
image = np.random.default_rng(0).random((6, 7, 3)).astype(np.float32)
plain, tensor = filters.luma_edges(image), filters.luma_edges(mi.TensorXf(image))
assert isinstance(plain.mask, np.ndarray) and isinstance(tensor.value, mi.TensorXf)
assert (plain.mask == np.array(tensor.mask)).all() and plain.mask.any()
print(Grid(image).Float.__module__)
"""
    done = run_python(code, variant)
    assert done.stdout.split() == [f"drjit.{backend}"], done.stderr


def test_edges_image_is_white_on_black() -> None:
    edges = sobel_edges(picture((12, 13), 0, 0, 1))
    contours = edges_image(edges)
    assert contours.dtype == np.float32 and contours.shape == (12, 13)
    np.testing.assert_array_equal(contours, np.where(edges.mask, 1, 0))
    assert 0 < contours.sum() < contours.size


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize(
    "shape", [(), (4,), (4, 5), (4, 5, 4), (4, 5, 1), (3, 4, 5, 3), (0, 5, 3), (5, 0, 3)]
)
def test_a_wrong_shape_is_named(detector: Any, shape: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match="image has shape"):
        detector(np.zeros(shape))


def test_wrong_options_are_named() -> None:
    image, depth = np.zeros((4, 5, 3)), np.zeros((4, 5))
    with pytest.raises(UsageError, match=r"variance has shape \(4, 4, 3\); expected \[4, 5, 3\]"):
        luma_edges(image, variance=np.zeros((4, 4, 3)))
    with pytest.raises(UsageError, match="noise_sigmas=-1"):
        sobel_edges(image, variance=image, noise_sigmas=-1)
    with pytest.raises(UsageError, match="threshold is not a number"):
        sobel_edges(image, threshold=float("nan"))
    with pytest.raises(UsageError, match="relative_threshold is not a number"):
        luma_edges(image, relative_threshold=float("nan"))
    with pytest.raises(UsageError, match="depth has shape"):
        geometry_edges(image, depth[:2])
    with pytest.raises(UsageError, match="crease_angle=0"):
        geometry_edges(image, depth, crease_angle=0)
    with pytest.raises(UsageError, match="depth_step=0"):
        geometry_edges(image, depth, depth_step=0)
