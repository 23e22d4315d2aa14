"""Contour pictures: what the detectors found, white on black, side by side as the report shows them."""

from __future__ import annotations

import os

import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters.edges import EdgeMap, edges_image

GAP = 4  # pixels between two pictures
GREY = 0.5  # of the gap, so that a contour at the border still shows as one


def contours(*edges: EdgeMap) -> np.ndarray:
    """Return the contours of one or several detectors as one picture, [H, W', 3] float32, from left to right.

    Raises:
        UsageError: for no detector, or pictures of different heights.
    """
    if not edges:
        raise UsageError("contours needs at least one EdgeMap, such as sobel_edges(image)")
    pictures = [edges_image(found) for found in edges]
    heights = {picture.shape[0] for picture in pictures}
    if len(heights) > 1:
        raise UsageError(
            f"contours of pictures with different heights {sorted(heights)}: give those of one render"
        )
    gap = np.full((heights.pop(), GAP), GREY, np.float32)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.repeat(np.concatenate(parts, axis=1)[..., None], 3, axis=-1)


def save_contours(path: str | os.PathLike[str], *edges: EdgeMap) -> None:
    """Write ``contours(*edges)`` as .png or .exr; raise ``OutputError`` where that fails."""
    from mrt_mitsuba.output import files as output

    output.save(path, contours(*edges))
