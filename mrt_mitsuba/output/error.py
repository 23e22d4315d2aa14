"""Estimates that a render makes of its own error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image = NDArray[np.float32]


@dataclass(frozen=True)
class ErrorEstimate:
    """The RMSE of a picture to the converged one, linear, over pixels and colours, with a 95 % interval."""

    rmse: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.rmse:.3g} (95 %: {self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class Round:
    """The state of a render after a round: a point of its error over its time."""

    seconds: float  #: since the render began
    spp: float  #: mean rays of a pixel
    rmse: float  #: estimated, see ``ErrorEstimate``


@dataclass(frozen=True)
class RoundPicture(Round):
    """A round with its picture, as ``on_round`` gets it."""

    image: Image  #: [H, W, 3], linear
    error: Image  #: standard error of each pixel, [H, W]
    samples: Image  #: rays of each pixel, [H, W]
