"""Sums of ray values under the filter of a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.rendering.film import Film, divide, opaque

PIXELS_AT_ONCE = 2**15  # whose sums are formed at once; those of more would not stay in a cache
OFFSETS_AT_ONCE = 5  # along an axis: neighbouring pixels for which a kernel sums rays
CHANNELS_AT_ONCE = 4  # the weights among them


class Canvas:
    """Sums of filtered values over the pixels of some pictures; the rays of a pixel weigh 1 in all.

    Rays lie in memory by the pixel in which they start. Each pixel adds up its own rays, once for every pixel
    that the filter reaches from it; then each pixel adds up what reaches it. Both have the same order every
    time; a scatter, as in Mitsuba's ``ImageBlock``, has that of threads, and other bits in most runs. The
    former sums are formed in single precision, the latter in double, so that pictures are the same wherever
    wavefronts are cut between rows.

    ``sums`` [channels, pictures, H, W] has filtered values times their weights, ``weights`` [pictures, H, W]
    these. With ``moments``, ``total`` and ``square`` [3, pictures, H, W] have the colours of the rays in each
    pixel and their squares, unfiltered, and ``peak`` [pictures, H, W] the mean colour of the brightest.
    """

    def __init__(self, film: Film, rays: np.ndarray, channels: int, *, moments: bool) -> None:
        """Allocate for ``rays[picture, pixel]`` rays of ``channels`` values each."""
        self.rays = rays
        self._film = film
        self._share = np.float32(1 / np.maximum(rays, 1)).ravel()  # of a ray among those of its pixel
        precision = np.float64 if film.reach else np.float32
        self._sums: np.ndarray = np.zeros((channels + 1, rays.size), precision)
        self._moments: np.ndarray = np.zeros((7 if moments else 0, rays.size), np.float32)
        shape = (len(rays), *film.shape)
        self.sums = self._sums[:-1].reshape(-1, *shape)
        self.weights = self._sums[-1].reshape(shape)
        if moments:
            self.total = self._moments[:3].reshape(-1, *shape)
            self.square = self._moments[3:6].reshape(-1, *shape)
            self.peak = self._moments[6].reshape(shape)

    def put(
        self, place: mi.Point2f | np.ndarray | None, values: Sequence[mi.Float], rays: np.ndarray
    ) -> None:
        """Add the values of rays, [channels] each, colours first, at their places on the film.

        ``rays``: how many start in each pixel, those of the second picture after those of the first; they
        come in this order. ``place``: None where the filter is a box.
        """
        if isinstance(place, np.ndarray):
            self._put_one_by_one(place, np.asarray(values), np.repeat(np.arange(rays.size), rays))
            return
        film = self._film
        if not film.reach:
            self._sums[-1] += self._share * rays.astype(np.float32)
        first = np.zeros(rays.size + 1, np.uint32)
        np.cumsum(rays, dtype=np.uint32, out=first[1:])
        some = _Rays(place, values, mi.UInt32(first), mi.Float(self._share), film)
        chosen = np.flatnonzero(rays.reshape(-1, film.width).any(1))  # rows
        for rows in _parts(chosen[0], chosen[-1] + 1, max(PIXELS_AT_ONCE // film.width, 1)):
            self._put_rows(some, rows.start * film.width, rows.stop * film.width)

    def _put_rows(self, rays: _Rays, low: int, high: int) -> None:
        """Accumulate rays that start in pixels [low, high), which are whole rows."""
        film = self._film
        first = 0
        channels = len(self._sums)
        if len(self._moments):
            *terms, peak = rays.moments(low, high)
            dr.eval(terms, peak)
            moments = np.stack([np.asarray(term) for term in terms])
            self._moments[:6, low:high] += moments
            brightest = self._moments[6, low:high]
            np.maximum(brightest, np.asarray(peak), out=brightest)
        if not film.reach:  # whose weights are 1
            channels -= 1
            if len(self._moments):
                first = 3
                self._sums[:3, low:high] += self._share[low:high] * moments[:3]
        offsets = _parts(-film.reach, film.reach + 1, OFFSETS_AT_ONCE)
        for some in _parts(first, channels, CHANNELS_AT_ONCE):
            for down, across in product(offsets, offsets):
                sums = rays.filtered(low, high, some, down, across)
                begin = low
                end = high
                if film.reach:
                    begin = max(low + down[0] * film.width, 0)
                    end = min(high + down[-1] * film.width, self.rays.size)
                    if begin >= end:  # these offsets lead beyond the pictures
                        continue
                    dr.eval(sums)
                    sums = rays.gathered(sums, low, high, begin, end, down, across)
                dr.eval(sums)
                for channel, more in zip(some, sums, strict=True):
                    self._sums[channel, begin:end] += np.asarray(more)

    def _put_one_by_one(self, place: np.ndarray, values: np.ndarray, pixels: np.ndarray) -> None:
        """Add values [channels, rays] at places [2, rays], of rays that start in these pixels."""
        film = self._film
        evaluate = film.rfilter.eval
        if len(self._moments):
            colors = values[:3]
            np.add.at(self._moments[:6].T, pixels, np.concatenate([colors, colors**2]).T)
            np.maximum.at(self._moments[6], pixels, colors.mean(0))
        line, column = np.divmod(pixels, film.width)
        away = (place - np.stack([column, line % film.height]) - 0.5).T.tolist()
        given = np.stack([*values, np.ones(len(pixels))]) * self._share[pixels]
        for down, across in product(range(-film.reach, film.reach + 1), repeat=2):
            weight = np.ones(len(pixels))
            if film.reach:
                weight[:] = [evaluate(across - x) * evaluate(down - y) for x, y in away]
            row = line % film.height + down
            beside = column + across
            inside = (row >= 0) & (row < film.height) & (beside >= 0) & (beside < film.width)
            at = (pixels + down * film.width + across)[inside]
            np.add.at(self._sums.T, at, (given * weight)[:, inside].T)


@dataclass(frozen=True)
class _Rays:
    """The rays of a wavefront, sorted by the pixel in which they start."""

    place: mi.Point2f | None  #: on the film, in pixels; None under a box filter
    values: Sequence[mi.Float]  #: by channel, colours first
    first: mi.UInt32  #: number of the first ray of each pixel, and that of all rays
    share: mi.Float  #: of a ray among all in its pixel, by pixel
    film: Film

    def moments(self, low: int, high: int) -> list[mi.Float]:
        """Return sums of the colours of the rays in each pixel, sums of their squares, and the largest mean
        colour of a ray, or 0."""

        def add(ray: mi.UInt32, sums: list[mi.Float], peak: mi.Float) -> tuple:
            colors = [dr.gather(mi.Float, value, ray) for value in self.values[:3]]
            terms = [*colors, *(color * color for color in colors)]
            sums = [a + b for a, b in zip(sums, terms, strict=True)]
            return ray + 1, sums, dr.maximum(peak, sum(colors) / 3)

        pixel = dr.arange(mi.UInt32, high - low) + opaque(low)
        last = dr.gather(mi.UInt32, self.first, pixel + 1)
        state = dr.gather(mi.UInt32, self.first, pixel), [mi.Float(0)] * 6, mi.Float(0)
        _, sums, peak = dr.while_loop(state, lambda ray, *_: ray < last, add)
        return [*sums, peak]

    def filtered(self, low: int, high: int, channels: range, down: range, across: range) -> list[mi.Float]:
        """Return what the rays in each pixel contribute to the pixels at some offsets: by row and column of
        the offsets, and by channel."""
        evaluate = self.film.rfilter.eval
        pixel = dr.arange(mi.UInt32, high - low) + opaque(low)
        line, column = divide(pixel, self.film.width)
        row = divide(line, self.film.height)[1]
        x = [mi.Float(column) + (opaque(across[0] + 0.5) + i) for i in range(len(across))]
        y = [mi.Float(row) + (opaque(down[0] + 0.5) + i) for i in range(len(down))]

        def add(ray: mi.UInt32, sums: list[mi.Float]) -> tuple[mi.UInt32, list[mi.Float]]:
            weights = [mi.Float(1)]
            if self.film.reach:
                place = dr.gather(mi.Point2f, self.place, ray)
                along = [evaluate(centre - place.x) for centre in x]
                weights = [evaluate(centre - place.y) * weight for centre in y for weight in along]
            values = [
                dr.gather(mi.Float, value, ray) for value in self.values[channels.start : channels.stop]
            ]
            values += [mi.Float(1)] * (len(channels) - len(values))  # the channel of the weights
            terms = (weight * value for weight in weights for value in values)
            return ray + 1, [a + b for a, b in zip(sums, terms, strict=True)]

        last = dr.gather(mi.UInt32, self.first, pixel + 1)
        nothing = [mi.Float(0)] * (len(down) * len(across) * len(channels))
        state = dr.gather(mi.UInt32, self.first, pixel), nothing
        _, sums = dr.while_loop(state, lambda ray, _: ray < last, add)
        share = dr.gather(mi.Float, self.share, pixel)
        return [total * share for total in sums]

    def gathered(
        self, sums: Sequence[mi.Float], low: int, high: int, begin: int, end: int, down: range, across: range
    ) -> list[mi.Float64]:
        """Return the contributions to pixels [begin, end), by channel; see ``filtered``."""
        width = opaque(self.film.width)
        height = opaque(self.film.height)
        pixel = dr.arange(mi.UInt32, end - begin) + opaque(begin)
        line, column = divide(pixel, self.film.width)
        row = divide(line, self.film.height)[1]
        # numbers below 0 wrap around, to numbers beyond all pixels
        top = opaque(down[0] % 2**32)
        left = opaque(across[0] % 2**32)
        count = len(sums) // (len(down) * len(across))
        totals = [mi.Float64(0)] * count
        for number, (i, j) in enumerate(product(range(len(down)), range(len(across)))):
            below = top + i
            right = left + j
            index = pixel - below * width - right - opaque(low)  # where the rays start
            reached = (row - below < height) & (column - right < width) & (index < opaque(high - low))
            some = sums[number * count : (number + 1) * count]
            given = (dr.gather(mi.Float, each, index, reached) for each in some)
            totals = [total + mi.Float64(more) for total, more in zip(totals, given, strict=True)]
        return totals


def _parts(start: int, stop: int, most: int) -> list[range]:
    """A range cut into parts of at most ``most`` numbers."""
    return [range(at, min(at + most, stop)) for at in range(start, stop, most)]
