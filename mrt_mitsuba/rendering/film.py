"""Positions, times and seeds of camera samples, on a lattice or by a film's rules, and the film's filter."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any
from zlib import crc32

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mrt_mitsuba.plugins.variants import is_jit

FILTER_STEPS_PER_PIXEL = 32  # of a pixel, where integrals over a filter are summed


def opaque(number: float, kind: str | None = None) -> mi.Float:
    """Make a number opaque to Dr.Jit, so that changing it does not recompile the kernel.

    ``kind``: name of its type in Mitsuba; None: UInt32 for a whole number, else Float.
    """
    if not is_jit():
        return number
    if kind is None:
        kind = "UInt32" if isinstance(number, int) else "Float"
    # a kernel that dr.freeze records may read only what is made while it does
    make = _array.__wrapped__ if dr.flag(dr.JitFlag.FreezingScope) else _array
    return make(mi.variant(), kind, number)


def divide(n: mi.UInt32, divisor: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Return quotient and remainder of whole numbers below 2³².

    A processor divides the integers of a packet one after the other, which takes as long as tracing the ray;
    so vectorised variants multiply by the inverse in double precision. The half added keeps n/d away from
    whole numbers by 1/(2 d), and rounding moves it by less than n/d / 2⁵² < 1/(2 d).
    """
    if not is_jit():
        return divmod(n, divisor)
    quotient = mi.UInt32((mi.Float64(n) + 0.5) * opaque(1 / divisor, "Float64"))
    return quotient, n - quotient * opaque(divisor, "UInt32")


@lru_cache(maxsize=64)
def _array(variant: str, kind: str, number: float) -> mi.Float:
    return dr.opaque(getattr(mi, kind), number)


def derived_seed(seed: Any, **parts: int) -> Any:
    """Return the seed for a part of what ``seed`` decides, such as ``frame=2, refinement=1``.

    Parts of different names or numbers draw independent numbers, and so do the same parts of another seed.
    Parts with the number 0 are left out; where all are, ``seed`` itself comes back, which may then be a
    Dr.Jit array. A sum such as ``seed + frame`` would give a frame the numbers of another seed's frame.
    """
    key = [n for name, part in sorted(parts.items()) if part for n in (crc32(name.encode()), part)]
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0]) if key else seed


