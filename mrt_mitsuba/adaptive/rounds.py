"""Rounds of rays, until a picture is as good as was asked for."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mrt_mitsuba.adaptive.error import DOUBTFUL, ErrorEstimate, Round, RoundPicture
from mrt_mitsuba.adaptive.noise import estimate
from mrt_mitsuba.adaptive.target import Goal
from mrt_mitsuba.errors import warn
from mrt_mitsuba.rendering.progress import Advance

if TYPE_CHECKING:
    from mrt_mitsuba.adaptive.noise import Forecast, Noise, State

log = logging.getLogger(__name__)

GROWTH = 4.25  # times the rays there are may be there after another round: the error is known better then
LEAST = 2**18  # rays that a target takes at least: fewer do not show what is rare
LEAST_EVEN = 2**17  # where noise is even: fewer may miss what is rare in a small picture
MORE = 2  # times the rays are doubled where the tail of their values is in doubt
EVEN = 0.25  # of the mean deviation is the least that a pixel is given rays for, until there are as many
SHY = 0.85  # of the rays that a target seems to want, until there are as many
NEAR = 1.05  # times a target is an error that reaches it, as far as it is known
RARE = 0.92  # of the target is aimed at where rare rays may rule: some of them are not met yet
LEAST_GROWTH = 1.05  # fewer rays, and a round costs more than it brings

OnRound = Callable[[RoundPicture], object]
Stage = Callable[[str, int, str], AbstractContextManager[Advance]]


class Finished(NamedTuple):
    """What rounds came to."""

    rounds: list[Round]
    state: State
    error: ErrorEstimate


class Next(NamedTuple):
    """What a further round traces."""

    chosen: np.ndarray  #: numbers of groups, see ``Noise``
    last: bool  #: halves have decided for each other, and so no other round may follow
    doubled: int = 0  #: times that rays were doubled in doubt


def run_rounds(noise: Noise, stage: Stage, goal: Goal, on_round: OnRound | None = None) -> Finished:
    """Trace rounds until a goal is reached.

    Warns of a target that is not reached, and of an error that cannot be trusted. ``on_round`` is called
    after each round, and stops by returning False.
    """
    start = time.perf_counter()
    done = list[Round]()
    spent = 0
    pixels = noise.film.pixels
    target: float | None = None
    stopped = False
    state = noise.blank()
    following = Next(noise.begin, last=False)
    while cost := noise.cost(following.chosen):
        spent += cost
        with stage("rounds", cost, _message(done, target, cost / pixels)) as advance:
            state = noise.trace(state, following.chosen, advance)
        rmse = math.sqrt(float(state.squares(noise.blurred).mean()))
        now = Round(time.perf_counter() - start, spent / pixels, rmse)
        done.append(now)
        if goal.target and target is None:
            target = goal.target.rmse(state.luminance())
        log.info("round %d: %.1f rays a pixel, error %.3g", len(done), now.spp, now.rmse)
        stopped = on_round is not None and on_round(_shown(now, noise, state, target)) is False
        if stopped or target == 0 or following.last:
            break
        most = min(goal.most, GROWTH * now.spp)
        if goal.seconds is not None:
            most = min(most, now.spp * goal.seconds / now.seconds)
        if most < LEAST_GROWTH * now.spp:
            break
        following = _next(noise, state, now.spp, most, goal.most, target, following)
    error = replace(estimate(noise, state), target=target)
    found = [state.unfit_rays(), _doubt(error), "" if stopped else _missed(goal, now, error)]
    if any(found):
        warn("; ".join(filter(None, found)))
    return Finished(done, state, error)


def _next(
    noise: Noise, state: State, spp: float, most: float, rays: float, target: float | None, before: Next
) -> Next:
    """What to trace after ``spp`` rays a pixel, of which there may be ``most`` after the next round, and
    ``rays`` in the end."""
    if target is None and most >= rays:
        return Next(noise.last_shares(state, rays, None), last=True)
    forecast = noise.forecast(state)
    margin = noise.margin * (RARE if forecast.rare else 1)
    aim = None if target is None else margin * max(target, 1e-100)
    wanted = rays if aim is None else noise.wanted(state, forecast, aim)
    least = 0.0 if aim is None else _least(noise, forecast, rays)
    even = 0.0
    doubled = before.doubled
    if spp < 0.9 * least:  # shares are rounded
        most = min(most, max(least, SHY * wanted))
        aim = None
        even = EVEN
    elif target is not None and forecast.rmse <= target:
        if forecast.tail <= DOUBTFUL or doubled == MORE:  # the halves know what is missing, if anything
            return Next(noise.last_shares(state, most, aim), last=True)
        most = min(most, 2 * spp)
        doubled += 1
        aim = None
    elif wanted <= most:
        return Next(noise.last_shares(state, rays, aim), last=True)
    elif aim is not None:  # no more than it takes where variance falls as fast as it may
        most = min(most, spp * (wanted / spp) ** (1 / (1 + noise.gain)))
    if most >= rays:
        return Next(noise.last_shares(state, rays, aim), last=True)
    return Next(noise.shares(state, forecast, most, even), False, doubled)


def _least(noise: Noise, forecast: Forecast, rays: float) -> float:
    """The mean rays of a pixel that a target takes at least."""
    least = LEAST_EVEN if forecast.even else LEAST
    return min(rays, noise.least, least / noise.film.pixels)


def _shown(now: Round, noise: Noise, state: State, target: float | None) -> RoundPicture:
    """A round with copies of its picture, its error and its rays."""
    image = state.image()[..., :3]
    if noise.blurred is not None:
        image = noise.blurred(image)
    deviation = np.sqrt(noise.variance(state).mean(-1))
    with np.errstate(over="ignore"):  # of errors beyond float32
        return RoundPicture(
            seconds=now.seconds,
            spp=now.spp,
            rmse=now.rmse,
            image=np.array(image, np.float32),
            error=deviation.astype(np.float32),
            samples=np.array(state.samples(), np.float32),
            target=target,
        )


def _doubt(error: ErrorEstimate) -> str:
    """What makes an error one not to be trusted; nothing if nothing does."""
    if error.tail <= DOUBTFUL:
        return ""
    return (
        f"a few rays rule the error of {error.rmse:.3g}, and it may be larger by any amount: the tail of "
        f"what rays contribute has a Pareto shape of {error.tail:.2g}, above {DOUBTFUL}. What helps: "
        "another integrator, larger lamps or rougher materials where such rays come from, or more rays"
    )


def _missed(goal: Goal, now: Round, error: ErrorEstimate) -> str:
    """Why an error is larger than was asked for; nothing if it is not."""
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
    """Where a render stands before a round of so many rays a pixel."""
    if not done:
        return ""
    now = done[-1]
    aim = left = ""
    if target:
        aim = f" → {target:.2g}"
        seconds = now.seconds * max(min(now.rmse / target, 1e6) ** 2 - 1, 0)  # squares fall as time goes by
        left = f", about {seconds:.0f} s left" if seconds < 1e6 else ""
    return f"error {now.rmse:.2g}{aim}{left}, {now.spp:.0f} rays a pixel, now {more:.0f} more"
