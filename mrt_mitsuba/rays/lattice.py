"""Where in a pixel the samples lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.rays.divisor import Divisor

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

    def offset(self, sample: Any, aa: Divisor) -> tuple[Any, Any]:
        """Return the place of a sample, given by its number, in its pixel: (x, y), y downwards."""
        import mitsuba as mi

        if self.kind == "centered" and self.holds_centre:
            # start from the middle one, so that sample 0 is the centre
            sample = (sample + self.count // 2) % self.count
        i, j = aa.divide(sample)
        n = mi.Float(aa.number)
        if self.kind == "report":
            return 0.5 + mi.Float(i) / n, 0.5 - mi.Float(j) / n
        return (mi.Float(i) + 0.5) / n, (mi.Float(j) + 0.5) / n


CENTRE = Lattice("report", 1)  # the pixel's centre alone
