"""Settings as points of error and time: which of them are worth having."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mrt_mitsuba.validation.tools.warm import Warm

SAME = 0.02  # errors closer than this are the same: no reason to wait longer
INVISIBLE = 0.5 / 255  # half a step of an 8-bit picture


@dataclass(frozen=True)
class Point:
    """One setting: what it costs and how far off it is."""

    name: str
    warm: Warm
    rmse: float
    rel_rmse: float
    largest: float
    flip: float
    rays: dict[str, int]  # by kind: "primary" and, where they could be counted, "mirror" and "shadow"

    @property
    def seconds(self) -> float:
        return self.warm.seconds

    def __str__(self) -> str:
        return f"{self.name} ({1000 * self.seconds:.3g} ms, RMSE {self.rmse:.2g})"


def front(points: Iterable[Point]) -> list[Point]:
    """The settings that gain error over all faster ones, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.rmse)):
        if not best or point.rmse < (1 - SAME) * best[-1].rmse:
            best.append(point)
    return best


def fastest(points: Iterable[Point], error: float) -> Point | None:
    """The fastest setting with an RMSE of at most so much."""
    return min((p for p in points if p.rmse <= error), key=lambda p: p.seconds, default=None)


def amount(name: str, prefix: str) -> int:
    """The number after a prefix in the name of a setting: 4 of "none aa=4 report" and "aa="."""
    return next(int(word[len(prefix) :]) for word in name.split() if word.startswith(prefix))


def amounts(points: Sequence[Point], prefix: str) -> list[int]:
    """All such numbers, ascending."""
    with_prefix = (p for p in points if f" {prefix}" in f" {p.name}")
    return sorted({amount(p.name, prefix) for p in with_prefix})
