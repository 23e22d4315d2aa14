"""The float64 reference against renders of the original ray tracer, where those are at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import ReferenceResult, reference_render

# Mean absolute difference, and share of pixels off by more than 1/255: what float64 leaves to the original's
# own float32, nearly all of it shadow acne near terminators
RESIDUE = {0: (1e-6, 0.0002), 1: (4e-5, 0.003), 2: (4e-5, 0.003), 3: (1e-5, 0.001), 4: (3e-4, 0.01)}


def difference(original_data: Path, number: int) -> tuple[ReferenceResult, np.ndarray]:
    """Return the reference in every other row and column, and how far the original is off there."""
    image = read_exr(original_data / "renders" / f"s{number}_none_aa1.exr").image[1::2, ::2]
    height, width, _ = image.shape
    quarter = (-0.25, -0.25)  # from the centre of four pixels to that of the lower left one
    scene = report_scene(number)
    result = reference_render(scene, width=width, height=height, displacement=quarter, start="original")
    return result, np.abs(result.image - image)


@pytest.mark.parametrize("number", [0, 1, 2, 3, pytest.param(4, marks=pytest.mark.slow)])
def test_the_original_drew_the_same(original_data: Path, number: int) -> None:
    _, error = difference(original_data, number)
    mean, share = RESIDUE[number]
    off = error.max(axis=-1) > 1 / 255
    assert error.mean() <= mean
    assert off.mean() <= share
    # no exp, no mirror, no clamp wrong anywhere: nine pixels in ten agree to a few roundings of float32
    assert np.quantile(error.max(axis=-1), 0.9) <= 2e-5


def test_the_original_drew_the_same_plane_below_its_cone(original_data: Path) -> None:
    """Its cone is broken; the floor far from it, cone and shadow is not."""
    result, error = difference(original_data, 9)
    rows = slice(-20, None)
    assert (result.object_id[rows] == 0).mean() > 0.5
    assert np.median(error[rows]) <= 1e-6
