"""``mrt.render`` against the original program's own pictures, where those are at hand: every mode, odd sizes
apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.output.files import read_exr

# Mean absolute difference and share of pixels off by more than 1/255 without detector or blur. What is left
# lies at shadow borders, where the original's rays start a fixed distance off the surface and speckle
LIMITS = {0: (1e-5, 0.001), 1: (6e-5, 0.005), 2: (6e-5, 0.005), 3: (2e-5, 0.005), 4: (3e-4, 0.025)}

NAMES = [
    f"s{number}_{mode}"
    for number in LIMITS
    for mode in ("none_aa1", "none_aa4", "luma_aa4", "sobel_aa4", "sobel_aa4_dof", "default")
    if mode != "default" or number in (3, 4)
]


pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", NAMES)
def test_picture_of_the_original(name: str, original_data: Path) -> None:
    original = read_exr(original_data / "renders" / f"{name}.exr")
    options = json.loads(original.header["comments"])  # what the original was called with
    number = options.pop("scene")
    ours = mrt.render(number, fresnel="dielectric", **options)
    difference = np.abs(ours.image - original.image)
    mean, share = LIMITS[number]
    # a detector decides by the last bit of a grey value, and the blur spreads a wrong pixel over its window
    slack = 1 if options["aamode"] == "none" else 3
    assert difference.mean() <= slack * mean
    assert (difference.max(axis=-1) > 1 / 255).mean() <= slack * share
