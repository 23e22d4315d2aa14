"""The time while the shutter is open: how it is cut into frames, and when the rays of a pixel are traced."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.rays.bundle import Bundle, Lattice, Shutter
from mrt_mitsuba.rendering.plan import Plan

CENTRE = Lattice("report", 1)


@dataclass(frozen=True)
class Exposure:
    """One picture while the shutter is open. ``frame``: which of the plan's frames, or None for all of the
    time."""

    plan: Plan
    seed: int
    frame: int | None = None

    def lattice(self, pixels: Any, *, first: int = 0) -> Bundle:
        """The lattice's samples from ``first`` on."""
        plan, count = self.plan, self.plan.lattice.count - first
        if plan.motion == "stratified":
            # every ray of a pixel in a part of its own
            repeats = plan.repeats * math.ceil(plan.motion_samples / (count * plan.repeats))
            return Bundle(
                pixels, plan.lattice, first, count, repeats, Shutter(count * repeats, seed=self.seed)
            )
        return Bundle(pixels, plan.lattice, first, count, plan.repeats * self._moments, self._shutter)

    def centre(self, pixels: Any) -> Bundle:
        """The pixel's centre alone, at the same times in every pixel: a detector must see no noise."""
        return Bundle(pixels, CENTRE, repeats=self.plan.repeats * self._moments, shutter=self._shutter)

    def first_hit(self, pixels: Any) -> Bundle:
        """The pixel's centre when the shutter opens, or at the moment of the frame."""
        still = self.plan.motion is None
        return Bundle(
            pixels,
            CENTRE,
            shutter=None if still else Shutter(1, (self.frame or 0) / self.plan.motion_samples),
        )

    @property
    def rays_per_pixel(self) -> int:
        """Of the pass that traces the most."""
        return self.lattice(range(0)).rays_per_pixel

    @property
    def _moments(self) -> int:
        return self.plan.motion_samples if self.frame is None else 1

    @property
    def _shutter(self) -> Shutter | None:
        if self.plan.motion is None:
            return None
        if self.frame is not None:
            return Shutter(1, self.frame / self.plan.motion_samples)
        return Shutter(self._moments, 0.0 if self.plan.motion == "frames" else 0.5)


def exposures(plan: Plan, seed: int) -> list[Exposure]:
    """What to average: one picture, or the frames of a camera's way where each needs filters of its own."""
    if plan.motion == "frames" and (plan.detector or plan.blur):
        # two passes in a frame, each with random numbers of its own
        return [Exposure(plan, seed + 2 * frame, frame) for frame in range(plan.motion_samples)]
    return [Exposure(plan, seed)]
