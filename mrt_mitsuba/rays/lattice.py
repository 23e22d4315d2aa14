"""Where in a pixel the samples of a lattice lie, and when their rays start."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.rays.divisor import constants

FILM = "film"
LATTICES = ("report", "centered", FILM)


@dataclass(frozen=True)
class Lattice:
    """A grid of aa × aa samples in a pixel.

    ``report``: sample (i, j) is at (0.5 + i/aa, 0.5 + j/aa), y upwards, as in the original. Sample 0 is the
    pixel's centre and the others reach into the next pixels, which shifts the picture by up to half a pixel.
    ``centered``: samples are the centres of aa × aa equal cells.
    ``film``: no grid, but aa × aa places that the sampler of a scene draws, see ``rays.film``.
    """

    kind: str
    aa: int

    @property
    def count(self) -> int:
        """Samples in a pixel."""
        return self.aa**2

    @property
    def holds_centre(self) -> bool:
        """Return whether the pixel's centre is one of the samples; it then comes first."""
        return self.kind == "report" or (self.kind == "centered" and self.aa % 2 == 1)


CENTRE = Lattice("report", 1)  # the pixel's centre alone


@dataclass(frozen=True)
class Places:
    """Samples ``first`` to ``first + count − 1`` of a lattice in each pixel, each traced ``repeats`` times.

    The shutter is open from time 0 to 1, which is divided into ``moments`` equal parts; successive rays of a
    pixel go to different parts, far from each other, so that place and time do not correlate. ``phase`` says
    where in its part a ray is, 0 to 1. None stands for a random place, the same for all rays of a pixel and
    another for the next pixel, which turns steps into noise.
    """

    lattice: Lattice
    first: int = 0
    count: int = 1
    repeats: int = 1
    moments: int = 0  #: 0: all rays start at time 0
    phase: float | None = 0.0
    seed: int = 0  #: of random phases

    @property
    def size(self) -> int:
        """Number of rays of a pixel."""
        return self.count * self.repeats

    def numbers(self, width: int, height: int) -> dict[str, Any]:
        """Return what ``at`` needs to know of the places, in a picture of this size."""
        # parts of the time from one ray to the next: coprime to their number, near its golden section
        golden = round(self.moments * (math.sqrt(5) - 1) / 2)
        stride = next(s for s in range(max(golden, 1), self.moments + 2) if math.gcd(s, self.moments) <= 1)
        numbers = {"width": width, "height": height, "repeats": self.repeats, "first": self.first}
        time = {"moments": self.moments, "stride": stride, "seed": self.seed, "phase": self.phase or 0.0}
        return constants(aa=self.lattice.aa, **numbers, **(time if self.moments else {}))

    def at(self, pixel: Any, ray: Any, numbers: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return where and when a ray of a pixel starts: its place in the picture, [0, 1]², x to the right
        and y down, and its time."""
        import mitsuba as mi

        row, column = numbers["width"].divide(pixel)
        x, y = self._offset(numbers["repeats"].divide(ray)[0] + numbers["first"].number, numbers["aa"])
        place = mi.Point2f(
            (mi.Float(column) + x) / mi.Float(numbers["width"].number),
            (mi.Float(row) + y) / mi.Float(numbers["height"].number),
        )
        if not self.moments:
            return place, mi.Float(0)
        moments, stride = (mi.UInt64(numbers[name].number) for name in ("moments", "stride"))
        phase = numbers["phase"]
        if self.phase is None:
            phase = mi.sample_tea_float32(pixel, numbers["seed"].number)
        return place, (mi.Float(mi.UInt64(ray) * stride % moments) + phase) / mi.Float(moments)

    def _offset(self, sample: Any, aa: Any) -> tuple[Any, Any]:
        """Return the place of a sample, given by its number, in its pixel: (x, y), y downwards."""
        import mitsuba as mi

        lattice = self.lattice
        if lattice.kind == "centered" and lattice.holds_centre:
            # start from the middle one, so that sample 0 is the centre
            sample = (sample + lattice.count // 2) % lattice.count
        i, j = aa.divide(sample)
        n = mi.Float(aa.number)
        if lattice.kind == "report":
            return 0.5 + mi.Float(i) / n, 0.5 - mi.Float(j) / n
        return (mi.Float(i) + 0.5) / n, (mi.Float(j) + 0.5) / n