@dataclass(frozen=True)
class SamplePattern:
    """Samples number ``first`` to ``first + count − 1`` in each pixel, each traced ``repeats`` times.

    They lie on a lattice of aa × aa. ``report``: sample (i, j) is at (0.5 + i/aa, 0.5 + j/aa), y upwards, as
    in the original. Sample 0 is the pixel's centre and the others reach into the next pixels, which shifts
    the picture by up to half a pixel. ``centered``: samples are the centres of aa × aa equal cells. ``film``:
    no grid, but as many places that the sampler of a scene draws, see ``Film``.

    The shutter is open from time 0 to 1, divided into ``time_strata`` equal strata; successive rays of a
    pixel go to strata far from each other, so that position and time do not correlate. ``phase``: where in
    its stratum a ray is, 0 to 1.
    """

    lattice: str = "report"
    aa: int = 1  #: of the report's lattice, the pixel's centre alone
    first: int = 0
    count: int = 1
    repeats: int = 1
    time_strata: int = 0  #: 0: all rays start at time 0
    phase: float = 0.0

    @property
    def size(self) -> int:
        """Number of rays of a pixel."""
        return self.count * self.repeats

    @property
    def holds_centre(self) -> bool:
        """True if the pixel's centre is one of the lattice's samples, which is then the first."""
        return self.lattice == "report" or (self.lattice == "centered" and self.aa % 2 == 1)

    def at(self, pixel: mi.UInt32, ray: mi.UInt32, width: int, height: int) -> tuple[mi.Point2f, mi.Float]:
        """Return the positions of rays in a picture of this size, [0, 1]², x to the right and y down, and
        their times."""
        row, column = divide(pixel, width)
        sample = divide(ray, self.repeats)[0] + opaque(self.first)
        if self.lattice == "centered" and self.holds_centre:
            # start from the middle one, so that sample 0 is the centre
            sample = (sample + self.aa**2 // 2) % self.aa**2
        i, j = (mi.Float(number) for number in divide(sample, self.aa))
        n = mi.Float(opaque(self.aa))
        if self.lattice == "report":
            x = 0.5 + i / n
            y = 0.5 - j / n
        else:
            x = (i + 0.5) / n
            y = (j + 0.5) / n
        columns = mi.Float(opaque(width))
        rows = mi.Float(opaque(height))
        place = mi.Point2f((mi.Float(column) + x) / columns, (mi.Float(row) + y) / rows)
        if not self.time_strata:
            return place, mi.Float(0)
        # strata from one ray to the next: coprime to their number, near its golden section
        golden = max(round(self.time_strata * (math.sqrt(5) - 1) / 2), 1)
        stride = next(s for s in range(golden, self.time_strata + 2) if math.gcd(s, self.time_strata) <= 1)
        moments = mi.UInt64(opaque(self.time_strata))
        part = mi.UInt64(ray) * mi.UInt64(opaque(stride)) % moments
        return place, (mi.Float(part) + opaque(float(self.phase))) / mi.Float(moments)


class Film:
    """The film of a sensor, as Mitsuba would expose it.

    Pixels are numbered row by row, with the border that it samples around the picture.
    """

    def __init__(self, sensor: mi.Sensor) -> None:
        film = sensor.film()
        sampler = sensor.sampler()
        rfilter = film.rfilter()
        self.sensor = sensor
        self.rfilter = rfilter
        #: pixels on either side to which a ray contributes
        self.reach = 0 if rfilter.is_box_filter() else int(rfilter.border_size())
        #: pixels that are sampled around the picture, and are no part of it
        self.border = int(rfilter.border_size()) if film.sample_border() else 0
        self.width, self.height = (int(n) + 2 * self.border for n in film.crop_size())  # with the border
        self.shape = (self.height, self.width)
        self.pixels = self.height * self.width
        pixel_format = re.search(r"pixel_format = (\w+)", str(film))
        #: as the film prints it, "rgb" or "ya"; "" for a film of another kind
        self.pixel_format = pixel_format[1] if pixel_format else ""
        self.grey = self.pixel_format in ("luminance", "y", "ya")
        self.alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)  #: does it keep the coverage
        self.bands: tuple[str, ...] = ()  #: names of its spectral bands, if it has such
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            film.prepare([])  # it knows its channels from then on
            self.bands = tuple(field.name for field in film.bitmap().struct_())
        self.rays = int(sampler.sample_count())  #: of a pixel, as the scene's sampler has them
        self.sampler = sampler.class_name()
        #: whether rays get independent random numbers, as they always do in scalar variants
        self.independent = not is_jit() or self.sampler == "IndependentSampler"

    def picture(self, sampled: np.ndarray) -> np.ndarray:
        """Return an array [..., rows, columns, channels] without the film's border."""
        rows, columns = (slice(self.border, n - self.border) for n in self.shape)
        return sampled[..., rows, columns, :]

    def rays_near(self, count: int) -> int:
        """Return the number of rays of a pixel, nearest to ``count``, that the scene's sampler allows."""
        sampler = self.sensor.sampler().clone()
        sampler.set_sample_count(count)
        return int(sampler.sample_count())

    def place(self, pixel: mi.UInt32, sampler: mi.Sampler) -> tuple[mi.Point2f, mi.Point2f]:
        """Draw positions in pixels; return them on the film, in pixels, and in the picture, [0, 1]²."""
        border = float(self.border)
        size = mi.Vector2f(opaque(self.width - 2 * border), opaque(self.height - 2 * border))
        row, column = divide(pixel, self.width)
        place = mi.Point2f(mi.Float(column), mi.Float(row)) + sampler.next_2d()
        return place, (place - opaque(border)) / size

    @property
    def _offsets(self) -> np.ndarray:
        """Positions along an axis from the filter's centre, in pixels, where ``weights`` are taken."""
        pixels = np.arange(-self.reach, self.reach + 1)[:, None]
        return pixels + (np.arange(FILTER_STEPS_PER_PIXEL) + 0.5) / FILTER_STEPS_PER_PIXEL - 0.5

    @cached_property
    def weights(self) -> np.ndarray:
        """Values of the filter along an axis, [pixels in its reach, ``FILTER_STEPS_PER_PIXEL``]."""
        offsets = self._offsets
        flat = offsets.ravel().tolist()
        if not is_jit():
            values = [self.rfilter.eval(place) for place in flat]
        else:  # a list is copied; for NumPy's memory, Dr.Jit would compile a kernel for every alignment
            values = self.rfilter.eval(mi.Float(flat))
        return np.asarray(values, np.float64).reshape(offsets.shape)

    @property
    def correlation(self) -> float:
        """Sum of squared correlations of a pixel's error with the errors of all pixels, its own included."""
        values = self.weights.ravel()
        overlap = np.correlate(values, values, "full")[
            (len(values) - 1) % FILTER_STEPS_PER_PIXEL :: FILTER_STEPS_PER_PIXEL
        ]
        return float(np.sum(np.square(overlap / overlap.max()))) ** 2

    @property
    def filter_variance_ratio(self) -> float:
        """Ratio of a filtered pixel's variance to that of the mean of the rays that start in it."""
        along = np.square(self.weights).mean() / np.square(self.weights.mean())
        return float(along / len(self.weights)) ** 2

    @property
    def between_pixel_share(self) -> float:
        """Fraction of the variance that remains if the filter is replaced by its mean in each pixel."""
        along = np.square(self.weights.mean(1)).sum() / np.square(self.weights).mean(1).sum()
        return float(along) ** 2

    def filtered_means(self, means: np.ndarray) -> np.ndarray:
        """Filter means over pixels, [H, W, channels]: by three taps along each axis, to the filter's width.

        A mean over a pixel is wide already; the taps add the rest of the filter's second moment.
        """
        share = self.weights / self.weights.sum()
        beside = (float((share * self._offsets**2).sum()) - 1 / 12) / 2
        return self._convolved(means, np.array([beside, 1 - 2 * beside, beside], np.float32), (0, 1))

    def filtered_variance(self, variance: np.ndarray) -> np.ndarray:
        """Convolve the variance [..., H, W] of pixel means with the squared filter, up to a factor."""
        share = np.square(self.weights).sum(axis=1)
        return self._convolved(variance, (share / share.sum()).astype(np.float32), (-2, -1))

    def _convolved(self, values: np.ndarray, taps: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
        """Convolve with symmetric taps along each axis; beyond the border, values are those of the border."""
        reach = len(taps) // 2
        for axis in axes if self.reach else ():
            padding = [(0, 0)] * values.ndim
            padding[axis] = (reach, reach)
            wide = sliding_window_view(np.pad(values, padding, mode="edge"), len(taps), axis)
            values = taps[reach] * wide[..., reach]
            for k in range(reach):
                values = values + (wide[..., k] + wide[..., -1 - k]) * taps[k]
        return values
