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
from mrt_mitsuba.output.error import ErrorEstimate, Round, RoundPicture
from mrt_mitsuba.rendering.progress import Advance

log = logging.getLogger(__name__)

# Times the rays there are may be there after another round: the error is known better then. The first
# doubling of a lattice takes up to 4.2
GROWTH = 4.25
MARGIN = 0.97  # of the target to aim at: an estimate is as often too low as too high
SURE = 2.0  # times the target, the upper end of the error's interval may be
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

    def next(self, most: float, target: float | None) -> Chosen | None:
        """Return what to trace for an error, or for a mean of at most so many rays a pixel in all."""

    def cost(self, chosen: Chosen) -> int:
        """Return the number of rays that tracing takes."""

    def trace(self, chosen: Chosen, advance: Advance) -> None:
        """Trace and add rays."""

    def error(self) -> ErrorEstimate:
        """Return the estimated error of the picture."""

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], and the standard error and the rays of each pixel, [H, W]."""


def run_rounds(picture: Refinable[Chosen], pixels: int, goal: Goal, stage: Stage) -> list[Round]:
    """Trace rounds until the goal is reached or ``on_round`` returns False; return what each has found.

    Warns of a target that is not reached.
    """
    start, done, rays = time.perf_counter(), list[Round](), 0
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
            now, maps = done[-1], (np.asarray(values, np.float32) for values in picture.maps())
            if goal.on_round(RoundPicture(now.seconds, now.spp, now.rmse, *maps)) is False:
                return done
        chosen = _next(picture, goal, done[-1], error)
    _warn_unless_reached(goal, done[-1])
    return done


def _next(picture: Refinable[Chosen], goal: Goal, now: Round, error: ErrorEstimate) -> Chosen | None:
    target = goal.target or 0.0
    if error.rmse <= target and error.high <= SURE * target:
        return None
    most = min(goal.rays, GROWTH * now.spp)
    if goal.seconds is not None:
        most = min(most, now.spp * goal.seconds / now.seconds)
    if most < LEAST_GROWTH * now.spp:
        return None
    if error.rmse <= target:  # by chance, perhaps
        return picture.next(min(most, 2 * now.spp), None)
    return picture.next(most, None if goal.target is None else MARGIN * target)


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
