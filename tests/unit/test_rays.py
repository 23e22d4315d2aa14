"""Places of samples: the division of lane numbers, and what rays add up to on a film."""

from __future__ import annotations

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.rays.canvas import Canvas
from mrt_mitsuba.rays.divisor import Divisor, constants
from mrt_mitsuba.rays.film import Film
from mrt_mitsuba.rendering.windows import dilated, window_means

LARGEST = 2**32 - 1


@pytest.mark.parametrize("number", [1, 2, 3, 7, 16, 641, 800, 16384, 65537, 2**31 - 1, 2**31, LARGEST])
def test_division_is_exact(number: int) -> None:
    """Next to multiples of the divisor, where a product with the rounded inverse could fall to the wrong
    side, and everywhere else."""
    mrt.register()
    import mitsuba as mi

    rng = np.random.default_rng(number)
    multiples = rng.integers(0, LARGEST // number + 1, 10_000) * number
    near = np.concatenate([multiples + k for k in (-1, 0, 1)] + [rng.integers(0, LARGEST, 10_000)])
    n = np.clip(np.append(near, [0, LARGEST]), 0, LARGEST).astype(np.uint32)
    quotient, remainder = constants(number=number)["number"].divide(mi.UInt32(n))
    assert np.array_equal(quotient, n // np.uint32(number))
    assert np.array_equal(remainder, n % np.uint32(number))


def test_division_in_scalar_variants() -> None:
    assert Divisor(7).divide(23) == (3, 2)


_X = np.linspace(0, 2, 20001)
CATMULL_ROM = np.where(_X < 1, 1.5 * _X**3 - 2.5 * _X**2 + 1, -0.5 * _X**3 + 2.5 * _X**2 - 4 * _X + 2)
FILTERS = {
    "tent": lambda x: np.maximum(1 - np.abs(x), 0),
    "catmullrom": lambda x: np.interp(np.abs(x), _X, CATMULL_ROM, right=0),
    "lanczos": lambda x: np.where(np.abs(x) < 3, np.sinc(x) * np.sinc(x / 3), 0),
}


@pytest.mark.parametrize("moments", [False, True])
@pytest.mark.parametrize("kind", FILTERS)
def test_film_adds_up_what_rays_give_to_pixels_in_reach(kind: str, moments: bool) -> None:
    """Against loops over rays and pixels in float64, in two pictures, some pixels without rays."""
    mrt.register()
    import mitsuba as mi

    width, height, rng = 7, 5, np.random.default_rng(len(kind))
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": kind}}
    sensor = mi.load_dict({"type": "perspective", "film": film})
    rays = rng.integers(0, 6, (2, width * height))
    pixels = np.flatnonzero(rays)
    pixel = np.repeat(np.arange(rays.size), rays.ravel())
    picture, row, column = pixel // (width * height), pixel // width % height, pixel % width
    place = (np.stack([column, row]) + rng.random((2, len(pixel)))).astype(np.float32)
    values = rng.normal(size=(4, len(pixel))).astype(np.float32)

    expected, squares = np.zeros((2, height, width, 5)), np.zeros((2, height, width, 7))
    for n, (x, y) in enumerate(place.T.astype(np.float64)):
        shares = [FILTERS[kind](np.arange(count) + 0.5 - at) for count, at in ((height, y), (width, x))]
        value = np.append(values[:, n], 1) / rays.ravel()[pixel[n]]
        expected[picture[n]] += np.multiply.outer(*shares)[..., None] * value
        colors = values[:3, n].astype(np.float64)
        found = squares[picture[n], row[n], column[n]]  # a view
        found += [*colors, *colors**2, 0]
        found[6] = max(found[6], colors.mean())  # the brightest, if it is not negative

    canvas = Canvas(Film.of(sensor), rays, 4, moments=moments)
    for part in np.array_split(pixels, 3):  # in three wavefronts
        own = np.isin(pixel, part)
        lanes = [mi.Float(value[own]) for value in values]
        canvas.put(mi.Point2f(place[:, own]), lanes, part, rays.ravel()[part])
    assert np.allclose(canvas.sums, expected, rtol=0, atol=1e-5)  # of values about 3
    assert canvas.moments.shape[-1] == 7 * moments
    assert np.allclose(canvas.moments, squares[..., : 7 * moments], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("reach", [1, 2, 8])
@pytest.mark.parametrize("shape", [(2, 17, 23), (5, 3)])
def test_windows_are_those_of_a_loop(shape, reach):
    """Means and dilations; windows are cut at the border, and may be larger than the picture."""
    values = np.random.default_rng(reach).exponential(size=shape) ** 8
    mask = values > 50
    rows, columns = (
        [slice(max(at - reach, 0), at + reach + 1) for at in range(count)] for count in shape[-2:]
    )
    windows = [[(..., row, column) for column in columns] for row in rows]
    means = np.array([[values[w].mean((-2, -1)) for w in line] for line in windows])
    near = np.array([[mask[w].any((-2, -1)) for w in line] for line in windows])
    assert np.allclose(window_means(values, reach), np.moveaxis(means, (0, 1), (-2, -1)), rtol=1e-13, atol=0)
    assert np.array_equal(dilated(mask, reach), np.moveaxis(near, (0, 1), (-2, -1)))
