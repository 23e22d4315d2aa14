"""What rays add up to on a film whose filter reaches beyond the pixel in which a ray starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from mrt_mitsuba.rays.divisor import Divisor
from mrt_mitsuba.rays.film import Film

MOST_LANES = 2**17  # of a kernel, each with as many sums
MOST_SUMS = 128  # in a kernel: more take longer to compile, with fewer each ray is read more often


class Canvas:
    """Sums of filtered values over the pixels of some pictures; the rays of a pixel weigh 1 in all.

    A lane adds up what the rays of one pixel give to one of its neighbours, for all neighbours in reach. What
    it gives to the same neighbour lies at the same distance from it, along rows that are padded by the reach.
    All sums are formed in the same order every time, and no two lanes write to one place; those along a row
    in single precision, those of rows in double, so that pictures are the same wherever wavefronts are cut
    between rows.
    """

    def __init__(self, film: Film, rays: np.ndarray, channels: int, *, moments: bool) -> None:
        """Take up values of so many channels of so many rays in each pixel, [pictures, pixels].

        Args:
            moments: add up the colours of the rays of each pixel and their squares as well, unfiltered, and
                note the brightest.
        """
        self._film, self._pictures = film, len(rays)
        self._width, self._height = (n + 2 * film.reach for n in (film.width, film.height))
        self._shares = self._padded(np.float32(1 / np.maximum(rays, 1)))
        size = len(self._shares) - 1
        self._sums, self._moments = np.zeros((channels + 1, size)), np.zeros((7 * moments, size))

    @property
    def sums(self) -> np.ndarray:
        """The sums of values and, last, of weights, [pictures, H, W, channels + 1]."""
        return np.moveaxis(self._seen(self._sums), 0, -1)

    @property
    def moments(self) -> np.ndarray:
        """The sums of colours and of squared colours, and the mean colour of the brightest ray,
        [pictures, H, W, 7]; empty where not asked for."""
        return np.moveaxis(self._seen(self._moments), 0, -1)

    def _padded(self, values: np.ndarray) -> np.ndarray:
        """Return values [pictures, pixels] with padding around each picture and one 0 at the end, flat."""
        flat = np.zeros(self._pictures * self._height * self._width + 1, values.dtype)
        self._seen(flat[None, :-1])[0] = values.reshape(self._pictures, *self._film.shape)
        return flat

    def _seen(self, planes: np.ndarray) -> np.ndarray:
        """Return a view [planes, pictures, H, W] of what lies within the padding."""
        padded = planes.reshape(len(planes), self._pictures, self._height, self._width)
        rows, columns = (slice(self._film.reach, n - self._film.reach) for n in padded.shape[2:])
        return padded[..., rows, columns]

    def put(self, place: Any, values: Sequence[Any], pixels: np.ndarray, rays: np.ndarray) -> None:
        """Add the values of rays, [channels] each, colours first, at their places on the film.

        Args:
            pixels: where they start, ascending; those of the second picture follow on those of the first.
            rays: how many start there, one after the other.
        """
        counts = np.zeros((self._pictures, self._film.pixels), np.uint32)
        counts.ravel()[pixels] = rays
        padded = self._padded(counts)
        first = np.cumsum(padded, dtype=np.uint32) - padded  # of each place, the number of its first ray
        low, high = np.searchsorted(first, 0, "right") - 1, np.searchsorted(first, first[-1])
        lanes = max(1, MOST_LANES // self._width) * self._width
        for start in range(int(low) // lanes * lanes, int(high), lanes):
            self._put(place, values, max(start, int(low)), min(start + lanes, int(high)), first)

    def _put(self, place: Any, values: Sequence[Any], start: int, stop: int, first: np.ndarray) -> None:
        """Add the rays of padded places from ``start`` to ``stop``, given the number of the first of each."""
        import drjit as dr

        reach = self._film.reach
        # one more than there are lanes, so that Dr.Jit gathers them: to load them, it would compile another
        # kernel for every alignment of NumPy's memory
        runs = self._runs(start, first[start : stop + 1], self._shares[start : stop + 1])
        more = runs.moments(values[:3]) if len(self._moments) else []
        dr.eval(more)
        for index, found in enumerate(more):
            known = self._moments[index, start:stop]
            (np.add if index < 6 else np.maximum)(known, np.asarray(found), out=known)
        rows = max(1, MOST_SUMS // ((2 * reach + 1) * len(self._sums)))
        for above in range(-reach, reach + 1, rows):
            down = range(above, min(above + rows, reach + 1))
            given = runs.given(self._film, place, values, down)
            dr.eval(given)
            for index, step in enumerate(down):
                near = self._row(given[index * len(given) // len(down) :], stop - start)
                low = start + step * self._width - reach
                self._sums[:, low : low + near.shape[1]] += near

    def _row(self, given: Sequence[Any], lanes: int) -> np.ndarray:
        """Return sums of what lanes give to neighbours in one row, [channels + 1, lanes + 2 reach]."""
        count, reach = len(self._sums), self._film.reach
        near = np.zeros((count, lanes + 2 * reach), np.asarray(given[0]).dtype)
        for step in range(2 * reach + 1):
            for total, found in zip(near, given[step * count :], strict=False):
                total[step : step + lanes] += np.asarray(found)
        return near

    def _runs(self, start: int, first: np.ndarray, shares: np.ndarray) -> _Runs:
        """Return the rays of places in padded pictures from ``start`` on, given the first of each."""
        import drjit as dr
        import mitsuba as mi

        lane, numbers = dr.arange(mi.UInt32, len(first) - 1), mi.UInt32(first)
        begin, end = dr.gather(mi.UInt32, numbers, lane), dr.gather(mi.UInt32, numbers, lane + 1)
        share = dr.gather(mi.Float, mi.Float(shares), lane)
        width, height = _divisors(self._width, self._height, mi.variant())
        row, column = width.divide(lane + dr.opaque(mi.UInt32, start))
        _, row = height.divide(row)
        reach = self._film.reach
        return _Runs(begin, end, share, mi.Float(column) - reach, mi.Float(row) - reach)


@dataclass(frozen=True)
class _Runs:
    """The rays of each of some pixels, which follow on each other."""

    first: Any  #: number of the first
    last: Any  #: and of the one after the last
    share: Any  #: weight of each ray
    column: Any  #: of the pixel
    row: Any

    def given(self, film: Film, place: Any, values: Sequence[Any], down: range) -> list[Any]:
        """Return what rays at places on a film give to pixels in reach so many rows further down."""
        import drjit as dr
        import mitsuba as mi

        rfilter, across = film.sensor.film().rfilter(), range(-film.reach, film.reach + 1)
        rows = [dr.opaque(mi.Float, step) for step in down]

        def one(ray: Any) -> list[Any]:
            channels = [*(dr.gather(mi.Float, value, ray) for value in values), mi.Float(1)]
            if not film.reach:
                return channels
            x = dr.gather(mi.Float, place.x, ray) - (self.column + 0.5)
            y = dr.gather(mi.Float, place.y, ray) - (self.row + 0.5)
            along = [rfilter.eval(step - x) for step in across]
            shown = ([value * rfilter.eval(step - y) for value in channels] for step in rows)
            return [value * weight for values in shown for weight in along for value in values]

        count = len(rows) * len(across) * (len(values) + 1)
        return [total * self.share for total in self._summed(one, count)]

    def moments(self, values: Sequence[Any]) -> list[Any]:
        """Return the sums of values, those of their squares, and the largest mean of a ray's values, or 0."""
        import drjit as dr
        import mitsuba as mi

        def add(ray: Any, sums: list[Any], most: Any) -> tuple[Any, list[Any], Any]:
            found = [dr.gather(mi.Float, value, ray) for value in values]
            sums = [a + b for a, b in zip(sums, [*found, *(value * value for value in found)], strict=True)]
            return ray + 1, sums, dr.maximum(most, sum(found) / len(found))

        state = self.first, [mi.Float(0)] * (2 * len(values)), mi.Float(0)
        _, sums, most = dr.while_loop(state, lambda ray, *_: ray < self.last, add)
        return [*sums, most]

    def _summed(self, one: Callable[[Any], list[Any]], count: int) -> list[Any]:
        """Return sums over each run of what ``one`` returns of a ray."""
        import drjit as dr
        import mitsuba as mi

        def add(ray: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            return ray + 1, [total + value for total, value in zip(sums, one(ray), strict=True)]

        state = self.first, [mi.Float(0)] * count
        return list(dr.while_loop(state, lambda ray, _: ray < self.last, add)[1])


@lru_cache(maxsize=16)
def _divisors(width: int, height: int, variant: str) -> tuple[Divisor, Divisor]:
    return Divisor.opaque(width), Divisor.opaque(height)
