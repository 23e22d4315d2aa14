"""Rounds of rays, until the picture is as good as was asked for."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mrt_mitsuba.output.error import Round, RoundPicture
from mrt_mitsuba.rendering.exposing import Exposer, Groups
from mrt_mitsuba.rendering.noise import GROUP, GROWTH, HALVES, MARGIN, Halves

log = logging.getLogger(__name__)

LEAST_GROWTH = 1.02  # fewer rays, and a round costs more than it brings

OnRound = Callable[[RoundPicture], object]


@dataclass(frozen=True)
class Goal:
    """When to stop: at an error, or at a number of rays, or when the time is up."""

    target: float | None  #: RMSE, linear; None for a number of rays
    rays: int  #: mean of a pixel: to spend, or at most with a target
    seconds: float | None = None  #: at most


class Rounds:
    """A picture in the making. ``done``: the rounds so far."""

    def __init__(self, exposer: Exposer, seed: int, goal: Goal, start: float) -> None:
        self.halves = Halves(exposer.film, len(exposer.names))
        self.done: list[Round] = []
        self._exposer, self._seed, self._goal, self._start = exposer, seed, goal, start

    def run(self, on_round: OnRound | None, show: Callable[[Round, Round], object]) -> None:
        """Trace rounds until the goal is reached or ``on_round`` returns False; ``show`` each with the first."""
        groups = np.ones((HALVES, self._exposer.film.pixels), np.int64)
        while groups is not None:
            self._trace(groups)
            show(self.done[0], self.done[-1])
            if on_round is not None and on_round(self._picture()) is False:
                break
            groups = self._next()

    def _trace(self, chosen: np.ndarray) -> None:
        halves, film = self.halves, self._exposer.film
        groups = Groups.spread(GROUP, halves.widened(chosen), halves.rays)
        exposed = self._exposer.expose(groups, self._seed, pictures=HALVES, progressive=True, moments=True)
        halves.add(exposed, chosen > 0)
        seconds = time.perf_counter() - self._start
        mean = float(halves.rays.sum() / film.pixels)
        self.done.append(Round(seconds, mean, halves.error().rmse))
        log.info("round %d: %.1f rays a pixel, error %.3g", len(self.done), mean, self.done[-1].rmse)

    def _next(self) -> np.ndarray | None:
        """Return the groups of the next round, or None at the goal."""
        goal, now = self._goal, self.done[-1]
        if goal.target is not None and now.rmse <= goal.target or now.rmse == 0:
            return None
        most = min(goal.rays, GROWTH * now.spp)
        if goal.seconds is not None:
            most = min(most, now.spp * goal.seconds / now.seconds)
        if most < LEAST_GROWTH * now.spp:
            return None
        aim = None if goal.target is None else MARGIN * goal.target
        return self.halves.share_out(rays=most, target=aim)

    def _picture(self) -> RoundPicture:
        halves, now = self.halves, self.done[-1]
        image = halves.film.picture(halves.picture())[..., :3].astype(np.float32)
        error = np.sqrt(halves.variance().mean(-1)).astype(np.float32)
        return RoundPicture(
            now.seconds, now.spp, now.rmse, image, error, halves.samples().astype(np.float32)
        )
