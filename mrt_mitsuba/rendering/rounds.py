"""Rounds of rays, until a picture is as good as was asked for."""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mrt_mitsuba.errors import MrtWarning
from mrt_mitsuba.output.error import DOUBTFUL, ErrorEstimate, Round, RoundPicture
from mrt_mitsuba.rendering.progress import Advance
from mrt_mitsuba.target import Goal

if TYPE_CHECKING:
    from mrt_mitsuba.rendering.noise import Forecast, Halves

log = logging.getLogger(__name__)

GROWTH = 4.25  # times the rays there are may be there after another round: the error is known better then
LEAST = 2**18  # rays that a target takes at least: fewer do not show what is rare
LEAST_EVEN = 2**17  # where noise is even: fewer may miss what is rare in a small picture
MORE = 2  # times the rays are doubled where the tail of their values is in doubt
EVEN = 0.25  # of the mean deviation is the least that a pixel is given rays for, until there are as many
NEAR = 1.05  # times a target is an error that reaches it, as far as it is known
LEAST_GROWTH = 1.05  # fewer rays, and a round costs more than it brings

OnRound = Callable[[RoundPicture], object]
Stage = Callable[[str, int, str], AbstractContextManager[Advance]]


def run_rounds(
    picture: Halves, stage: Stage, goal: Goal, on_round: OnRound | None = None
) -> tuple[list[Round], ErrorEstimate]:
    """Trace rounds until a goal is reached; return what each has found, and the error in the end.

    Warns of a target that is not reached, and of an error that cannot be trusted. ``on_round`` is called
    after each round, and stops by returning False.
    """
    start = time.perf_counter()
    done = list[Round]()
    spent = 0
    pixels = picture.film.pixels
    rays = goal.most
    seconds = goal.seconds
    asked = goal.target
    target: float | None = None
    doubled = 0
    chosen = picture.first()
    stopped = False
    while cost := picture.cost(chosen):
        spent += cost
        with stage("rounds", cost, _message(done, target, cost / pixels)) as advance:
            picture.trace(chosen, advance)
        rmse = math.sqrt(float(picture.squares().mean()))
        now = Round(time.perf_counter() - start, spent / pixels, rmse)
        done.append(now)
        if asked and target is None:
            target = asked.rmse(picture.luminance())
        log.info("round %d: %.1f rays a pixel, error %.3g", len(done), now.spp, now.rmse)
        stopped = on_round is not None and on_round(_shown(now, picture, target)) is False
        if stopped or target == 0:
            break
        most = min(rays, GROWTH * now.spp)
        if seconds is not None:
            most = min(most, now.spp * seconds / now.seconds)
        if picture.last or most < LEAST_GROWTH * now.spp:
            break
        # not asked for where all rays that are left are spent at once, whatever it says
        forecast = picture.forecast() if target or most < rays else None
        aim = target and picture.margin * max(target, 1e-100)
        least = _least(picture, forecast, rays) if forecast and target else 0
        if now.spp < 0.9 * least:  # shares are rounded
            chosen = picture.next(forecast, min(most, least), rays, even=EVEN)
        elif forecast is None or target is None or forecast.rmse > target:
            chosen = picture.next(forecast, most, rays, aim)
        elif forecast.tail > DOUBTFUL and doubled < MORE:
            chosen = picture.next(forecast, min(most, 2 * now.spp), rays)
            doubled += 1
        else:  # the halves know better what is missing, if anything
            chosen = picture.next(None, most, most, aim)
    error = replace(picture.error(), target=target)
    found = [picture.unfit(), _doubt(error), "" if stopped else _missed(goal, now, error)]
    if any(found):
        warnings.warn("; ".join(filter(None, found)), MrtWarning, stacklevel=7)  # the caller of render
    return done, error


def _least(picture: Halves, forecast: Forecast, rays: float) -> float:
    """The mean rays of a pixel that a target takes at least."""
    least = LEAST_EVEN if forecast.even else LEAST
    return min(rays, picture.least, least / picture.film.pixels)


def _shown(now: Round, picture: Halves, target: float | None) -> RoundPicture:
    """A round with copies of its picture, its error and its rays."""
    with np.errstate(over="ignore"):  # of errors beyond float32
        image, deviation, samples = (np.array(values, np.float32) for values in picture.maps())
    return RoundPicture(now.seconds, now.spp, now.rmse, image, deviation, samples, target)


def _doubt(error: ErrorEstimate) -> str:
    """Return what makes an error one not to be trusted; nothing if nothing does."""
    if error.tail <= DOUBTFUL:
        return ""
    return (
        f"a few rays rule the error of {error.rmse:.3g}, and it may be larger by any amount: the tail of "
        f"what rays contribute has a Pareto shape of {error.tail:.2g}, above {DOUBTFUL}. What helps: "
        "another integrator, larger lamps or rougher materials where such rays come from, or more rays"
    )


def _missed(goal: Goal, now: Round, error: ErrorEstimate) -> str:
    """Return why an error is larger than was asked for; nothing if it is not."""
    target, rays, seconds = error.target, goal.most, goal.seconds
    if target == 0:
        return (
            f"target={goal.target}: the picture is black, as far as pilot rays have met it, and so a share "
            "of its mean luminance is 0; the render ends. Give a number, such as target=0.01"
        )
    if goal.target is None or target is None or now.rmse <= target:
        return ""
    asked = f"target={goal.target}, which is {target:.3g}," if goal.target.relative else f"target={target:g}"
    spent = f"an error of {now.rmse:.3g}, after {now.spp:.1f} rays a pixel and {now.seconds:.1f} s"
    late = seconds is not None and seconds < LEAST_GROWTH * now.seconds
    if late or now.spp * LEAST_GROWTH > rays:
        limit = f"maxseconds={seconds:g}" if late else f"maxspp={rays}"
        return f"{asked} is not reached: {limit} ends the render at {spent}"
    if now.rmse <= NEAR * target:
        return ""
    return (
        f"{asked} is missed by {spent}: rays that are not in the picture decide when to stop, and "
        "met less noise. A smaller target helps"
    )


def _message(done: list[Round], target: float | None, more: float) -> str:
    """Return where a render stands before a round of so many rays a pixel."""
    if not done:
        return ""
    now = done[-1]
    aim = left = ""
    if target:
        aim = f" → {target:.2g}"
        seconds = now.seconds * max(min(now.rmse / target, 1e6) ** 2 - 1, 0)  # squares fall as time goes by
        left = f", about {seconds:.0f} s left" if seconds < 1e6 else ""
    return f"error {now.rmse:.2g}{aim}, {now.seconds:.0f} s{left}, {more:.1f} rays a pixel more"
