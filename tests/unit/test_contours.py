"""Contour pictures of the detectors."""

from __future__ import annotations

import numpy as np
import pytest

from mrt_mitsuba import UsageError, filters
from mrt_mitsuba.output.files import read_exr


def _step(width: int = 12, height: int = 8) -> np.ndarray:
    image = np.zeros((height, width, 3), np.float32)
    image[:, width // 2 :] = 1
    return image


def test_contours_stand_side_by_side():
    image = _step()
    luma, sobel = filters.luma_edges(image, contrast_offset=0), filters.sobel_edges(image)
    sheet = filters.contours(luma, sobel)
    assert sheet.shape == (8, 2 * 12 + 4, 3) and sheet.dtype == np.float32
    assert (sheet[:, 12:16] == 0.5).all()
    np.testing.assert_array_equal(sheet[..., 0][:, :12], np.asarray(luma.mask))
    np.testing.assert_array_equal(sheet[..., 2][:, 16:], np.asarray(sobel.mask))
    assert sheet[3, 5, 1] == sheet[3, 16 + 6, 1] == 1 and sheet[3, 3, 1] == 0


@pytest.mark.parametrize("ending", ["png", "exr"])
def test_contours_are_written(tmp_path, ending):
    edges = filters.sobel_edges(_step())
    path = tmp_path / f"contours.{ending}"
    filters.save_contours(path, edges, edges)
    if ending == "exr":
        np.testing.assert_array_equal(read_exr(path).image, filters.contours(edges, edges))
    else:
        from PIL import Image

        with Image.open(path) as png:
            assert np.unique(np.asarray(png)).tolist() == [0, 127, 255]


def test_nothing_to_show_and_different_renders_are_refused():
    with pytest.raises(UsageError, match="at least one"):
        filters.contours()
    with pytest.raises(UsageError, match="different heights"):
        filters.contours(filters.sobel_edges(_step()), filters.sobel_edges(_step(height=9)))
