"""Refining a lattice to an error: it is doubled in the pixels that doubling it still changed.

A picture without random numbers has no variance. Its error is estimated from what doubling the lattice
changes: along edges it falls with aa (by the report's lattice, which is off centre) or with its power 3/2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mrt_mitsuba.output.error import ErrorEstimate
from mrt_mitsuba.rendering.windows import dilated, window_means

LARGEST_AA = 64

# RMSE that is left over that of the last change, as measured in the report's scenes, where every pixel is
# doubled: 0.6 to 0.95, and 0.26 to 0.39 where theory has 1/3; a fifth more where only those that changed are
LEFT = {"report": 0.9, "centered": 0.4}
FACTOR = 2.0  # by which it may be more or less


class Levels:
    """The aa of each pixel, its colour, and that before the aa was doubled last.

    ``trace`` traces pixels, numbered row by row, with an aa, and returns their colours, [pixels, 3];
    ``finished`` returns a picture [H, W, 3] as it is shown.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        lattice: str,
        trace: Callable[[int, np.ndarray], np.ndarray],
        finished: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self._trace, self._finished, self._left = trace, finished, LEFT[lattice]
        self._aa, self._rays = np.zeros(shape, np.int64), np.zeros(shape)
        self._image, self._coarser = np.zeros((2, *shape, 3), np.float32)

    def first(self) -> dict[int, np.ndarray]:
        """Return two levels of all pixels, by their aa."""
        pixels = np.arange(self._aa.size, dtype=np.uint32)
        return {1: pixels, 2: pixels}

    last = False

    def next(self, most: float, rays: float, target: float | None) -> dict[int, np.ndarray] | None:
        """Return the pixels to double, by their new aa; None where ``most`` rays a pixel do not suffice.

        They leave half of the squared error of ``target`` in the others; those around them are doubled, too.
        """
        change = _squares(self._image, self._coarser)
        near = window_means(change, 1)  # a pixel may change little by chance, its neighbours less likely
        order = np.argsort(near, axis=None)
        # changes of the sharp picture count, which a blur makes smaller
        allowed = change.sum() * ((target or 0.0) / max(self.error().rmse, 1e-30)) ** 2 / 2
        noisy = np.zeros(self._aa.size, bool)
        noisy[order[np.searchsorted(np.cumsum(near.flat[order]), allowed) :]] = True
        doubled = dilated(noisy.reshape(self._aa.shape), 1) & (self._aa < LARGEST_AA)
        chosen = {
            2 * int(aa): np.flatnonzero(doubled & (self._aa == aa)).astype(np.uint32)
            for aa in np.unique(self._aa[doubled])
        }
        enough = self._rays.sum() + self.cost(chosen) <= most * self._aa.size
        return chosen if chosen and enough else None

    def cost(self, chosen: dict[int, np.ndarray]) -> int:
        """Return the number of rays that tracing takes."""
        return sum(aa**2 * len(pixels) for aa, pixels in chosen.items())

    def trace(self, chosen: dict[int, np.ndarray], advance: Callable[[int], object]) -> None:
        """Trace pixels, and note what changes in them."""
        for aa, pixels in chosen.items():
            image, coarser = self._image.reshape(-1, 3), self._coarser.reshape(-1, 3)
            coarser[pixels], image[pixels] = image[pixels], self._trace(aa, pixels)
            self._aa.flat[pixels] = aa
            self._rays.flat[pixels] += aa**2
            advance(aa**2 * len(pixels))

    def unfit(self) -> str:
        """Return nothing."""
        return ""

    def forecast(self) -> tuple[float, float]:
        """Return the error, and no tail: nothing is random."""
        return self.error().rmse, 0.0

    def error(self) -> ErrorEstimate:
        """Return the estimated error of the picture."""
        change = _squares(self._finished(self._image), self._finished(self._coarser))
        rmse = float(self._left * np.sqrt(change.mean()))
        return ErrorEstimate(rmse, rmse / FACTOR, rmse * FACTOR)

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], the error of each pixel and the samples in its mean, [H, W]."""
        change = _squares(self._image, self._coarser)
        return self._finished(self._image), self._left * np.sqrt(change), self._aa**2


def _squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared differences of pictures, means of their colours, [H, W]."""
    return np.asarray(np.square(a - b, dtype=np.float64).mean(axis=-1))
