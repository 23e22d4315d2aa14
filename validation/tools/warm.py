"""Timing of warm renders: compilation apart, settings in turn, medians."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

Name = TypeVar("Name", bound=Hashable)  # by which a caller knows its runs


@dataclass(frozen=True)
class Warm:
    """The returned value of a run, and its seconds after a first run that compiled its kernels."""

    result: Any
    seconds: float  # the median
    spread: float  # (slowest - fastest) / median


LEAST_REPEATS = 3  # for a median that one disturbance does not move


def measure(
    runs: Mapping[Name, Callable[[], Any]], *, repeats: int = 3, enough: float = float("inf")
) -> dict[Name, Warm]:
    """Run everything once, then ``repeats`` times in turn, so that a load on the machine meets all alike.

    Runs that have taken ``enough`` seconds, three times at least, are left out of further turns.
    """
    results = {name: run() for name, run in runs.items()}
    times: dict[Name, list[float]] = {name: [] for name in runs}
    for turn in range(repeats):
        for name, run in runs.items():
            if turn < LEAST_REPEATS or sum(times[name]) < enough:
                times[name].append(timed(run)[1])
    found = {}
    for name, seconds in times.items():
        median = statistics.median(seconds)
        found[name] = Warm(results[name], median, (max(seconds) - min(seconds)) / median)
    return found


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a function returns, and its seconds."""
    start = time.perf_counter()
    result = run()
    return result, time.perf_counter() - start


def in_turns(sides: Sequence[Callable[[int], Any]], turns: int) -> list[list[Any]]:
    """Return what each side gives for the number of each turn, so that a load on the machine meets all.

    The order changes from turn to turn.
    """
    results: list[list[Any]] = [[] for _ in sides]
    for turn in range(turns):
        for index in range(len(sides)) if turn % 2 == 0 else reversed(range(len(sides))):
            results[index].append(sides[index](turn))
    return results


@dataclass(frozen=True)
class Ratio:
    """Seconds of one run over those of another, of pairs taken one after the other."""

    median: float
    low: float  # the lower and the upper quartile
    high: float
    seconds: float  # medians of the one and of the other
    other_seconds: float

    @classmethod
    def of(cls, seconds: Sequence[float], others: Sequence[float]) -> Ratio:
        """Return what pairs of seconds say."""
        low, median, high = np.quantile(np.divide(seconds, others), (0.25, 0.5, 0.75)).tolist()
        return cls(median, low, high, statistics.median(seconds), statistics.median(others))


def ratio(run: Callable[[], Any], other: Callable[[], Any], *, repeats: int) -> Ratio:
    """Compare two runs in turns. Both run once before, which compiles their kernels."""
    run()
    other()
    return Ratio.of(*in_turns([lambda _: timed(run)[1], lambda _: timed(other)[1]], repeats))
