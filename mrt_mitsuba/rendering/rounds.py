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
LEAST = 2**18  # rays that a target takes at least: fewer do not show what is rare
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

    least: int  #: mean rays of a pixel that a target takes at least, in a small picture
    last: bool  #: was the last round decided?

    def next(self, most: float, rays: float, target: float | None) -> Chosen:
        """Return what to trace for an error, or for a mean of at most so many rays a pixel in all.

        ``most``: after this round, unless it is the last; ``rays``: after the last.
        """

    def cost(self, chosen: Chosen) -> int:
        """Return the number of rays that tracing takes."""

    def trace(self, chosen: Chosen, advance: Advance) -> None:
        """Trace and add rays."""

    def forecast(self) -> tuple[float, float]:
        """Return the expected error and the shape of its tail, by rays that are not in the picture; called
        once before ``next``."""

    def rmse(self) -> float:
        """Return the estimated error of the picture."""

    def error(self) -> ErrorEstimate:
        """Return the same with its interval."""

    def unfit(self) -> str:
        """Return what makes values unfit to estimate an error from, and where; nothing if none does."""

    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3], and the standard error and the rays of each pixel, [H, W]."""


def run_rounds(
    picture: Refinable[Chosen], pixels: int, goal: Goal, stage: Stage
) -> tuple[list[Round], ErrorEstimate]:
    """Trace rounds until the goal is reached or ``on_round`` returns False; return what each has found, and
    the error in the end.

    Warns of a target that is not reached, and of an error that cannot be trusted.
    """
    start, done, rays = time.perf_counter(), list[Round](), 0
    least, doubled = min(goal.rays, picture.least, LEAST / pixels) if goal.target else 0, 0
    chosen = picture.first()
    while cost := picture.cost(chosen):
        rays += cost
        with stage("rounds", cost, _message(done, goal, cost / pixels)) as advance:
            picture.trace(chosen, advance)
        now = Round(time.perf_counter() - start, rays / pixels, picture.rmse())
        done.append(now)
        log.info("round %d: %.1f rays a pixel, error %.3g", len(done), now.spp, now.rmse)
        if goal.on_round is not None:
            maps = (np.array(values, np.float32) for values in picture.maps())  # its own, to write into
            if goal.on_round(RoundPicture(now.seconds, now.spp, now.rmse, *maps)) is False:
                return done, picture.error()
        most = min(goal.rays, GROWTH * now.spp)
        if goal.seconds is not None:
            most = min(most, now.spp * goal.seconds / now.seconds)
        if picture.last or most < LEAST_GROWTH * now.spp:
            break
        forecast, tail = picture.forecast()
        if now.spp < least / LEAST_GROWTH:
            chosen = picture.next(min(most, least), goal.rays, None)
        elif goal.target is None or forecast > goal.target:
            chosen = picture.next(most, goal.rays, goal.target and MARGIN * goal.target)
        elif tail > DOUBTFUL and doubled < MORE:
            chosen, doubled = picture.next(min(most, 2 * now.spp), goal.rays, None), doubled + 1
        else:
            break
    error = picture.error()
    _warn(goal, done[-1], error, picture.unfit())
    return done, error


def _warn(goal: Goal, now: Round, error: ErrorEstimate, unfit: str) -> None:
    """Warn of all that makes the error another than was asked for, or one not to be trusted."""
    found = [unfit] if unfit else []
    if error.tail > DOUBTFUL:
        found.append(
            f"a few rays rule the error of {error.rmse:.3g}, and it may be larger by any amount: the tail of "
            f"what rays contribute has a Pareto shape of {error.tail:.2g}, above {DOUBTFUL}. What helps: "
            "another integrator, larger lamps or rougher materials where such rays come from, or more rays"
        )
    if goal.target is not None and now.rmse > goal.target:
        spent = f"an error of {now.rmse:.3g}, after {now.spp:.1f} rays a pixel and {now.seconds:.1f} s"
        late = goal.seconds is not None and now.spp * goal.seconds < LEAST_GROWTH * now.spp * now.seconds
        if late or now.spp * LEAST_GROWTH > goal.rays:
            limit = f"maxseconds={goal.seconds:g}" if late else f"maxspp={goal.rays}"
            found.append(f"target={goal.target:g} is not reached: {limit} ends the render at {spent}")
        elif error.low > goal.target:
            found.append(
                f"target={goal.target:g} is missed by {spent}: rays that are not in the picture decide when "
                "to stop, and met less noise. A smaller target helps"
            )
    if found:
        warnings.warn("; ".join(found), MrtWarning, stacklevel=8)  # the caller of render


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
