"""The time while the shutter is open: how it is divided into frames, and what is traced for each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.rays.bundle import Bundle
from mrt_mitsuba.rays.lattice import CENTRE, Lattice
from mrt_mitsuba.rays.shutter import Shutter


@dataclass(frozen=True)
class Exposure:
    """The rays of one picture while the shutter is open."""

    samples: Lattice
    repeats: int  #: rays for each sample
    motion: str | None  #: "frames", "stratified", or None where the camera stands still
    moments: int  #: of the whole time
    seed: int
    frame: int | None = None  #: number of the only moment that is seen, or None for all of them

    def lattice(self, pixels: Any, *, first: int = 0) -> Bundle:
        """Return the lattice's samples from ``first`` on."""
        count, repeats, shutter = self.samples.count - first, self.repeats * self._moments, self._shutter
        if self.motion == "stratified":
            # every ray of a pixel in a part of its own
            repeats = self.repeats * math.ceil(self.moments / (count * self.repeats))
            shutter = Shutter(count * repeats, seed=self.seed)
        return Bundle(pixels, self.samples, first, count, repeats, shutter)

    def centre(self, pixels: Any) -> Bundle:
        """Return the pixel's centre alone, at the same times in every pixel: a detector must see no noise."""
        return Bundle(pixels, CENTRE, repeats=self.repeats * self._moments, shutter=self._shutter)

    def first_hit(self, pixels: Any) -> Bundle:
        """Return the pixel's centre when the shutter opens, or at the moment of the frame."""
        shutter = None if self.motion is None else Shutter(1, (self.frame or 0) / self.moments)
        return Bundle(pixels, CENTRE, shutter=shutter)

    @property
    def rays_per_pixel(self) -> int:
        """Rays of a pixel in the pass that traces the most."""
        return self.lattice(range(0)).rays_per_pixel

    @property
    def _moments(self) -> int:
        return self.moments if self.frame is None else 1

    @property
    def _shutter(self) -> Shutter | None:
        if self.motion is None:
            return None
        if self.frame is not None:
            return Shutter(1, self.frame / self.moments)
        return Shutter(self._moments, 0.0 if self.motion == "frames" else 0.5)
