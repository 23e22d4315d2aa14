"""The detectors against renders of the original ray tracer, where those are at hand.

A render with a detector is the unrefined one, except where the detector fired: there it is the fully
supersampled one. So wherever the two differ, it shows which pixels were refined.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba.filters import luma_edges, sobel_edges
from mrt_mitsuba.output.files import read_exr

SIBLING = Path(__file__).resolve().parents[3] / "shared" / "reference"
RENDERS = Path(os.environ.get("MRT_REFERENCE", SIBLING)) / "renders"
DETECTORS = {"luma": luma_edges, "sobel": sobel_edges}

pytestmark = pytest.mark.skipif(
    not RENDERS.is_dir(), reason="no reference renders: set MRT_REFERENCE to their folder"
)


def render(name: str) -> np.ndarray:
    return read_exr(RENDERS / f"{name}.exr").image


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("scene", [0, 1, 2, 3, 4, 9])
def test_the_same_pixels_are_refined(scene: int, detector: str) -> None:
    plain, full = render(f"s{scene}_none_aa1"), render(f"s{scene}_none_aa4")
    adaptive = render(f"s{scene}_{detector}_aa4")
    mask = DETECTORS[detector](plain).mask
    # stored numbers, compared as such: no tolerance
    np.testing.assert_array_equal(adaptive, np.where(mask[..., None], full, plain))
    telling = (plain != full).any(axis=-1)
    assert telling.mean() > 0.99  # the rest is alike in both, and shows nothing
    assert mask[telling].any() and not mask[telling].all()
