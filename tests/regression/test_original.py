"""Against the original program's own pictures, where those are at hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.filters import luma_edges, sobel_edges
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render

# Mean absolute difference, and share of pixels off by more than 1/255, without detector or blur. Ours are off
# at the borders of shadows, where the original's rays start a fixed distance off the surface and speckle
OURS = {0: (1e-5, 0.001), 1: (6e-5, 0.005), 2: (6e-5, 0.005), 3: (2e-5, 0.005), 4: (3e-4, 0.025)}
# Of the float64 reference: what the original's float32 and its speckles leave, nearly all near terminators
FLOAT64 = {0: (1e-6, 0.0002), 1: (4e-5, 0.003), 2: (4e-5, 0.003), 3: (1e-5, 0.001), 4: (3e-4, 0.01)}
DETECTORS = {"luma": luma_edges, "sobel": sobel_edges}
MODES = "0_luma_aa4 1_sobel_aa4 2_luma_aa4 2_sobel_aa4_dof 3_none_aa1 3_sobel_aa4 3_default 4_default"
NAMES = [f"s{mode}" for mode in (*(f"{number}_none_aa4" for number in OURS), *MODES.split())]

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", NAMES)
def test_render_gives_the_same_picture(name: str, original_data: Path) -> None:
    original = read_exr(original_data / "renders" / f"{name}.exr")
    options = json.loads(original.header["comments"])  # what the original was called with
    number = options.pop("scene")
    ours = mrt.render(number, fresnel="dielectric", **options)
    difference = np.abs(ours.image - original.image)
    mean, share = OURS[number]
    # a detector decides by the last bit of a grey value, and the blur spreads a wrong pixel over its window
    slack = 1 if options["aamode"] == "none" else 3
    assert difference.mean() <= slack * mean
    assert (difference.max(axis=-1) > 1 / 255).mean() <= slack * share


@pytest.mark.parametrize("number", [0, 1, 2, 3, pytest.param(4, marks=pytest.mark.slow), 9])
def test_the_reference_gives_the_same_picture(number: int, original_data: Path) -> None:
    """One pixel in 4; of scene 9, whose cone is broken in the original, the floor far from it and its
    shadow."""
    image = read_exr(original_data / "renders" / f"s{number}_none_aa1.exr").image[1::2, ::2]
    height, width, _ = image.shape
    corner = (-0.25, -0.25)  # from the middle of four pixels to the lower left one
    scene = report_scene(number)
    result = reference_render(scene, width=width, height=height, displacement=corner)
    error = np.abs(result.image - image)
    if number == 9:
        assert np.median(error[-20:]) <= 1e-6  # mostly floor
        return
    mean, share = FLOAT64[number]
    assert error.mean() <= mean and (error.max(axis=-1) > 1 / 255).mean() <= share
    # no exp, no mirror, no clamp wrong anywhere: nine pixels in ten agree to a few roundings of float32
    assert np.quantile(error.max(axis=-1), 0.9) <= 2e-5


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("scene", [0, 1, 2, 3, 4, 9])
def test_the_same_pixels_are_refined(scene: int, detector: str, original_data: Path) -> None:
    """A refined pixel is that of the fully supersampled picture, any other that of the plain one."""
    modes = ("none_aa1", "none_aa4", f"{detector}_aa4")
    plain, full, adaptive = (read_exr(original_data / "renders" / f"s{scene}_{m}.exr").image for m in modes)
    mask = DETECTORS[detector](plain).mask
    np.testing.assert_array_equal(adaptive, np.where(mask[..., None], full, plain))
    telling = (plain != full).any(axis=-1)
    assert telling.mean() > 0.99 and mask[telling].any() and not mask[telling].all()
