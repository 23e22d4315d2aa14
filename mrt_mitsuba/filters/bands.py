"""Horizontal bands of a picture, for filters that work on a part of it at a time.

A filter that reads only some rows above and below a pixel, its halo, gives the same bits for a band with its
halo as for the whole picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Band:
    """Rows ``start`` to ``stop − 1`` of a picture, and with their halo ``top`` to ``bottom − 1``."""

    start: int
    stop: int
    top: int
    bottom: int

    @property
    def rows(self) -> slice:
        """Rows of the band."""
        return slice(self.start, self.stop)

    @property
    def seen(self) -> slice:
        """Rows that a filter reads."""
        return slice(self.top, self.bottom)

    @property
    def inner(self) -> slice:
        """Rows of the band among those that a filter reads."""
        return slice(self.start - self.top, self.stop - self.top)


def bands(height: int, rows: int, halo: int) -> Iterator[Band]:
    """Yield the bands of a picture from top to bottom; each reads at most ``rows`` rows, or three halos.

    The halo ends at the borders of the picture.
    """
    step = height if height <= rows else max(rows - 2 * halo, halo, 1)
    for start in range(0, height, step):
        stop = min(start + step, height)
        yield Band(start, stop, max(start - halo, 0), min(stop + halo, height))
