"""The error that a render is to reach."""

from __future__ import annotations

import math
from abc import ABC
from dataclasses import dataclass

PERCENT = "%"
METRIC_NAMES = ("linear", "relative", "display")


def plain(text: str) -> str:
    """The text of a number as it is; spaces and underscores, which ``float`` takes, raise ``ValueError``."""
    if not text.isascii() or "_" in text or text != text.strip():
        raise ValueError(f"{text!r} is not a number")
    return text


@dataclass(frozen=True)
class Target:
    """An RMSE to the converged picture: a number, or a percentage.

    A percentage is one of the picture's mean luminance or, of values on a display, of full white.

    ``str()`` writes it as an option takes it: "0.01" or "2%". Raises ``ValueError`` for a value that cannot
    be reached: zero, negative or not finite.
    """

    value: float  #: of a percentage the fraction, 0.02 for 2 %
    relative: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.value < math.inf:
            raise ValueError(f"{self.value} cannot be reached: a target is finite and more than 0")

    @classmethod
    def of(cls, value: object) -> Target:
        """Read a target from a number, from a text such as "0.01" or "2%", or from a target.

        Raises ``ValueError`` or ``TypeError`` for anything else.
        """
        if isinstance(value, Target):
            return value
        if isinstance(value, bool):
            raise TypeError("a target is a number or a percentage")
        if not isinstance(value, str):
            return cls(float(value))  # type: ignore[arg-type]
        number = float(plain(value.removesuffix(PERCENT)))
        relative = value.endswith(PERCENT)
        return cls(number / 100 if relative else number, relative)

    @property
    def plain(self) -> float | str:
        """The number, or the text of a percentage: what JSON can hold, and ``of`` reads."""
        return str(self) if self.relative else self.value

    def rmse(self, reference: float) -> float:
        """The RMSE to reach, where ``reference`` is 100 %."""
        return self.value * reference if self.relative else self.value

    def __str__(self) -> str:
        return f"{100 * self.value:g}{PERCENT}" if self.relative else f"{self.value:g}"


@dataclass(frozen=True)
class Goal:
    """When adaptive rounds end: at a target, or when their rays or seconds are spent."""

    target: Target | None  #: None: all rays are spent
    max_spp: int  #: rays of a pixel, on average
    max_seconds: float | None = None  #: None: no limit
    metric: str = "linear"  #: of the error, one of ``METRIC_NAMES``
    denoise: bool = False  #: errors are those of the picture mixed with its denoised version


class AdaptiveIntegrator(ABC):  # registered, as Mitsuba's classes take no second base
    """An integrator that traces no rays itself, but sets the goal of adaptive rounds with another one."""

    nested: object  #: the integrator that traces
    goal: Goal
