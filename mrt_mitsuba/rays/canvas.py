"""What rays add up to on a film whose filter reaches beyond the pixel in which a ray starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrt_mitsuba.rays.divisor import constants
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
        if isinstance(place, np.ndarray):
            self._put_one_by_one(place, np.asarray(values), np.repeat(pixels, rays))
            return
        counts = np.zeros((self._pictures, self._film.pixels), np.uint32)
        counts.ravel()[pixels] = rays
        padded = self._padded(counts)
        first = np.cumsum(padded, dtype=np.uint32) - padded  # of each place, the number of its first ray
        low, high = np.searchsorted(first, 0, "right") - 1, np.searchsorted(first, first[-1])
        lanes = max(1, MOST_LANES // self._width) * self._width
        for start in range(int(low) // lanes * lanes, int(high), lanes):
            self._put(place, values, max(start, int(low)), min(start + lanes, int(high)), first)

    def _put_one_by_one(self, place: np.ndarray, values: np.ndarray, pixels: np.ndarray) -> None:
        """Add values [channels, rays] at places [2, rays], of rays that start in these pixels."""
        film, evaluate = self._film, self._film.sensor.film().rfilter().eval
        picture, pixel = np.divmod(pixels, film.pixels)
        row, column = np.divmod(pixel, film.width)
        at = (picture * self._height + row + film.reach) * self._width + column + film.reach
        if len(self._moments):
            colors = values[:3]
            for plane, value in zip(self._moments, [*colors, *colors**2], strict=False):
                np.add.at(plane, at, value)
            np.maximum.at(self._moments[6], at, colors.mean(0))
        away = (place - np.stack([column, row]) - 0.5).T.tolist()
        given = np.stack([*values, np.ones(len(pixels))]) * self._shares[at]
        for down in range(-film.reach, film.reach + 1):
            for across in range(-film.reach, film.reach + 1):
                weight = np.ones(len(pixels))
                if film.reach:
                    weight *= [evaluate(across - x) * evaluate(down - y) for x, y in away]
                for plane, value in zip(self._sums, given, strict=True):
                    np.add.at(plane, at + down * self._width + across, value * weight)

    def _put(self, place: Any, values: Sequence[Any], start: int, stop: int, first: np.ndarray) -> None:
        """Add the rays of padded places from ``start`` to ``stop``, given the number of the first of each."""
        import drjit as dr
        import mitsuba as mi

        reach, lane = self._film.reach, dr.arange(mi.UInt32, stop - start)
        # one more than there are lanes, so that Dr.Jit gathers them: to load them, it would compile another
        # kernel for every alignment of NumPy's memory
        numbers = mi.UInt32(first[start : stop + 1])
        run = dr.gather(mi.UInt32, numbers, lane), dr.gather(mi.UInt32, numbers, lane + 1)
        share = dr.gather(mi.Float, mi.Float(self._shares[start : stop + 1]), lane)
        if len(self._moments):
            more = _moments(values[:3], *run)
            dr.eval(more)
            for index, found in enumerate(more):
                known = self._moments[index, start:stop]
                (np.add if index < 6 else np.maximum)(known, np.asarray(found), out=known)
        sizes = constants(width=self._width, height=self._height)
        row, column = sizes["width"].divide(lane + dr.opaque(mi.UInt32, start))
        _, row = sizes["height"].divide(row)
        centre = mi.Float(column) - reach + 0.5, mi.Float(row) - reach + 0.5
        rows = max(1, MOST_SUMS // ((2 * reach + 1) * len(self._sums)))
        for above in range(-reach, reach + 1, rows):
            down = range(above, min(above + rows, reach + 1))
            given = [total * share for total in self._given(place, values, run, centre, down)]
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

    def _given(
        self, place: Any, values: Sequence[Any], run: tuple[Any, Any], centre: tuple[Any, Any], down: range
    ) -> list[Any]:
        """Return what rays at places on the film give to pixels in reach, so many rows further down.

        Each lane adds up a ``run`` of rays, from the first to the last, of the pixel with this ``centre``.
        """
        import drjit as dr
        import mitsuba as mi

        reach, rfilter = self._film.reach, self._film.sensor.film().rfilter()
        across, rows = range(-reach, reach + 1), [dr.opaque(mi.Float, step) for step in down]

        def add(ray: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            found = [*(dr.gather(mi.Float, value, ray) for value in values), mi.Float(1)]
            if reach:
                x = dr.gather(mi.Float, place.x, ray) - centre[0]
                y = dr.gather(mi.Float, place.y, ray) - centre[1]
                along = [rfilter.eval(step - x) for step in across]
                shown = [[value * rfilter.eval(step - y) for value in found] for step in rows]
                found = [value * weight for row in shown for weight in along for value in row]
            return ray + 1, [total + value for total, value in zip(sums, found, strict=True)]

        state = run[0], [mi.Float(0)] * (len(rows) * len(across) * (len(values) + 1))
        return list(dr.while_loop(state, lambda ray, _: ray < run[1], add)[1])


def _moments(values: Sequence[Any], first: Any, last: Any) -> list[Any]:
    """Return sums over runs of rays of their values, those of their squares, and the largest mean of a ray's
    values, or 0."""
    import drjit as dr
    import mitsuba as mi

    def add(ray: Any, sums: list[Any], most: Any) -> tuple[Any, list[Any], Any]:
        found = [dr.gather(mi.Float, value, ray) for value in values]
        sums = [a + b for a, b in zip(sums, [*found, *(value * value for value in found)], strict=True)]
        return ray + 1, sums, dr.maximum(most, sum(found) / len(found))

    state = first, [mi.Float(0)] * (2 * len(values)), mi.Float(0)
    _, sums, most = dr.while_loop(state, lambda ray, *_: ray < last, add)
    return [*sums, most]
