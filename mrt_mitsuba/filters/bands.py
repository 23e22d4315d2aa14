"""A picture in horizontal bands, for filters that shall not work on all of it at once.

A filter that looks no further than some rows gives the same values for a band, bit for bit, as for the whole
picture, if it sees these rows on either side as well: its halo.
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
        """The band's rows."""
        return slice(self.start, self.stop)

    @property
    def seen(self) -> slice:
        """The rows that a filter must see."""
        return slice(self.top, self.bottom)

    @property
    def inner(self) -> slice:
        """The band's rows among those seen."""
        return slice(self.start - self.top, self.stop - self.top)


def bands(height: int, rows: int, halo: int) -> Iterator[Band]:
    """Cut so many rows into bands from the top to the bottom, none of which sees more than ``rows``, but for
    as many as three halos.

    The halo ends at the borders of the picture.
    """
    step = height if height <= rows else max(rows - 2 * halo, halo, 1)
    for start in range(0, height, step):
        stop = min(start + step, height)
        yield Band(start, stop, max(start - halo, 0), min(stop + halo, height))
