"""A film's rules: where the rays through its pixels start, and how their values become a picture."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mrt_mitsuba.rays.divisor import constants

STEPS = 32  # of a pixel, where integrals over a filter are summed


@dataclass(frozen=True)
class Film:
    """The film of a sensor. Pixels are numbered row by row, with the border that it samples around it."""

    sensor: Any
    width: int  #: pixels that are sampled in a row
    height: int  #: rows that are sampled
    border: int  #: pixels that are sampled around the picture, and are no part of it
    reach: int  #: pixels on either side to which a ray contributes
    alpha: bool  #: does it keep the coverage
    grey: bool  #: does it keep the luminance only
    bands: tuple[str, ...]  #: names of its spectral bands, if it has such

    @classmethod
    def of(cls, sensor: Any) -> Film:
        """Return the film of a sensor as Mitsuba would expose it."""
        import mitsuba as mi

        film = sensor.film()
        rfilter = film.rfilter()
        reach = 0 if rfilter.is_box_filter() else int(rfilter.border_size())
        border = int(rfilter.border_size()) if film.sample_border() else 0
        width, height = (int(n) + 2 * border for n in film.crop_size())
        alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        grey = pixel_format(film) in ("luminance", "y", "ya")
        return cls(sensor, width, height, border, reach, alpha, grey, spectral_bands(film))

    @property
    def pixels(self) -> int:
        """Number of pixels that are sampled."""
        return self.width * self.height

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that are sampled."""
        return self.height, self.width

    def picture(self, sampled: np.ndarray) -> np.ndarray:
        """Return what lies in the picture, of an array [..., pixels or rows × columns, channels]."""
        rows, columns = (slice(self.border, n - self.border) for n in self.shape)
        return sampled[..., rows, columns, :]

    def framed(self, picture: np.ndarray, value: float) -> np.ndarray:
        """Return a picture [H, W] with the film's border around it, of one value."""
        return np.pad(picture, self.border, constant_values=value) if self.border else picture

    def toned(self, color: Any) -> Any:
        """Return linear sRGB as the film keeps it."""
        import mitsuba as mi

        return mi.Color3f(mi.luminance(mi.Color3f(color))) if self.grey else color

    def banded(self, spectrum: Any, wavelengths: Any) -> list[Any]:
        """Return what each spectral band measures of a radiance."""
        measured = self.sensor.film().prepare_sample(spectrum, wavelengths, len(self.bands) + 1)
        return list(measured[: len(self.bands)])  # without the weight

    def rays_near(self, count: int) -> int:
        """Return the number of rays a pixel that the scene's sampler makes of a number."""
        sampler = self.sensor.sampler().clone()
        sampler.set_sample_count(count)
        return int(sampler.sample_count())

    def place(self, pixel: Any, sampler: Any) -> tuple[Any, Any]:
        """Return places in pixels that a sampler draws: on the film, and in the picture, [0, 1]²."""
        import mitsuba as mi

        border = float(self.border)
        across, down = self.width - 2 * border, self.height - 2 * border
        numbers = constants(width=self.width, border=border, across=across, down=down)
        row, column = numbers["width"].divide(pixel)
        place = mi.Point2f(mi.Float(column), mi.Float(row)) + sampler.next_2d()
        return place, (place - numbers["border"]) / mi.Vector2f(numbers["across"], numbers["down"])

    @cached_property
    def weights(self) -> np.ndarray:
        """Values of the filter along an axis, ``STEPS`` to a pixel, [2 reach + 1, STEPS]."""
        import mitsuba as mi

        places = np.arange(-self.reach, self.reach + 1)[:, None] + (np.arange(STEPS) + 0.5) / STEPS - 0.5
        rfilter, flat = self.sensor.film().rfilter(), places.ravel().tolist()
        if mi.variant().startswith("scalar"):
            values = [rfilter.eval(place) for place in flat]
        else:  # a list is copied; for NumPy's memory, Dr.Jit would compile a kernel for every alignment
            values = rfilter.eval(mi.Float(flat))
        return np.asarray(values, np.float64).reshape(places.shape)

    @cached_property
    def spread(self) -> np.ndarray:
        """Share that the rays of the pixels −reach to reach along an axis have in the variance of pixel 0."""
        share = np.square(self.weights).sum(axis=1)
        return np.float32(share / share.sum())

    @property
    def correlation(self) -> float:
        """Sum of the squared correlations of a pixel's error with those of all pixels, itself included."""
        values = self.weights.ravel()
        overlap = np.correlate(values, values, "full")[(len(values) - 1) % STEPS :: STEPS]
        return float(np.sum(np.square(overlap / overlap.max()))) ** 2

    @property
    def averaging(self) -> float:
        """Variance of a pixel over that of the mean of the rays that start in it."""
        along = np.square(self.weights).mean() / np.square(self.weights.mean())
        return float(along / len(self.weights)) ** 2

    def spread_out(self, variance: np.ndarray) -> np.ndarray:
        """Return the variance [..., H, W] of pixels, up to a factor, given that of the rays in each."""
        for axis in (-2, -1) if self.reach else ():
            padding = [(0, 0)] * variance.ndim
            padding[axis] = (self.reach, self.reach)
            wide = np.moveaxis(np.pad(variance, padding, mode="edge"), axis, 0)
            count = variance.shape[axis]
            total = self.spread[self.reach] * wide[self.reach : self.reach + count]
            for step in range(self.reach):  # filters are symmetric
                pair = wide[step : step + count] + wide[2 * self.reach - step :][:count]
                pair *= self.spread[step]
                total += pair
            variance = np.moveaxis(total, 0, axis)
        return variance


def spectral_bands(film: Any) -> tuple[str, ...]:
    """Return the names of a film's spectral bands, in its order; nothing for one that keeps colours."""
    import mitsuba as mi

    if not mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return ()
    film.prepare([])  # it knows its channels from then on
    return tuple(field.name for field in film.bitmap().struct_())


def pixel_format(film: Any) -> str:
    """Return the pixel format of a film as it prints it, "rgb" or "ya"; nothing for one without."""
    found = re.search(r"pixel_format = (\w+)", str(film))
    return found[1] if found else ""
