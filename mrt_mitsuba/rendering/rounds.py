"""Rounds of rays, until a picture is as good as was asked for."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from mrt_mitsuba.errors import MrtWarning
from mrt_mitsuba.output.error import DOUBTFUL, ErrorEstimate, Round, RoundPicture
from mrt_mitsuba.rendering.progress import Advance

log = logging.getLogger(__name__)

# Times the rays there are may be there after another round: the error is known better then. The first
# doubling of a lattice takes up to 4.2
GROWTH = 4.25
MARGIN = 0.95  # of the target to aim at: a forecast is as often too low as too high
MORE = 2  # times the rays are doubled where the tail of their values is in doubt
LEAST_GROWTH = 1.05  # fewer rays, and a round costs more than it brings

OnRound = Callable[[RoundPicture], object]
Stage = Callable[[str, int, str], AbstractContextManager[Advance]]
Chosen = TypeVar("Chosen")


@dataclass(frozen=True)
class Goal:
    """When to stop: at an error, or at a number of rays, or when the time is up."""

    target: float | None  #: RMSE, linear; None for a number of rays
    rays: int  #: mean of a pixel: to spend, or at most with a target
    seconds: float | None = None  #: at most
    on_round: OnRound | None = None  #: called after each round; False stops


class Refinable(Protocol[Chosen]):
    """A picture in the making that knows its error, and where further rays are worth most."""

    def first(self) -> Chosen:
        """Return what to trace in the first round."""

    last: bool  #: was the last round decided?

    def next(self, most: float, rays: float, target: float | None) -> Chosen | None:
        """Return what to trace for an error, or for a mean of at most so many rays a pixel in all.

        ``most``: after this round, unless it is the last; ``rays``: after the last.
        """

    def cost(self, chosen: Chosen) -> int:
        """Return the number of rays that tracing takes."""

    def trace(self, chosen: Chosen, advance: Advance) -> None:
        """Trace and add rays."""

    def forecast(self) -> tuple[float, float]:
        """Return the expected error and the shape of its tail, by rays that are not in the picture."""

    def error(self) -> ErrorEstimate:
        """Return the estimated error of the picture."""

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], and the standard error and the rays of each pixel, [H, W]."""


def run_rounds(picture: Refinable[Chosen], pixels: int, goal: Goal, stage: Stage) -> list[Round]:
    """Trace rounds until the goal is reached or ``on_round`` returns False; return what each has found.

    Warns of a target that is not reached.
    """
    start, done, rays = time.perf_counter(), list[Round](), 0
    doubled: list[float] = []  # rays a pixel where a heavy tail had more rays traced
    chosen: Chosen | None = picture.first()
    while chosen is not None:
        cost = picture.cost(chosen)
        rays += cost
        with stage("rounds", cost, _message(done, goal, cost / pixels)) as advance:
            picture.trace(chosen, advance)
        error = picture.error()
        done.append(Round(time.perf_counter() - start, rays / pixels, error.rmse))
        log.info("round %d: %.1f rays a pixel, error %.3g", len(done), done[-1].spp, done[-1].rmse)
        if goal.on_round is not None:
            now, maps = done[-1], (np.array(values, np.float32) for values in picture.maps())
            if goal.on_round(RoundPicture(now.seconds, now.spp, now.rmse, *maps)) is False:
                return done
        chosen = _next(picture, goal, done[-1], doubled)
    _warn_unless_reached(goal, done[-1])
    return done


def _next(picture: Refinable[Chosen], goal: Goal, now: Round, doubled: list[float]) -> Chosen | None:
    """Return what to trace next: for the target, until a forecast has it; then twice more, if in doubt."""
    if picture.last:
        return None
    target, (rmse, tail) = goal.target or 0.0, picture.forecast()
    most = min(goal.rays, GROWTH * now.spp)
    if goal.seconds is not None:
        most = min(most, now.spp * goal.seconds / now.seconds)
    if most < LEAST_GROWTH * now.spp:
        return None
    if rmse > target:
        return picture.next(most, goal.rays, goal.target and MARGIN * target)
    if tail <= DOUBTFUL or len(doubled) == MORE:
        return None
    doubled.append(now.spp)
    return picture.next(min(most, 2 * now.spp), goal.rays, None)


def _warn_unless_reached(goal: Goal, now: Round) -> None:
    if goal.target is None or now.rmse <= goal.target:
        return
    late = goal.seconds is not None and now.spp * goal.seconds < LEAST_GROWTH * now.spp * now.seconds
    limit = f"maxseconds={goal.seconds:g}" if late else f"maxspp={goal.rays}"
    warnings.warn(
        f"target={goal.target:g} is not reached: {limit} ends the render at an error of {now.rmse:.3g}, "
        f"after {now.spp:.1f} rays a pixel and {now.seconds:.1f} s",
        MrtWarning,
        stacklevel=8,  # the caller of render
    )


def _message(done: list[Round], goal: Goal, more: float) -> str:
    """Return where a render stands before a round of so many rays a pixel."""
    if not done:
        return ""
    aim = "" if goal.target is None else f" → {_two_digits(goal.target)}"
    now = done[-1]
    return f"error {_two_digits(now.rmse)}{aim}, {now.seconds:.0f} s, {more:.1f} rays a pixel more"


def _two_digits(error: float) -> str:
    """Return an error with as many digits as are known of it, such as 0.010."""
    return f"{error:#.2g}" if error < 10 else f"{error:.0f}"
