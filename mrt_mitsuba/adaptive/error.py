"""Estimates that a render makes of its own error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrt_mitsuba.adaptive.metric import LINEAR


@dataclass(frozen=True)
class ErrorEstimate:
    """The RMSE of a picture to the converged one, over pixels and colours, with a 95 % interval."""

    rmse: float
    low: float
    high: float  #: infinite where the tail is too heavy to tell
    tail: float = 0.0  #: Pareto shape k of the largest contributions of rays, see ``PARETO_K_THRESHOLD``
    target: float | None = None  #: RMSE that the render aimed at; None without a target
    metric: str = LINEAR.name  #: of all of these: "linear", "relative" or "display"

    def __str__(self) -> str:
        metric = "" if self.metric == LINEAR.name else f" {self.metric}"
        return f"{self.rmse:.3g}{metric} (95 %: {self.low:.3g} to {self.high:.3g})"

    def __repr__(self) -> str:
        target = "" if self.target is None else f", target {self.target:.3g}"
        return f"ErrorEstimate({self}{target}, tail {self.tail:.2g})"


@dataclass(frozen=True)
class Round:
    """The state of a render after a round: one point of error against time."""

    seconds: float  #: since the render began
    spp: float  #: mean rays of a pixel
    rmse: float  #: estimated, see ``ErrorEstimate``

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.seconds:.2f} s, {self.spp:.1f} spp, error {self.rmse:.3g})"


@dataclass(frozen=True, repr=False)
class RoundPicture(Round):
    """A round with its picture, as ``on_round`` gets it."""

    image: np.ndarray  #: float32 [H, W, 3], linear
    error: np.ndarray  #: standard error of each pixel, [H, W]
    samples: np.ndarray  #: rays of each pixel, [H, W]
    target: float | None = None  #: RMSE that the render aims at
