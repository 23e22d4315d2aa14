"""Rounds of rays, until a picture is as good as was asked for."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from mrt_mitsuba.adaptive.allocate import Allocator
from mrt_mitsuba.adaptive.denoise import Denoiser, cautious_error
from mrt_mitsuba.adaptive.error import ErrorEstimate, Round, RoundPicture
from mrt_mitsuba.adaptive.estimate import (
    Blurred,
    PilotEstimate,
    SampleStatistics,
    estimate_error,
    pilot_estimate,
    pixel_error,
    pixel_variance,
)
from mrt_mitsuba.adaptive.metric import LINEAR, METRICS
from mrt_mitsuba.adaptive.tails import PARETO_K_THRESHOLD
from mrt_mitsuba.adaptive.target import Goal
from mrt_mitsuba.errors import warn
from mrt_mitsuba.filters.denoising import Denoised
from mrt_mitsuba.plugins import plugin
from mrt_mitsuba.rendering.exposing import Exposer, RayBatch, film_samples
from mrt_mitsuba.rendering.progress import Advance

log = logging.getLogger(__name__)

GROWTH = 4.25  # maximum growth of the ray count per round: the error is known better then
MIN_GROWTH = 1.05  # minimum growth for which another round pays off
MIN_RAYS = 2**17  # of a picture with a target: fewer do not show what is rare
ENOUGH = 0.9  # fraction of them that counts as all, as allocations are rounded
MIN_RELATIVE_DEVIATION = 0.25  # fraction of the mean deviation that each pixel has, until there are MIN_RAYS
FIRST_GAIN = 1.0  # of rays that go where noise is, after an even first round; see ``gain`` of samplers
SAFETY = 1.5  # standard errors of the RMSE below the target, so that few pictures exceed it

OnRound = Callable[[RoundPicture], object]
Stage = Callable[[str, int, str], AbstractContextManager[Advance]]


class Finished(NamedTuple):
    """Result of the adaptive rounds."""

    rounds: list[Round]
    stats: SampleStatistics
    error: ErrorEstimate
    denoised: Denoised | None  #: None where it was not asked for, or left out


class Tracer:
    """Traces the rays of allocations, and adds their values up in four buffers."""

    def __init__(self, exposer: Exposer, seed: int) -> None:
        samplers = plugin("samplers", "mrt_mitsuba.adaptive")
        self.film = exposer.film
        self.sampler = mi.load_dict({"type": samplers.ADAPTIVE})
        self.allocator = Allocator(self.film, self.sampler, seed)
        self.initial_allocation = np.ones((4, self.film.pixels), np.int64)
        self._exposer = exposer
        self._seed = seed

    def cost(self, allocation: np.ndarray) -> int:
        """Number of rays that an allocation traces."""
        return self.sampler.group * int(self.allocator.traced(allocation).sum())

    def blank(self, metric: str) -> SampleStatistics:
        """Statistics before any ray is traced."""
        return SampleStatistics.blank(self.film, len(self._exposer.names), METRICS[metric])

    def trace(self, stats: SampleStatistics, allocation: np.ndarray, advance: Advance) -> SampleStatistics:
        """Return statistics with the rays of an allocation."""
        groups = RayBatch.from_counts(self.sampler.group, self.allocator.traced(allocation), stats.count)
        samples = film_samples(self.film, self._seed, self.sampler)
        exposed = self._exposer.expose(groups, samples, pictures=4, moments=True, advance=advance)
        total, peak = exposed.total, exposed.peak
        square = exposed.square.mean(0)
        invalid, worst = stats.invalid, stats.worst_invalid
        new = ~np.isfinite(square)
        if new.any():
            invalid = invalid | new.any(0)
            largest = total[:, new].max()
            worst = float(peak[new].max() if np.isfinite(largest) else largest)
            for values in (*total, square, peak):
                values[new] = 0
        pilots = stats.pilots
        with np.errstate(invalid="ignore"):
            halves = stats.halves.accumulate(exposed, allocation[:2] > 0)
            if pilots is not None:
                pilots = pilots.accumulate(exposed, allocation[2:] > 0, first=2)
        return SampleStatistics(
            metric=stats.metric,
            count=stats.count + exposed.rays.reshape(stats.count.shape),
            sum=stats.sum + total,
            sum_sq=stats.sum_sq + square,
            max_ray_value=np.maximum(stats.max_ray_value, peak),
            halves=halves,
            pilots=pilots,
            invalid=invalid,
            worst_invalid=worst,
        )


def run_rounds(
    tracer: Tracer,
    stage: Stage,
    goal: Goal,
    blurred: Blurred | None = None,
    on_round: OnRound | None = None,
    denoiser: Denoiser | None = None,
) -> Finished:
    """Trace rounds until a goal is reached.

    Warns of a target that is not reached, and of an error that cannot be trusted. ``blurred``: what is done
    to the picture in the end, after which errors are estimated. ``on_round`` is called after each round, and
    stops by returning False. With a ``denoiser``, errors are those of the picture that it mixes.
    """
    start = time.perf_counter()
    done = list[Round]()
    denoised: Denoised | None = None
    spent = 0
    pixels = tracer.film.pixels
    target: float | None = None
    stopped = False
    stats = tracer.blank(goal.metric)
    allocation: np.ndarray | None = tracer.initial_allocation
    while allocation is not None and (cost := tracer.cost(allocation)):
        spent += cost
        with stage("rounds", cost, _message(done, target, cost / pixels)) as advance:
            stats = tracer.trace(stats, allocation, advance)
        if goal.target and target is None:
            target = goal.target.rmse(stats.metric.reference or stats.luminance())
        plain = math.sqrt(float(stats.squared_errors(stats.metric, blurred).mean(-1).mean()))
        denoised = None
        enough = spent >= ENOUGH * min(MIN_RAYS, goal.max_spp * pixels)
        if denoiser and target and enough and denoiser.pays(spent / pixels, plain, target):
            denoised = denoiser.mixture(stats, plain)
        rmse = plain if denoised is None else denoised.rmse
        now = Round(time.perf_counter() - start, spent / pixels, rmse)
        done.append(now)
        log.info("round %d: %.1f spp, error %.3g", len(done), now.spp, now.rmse)
        stopped = on_round is not None and on_round(_shown(now, stats, target, blurred, denoised)) is False
        if stopped or target == 0 or (denoised and target and cautious_error(denoised) <= target):
            break
        wanted = target
        if denoiser and target:
            wanted = denoiser.plain_target(now.spp, plain, target)
        now = replace(now, rmse=plain)
        allocation = plan_round(tracer.allocator, stats, goal, wanted, now)
    if denoiser and denoised is None and not denoiser.left_out and target != 0:
        denoised = denoiser.mixture(stats, plain)
        done[-1] = replace(now, rmse=denoised.rmse, seconds=time.perf_counter() - start)
    error = replace(_final_error(stats, blurred, denoised), target=target)
    missed = "" if stopped else _target_warning(goal, done[-1], target)
    warnings = "; ".join(filter(None, [stats.invalid_warning(), _tail_warning(error), missed]))
    if warnings:
        warn(warnings)
    return Finished(done, stats, error, denoised)


def _final_error(
    stats: SampleStatistics, blurred: Blurred | None, denoised: Denoised | None
) -> ErrorEstimate:
    """Return the error of the picture, or of the one that a denoiser mixes."""
    error = estimate_error(stats, blurred)
    if denoised is None:
        return error
    high = denoised.high if error.tail <= PARETO_K_THRESHOLD else math.inf
    return replace(error, rmse=denoised.rmse, low=denoised.low, high=high)


def plan_round(
    allocator: Allocator, stats: SampleStatistics, goal: Goal, target: float | None, now: Round
) -> np.ndarray | None:
    """Return the allocation of a round after ``now``, or None if the goal is reached."""
    most = min(goal.max_spp, GROWTH * now.spp)
    if goal.max_seconds is not None:
        most = min(most, now.spp * goal.max_seconds / now.seconds)
    if most < MIN_GROWTH * now.spp:
        return None
    seen = pilot_estimate(stats)
    if target is None:
        return allocator.allocate(stats, seen, most)
    minimum = min(MIN_RAYS / stats.film.pixels, goal.max_spp)
    if now.spp < ENOUGH * minimum:
        return allocator.allocate(stats, seen, min(most, minimum), MIN_RELATIVE_DEVIATION)
    caution = 1 + SAFETY * seen.uncertainty
    if caution * now.rmse <= target:
        return None
    gain = allocator.gain if np.ptp(stats.count) else FIRST_GAIN
    excess = min(caution * now.rmse / target, GROWTH**2)  # no power overflows
    growth = max(excess ** (2 / (1 + gain)), 2 * MIN_GROWTH - 1)
    return _nonempty(allocator, stats, seen, min(most, now.spp * growth), most)


def _nonempty(
    allocator: Allocator, stats: SampleStatistics, seen: PilotEstimate, spp: float, most: float
) -> np.ndarray:
    """Return an allocation that raises the mean to ``spp``, or further where whole groups exceed that."""
    allocation = allocator.allocate(stats, seen, spp)
    while spp < most and not allocation.any():
        spp = min(1.2 * spp, most)
        allocation = allocator.allocate(stats, seen, spp)
    return allocation


def _shown(
    now: Round,
    stats: SampleStatistics,
    target: float | None,
    blurred: Blurred | None,
    denoised: Denoised | None,
) -> RoundPicture:
    """Return a round with copies of its picture, its error and its rays."""
    image = stats.image()[..., :3]
    if blurred is not None:
        image = blurred(image)
    if denoised is not None:
        image = denoised.image
        error = denoised.error
    else:
        error = pixel_error(stats, pixel_variance(stats, blurred), blurred)
    with np.errstate(over="ignore"):  # errors beyond float32
        return RoundPicture(
            seconds=now.seconds,
            spp=now.spp,
            rmse=now.rmse,
            image=np.array(image, np.float32),
            error=error.astype(np.float32),
            samples=np.array(stats.samples(), np.float32),
            target=target,
        )


def _tail_warning(error: ErrorEstimate) -> str:
    """Return a warning if the error estimate is unreliable, else ""."""
    if error.tail <= PARETO_K_THRESHOLD:
        return ""
    return (
        f"a few rays dominate the error estimate of {error.rmse:.3g}, and the error may be larger by any "
        f"amount: the tail of what rays contribute has a Pareto shape of {error.tail:.2g}, above "
        f"{PARETO_K_THRESHOLD}. Another integrator, larger lights or rougher materials where such rays come "
        "from, or more rays help"
    )


def _target_warning(goal: Goal, now: Round, target: float | None) -> str:
    """Return a warning if the target was not reached, else ""."""
    if target == 0:
        return (
            f"target={goal.target}: the picture is black in the pilot samples, so that a percentage "
            "of its mean luminance is 0; the render ends. Give a number, such as target=0.01"
        )
    if goal.target is None or target is None or now.rmse <= target:
        return ""
    asked = f"target={goal.target}, which is {target:.3g}," if goal.target.relative else f"target={target:g}"
    kind = "an error" if goal.metric == LINEAR.name else f"a {goal.metric} error"
    seconds = goal.max_seconds
    late = seconds is not None and seconds < MIN_GROWTH * now.seconds
    limit = f"maxseconds={seconds:g}" if late else f"maxspp={goal.max_spp}"
    return (
        f"{asked} is not reached: {limit} ends the render at {kind} of {now.rmse:.3g}, after "
        f"{now.spp:.1f} spp and {now.seconds:.1f} s"
    )


def _message(done: list[Round], target: float | None, more: float) -> str:
    """Return where a render stands before a round of ``more`` spp."""
    if not done:
        return ""
    now = done[-1]
    aim = left = ""
    if target:
        aim = f" → {target:.2g}"
        seconds = now.seconds * max(min(now.rmse / target, 1e6) ** 2 - 1, 0)  # squares fall as time goes by
        left = f", about {seconds:.0f} s left" if seconds < 1e6 else ""
    return f"error {now.rmse:.2g}{aim}{left}, {now.spp:.0f} spp, now {more:.0f} more"
