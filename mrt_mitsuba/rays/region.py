"""Rectangles of a picture's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Region:
    """The columns from ``x`` on and the rows from ``y`` on, counted from the top."""

    x: int
    y: int
    width: int
    height: int

    def grown(self, reach: int, width: int, height: int) -> Region:
        """Return the region with so many pixels around it, as far as the picture goes."""
        left, top = max(self.x - reach, 0), max(self.y - reach, 0)
        right, bottom = min(self.x + self.width + reach, width), min(self.y + self.height + reach, height)
        return Region(left, top, right - left, bottom - top)

    def pixels(self, width: int) -> Any:
        """Return the indices of its pixels in a picture so wide, as a range where that is possible."""
        if self.width == width:
            return range(self.y * width, (self.y + self.height) * width)
        rows, columns = (np.arange(n, dtype=np.uint32) for n in (self.height, self.width))
        return ((rows[:, None] + np.uint32(self.y)) * np.uint32(width) + columns + np.uint32(self.x)).ravel()

    def inside(self, other: Region) -> tuple[slice, slice]:
        """Return its rows and columns in an array of another region's pixels."""
        top, left = self.y - other.y, self.x - other.x
        return slice(top, top + self.height), slice(left, left + self.width)
