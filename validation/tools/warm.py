"""Timing of warm renders: compilation apart, settings in turn, medians."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
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
                times[name].append(_seconds(run))
    found = {}
    for name, seconds in times.items():
        median = statistics.median(seconds)
        found[name] = Warm(results[name], median, (max(seconds) - min(seconds)) / median)
    return found


@dataclass(frozen=True)
class Ratio:
    """Seconds of one run over those of another, of pairs taken one after the other."""

    median: float
    low: float  # the lower and the upper quartile
    high: float
    seconds: float  # medians of the one and of the other
    other_seconds: float


def ratio(run: Callable[[], Any], other: Callable[[], Any], *, repeats: int) -> Ratio:
    """Compare two runs in pairs, so that a load on the machine meets both; the first goes second next time.

    Both run once before, which compiles their kernels.
    """
    pair = (run, other)
    times: list[list[float]] = [[], []]
    for one in pair:
        one()
    for number in range(repeats):
        for index in (0, 1) if number % 2 == 0 else (1, 0):
            times[index].append(_seconds(pair[index]))
    ratios = [a / b for a, b in zip(*times, strict=True)]
    low, median, high = (float(q) for q in np.quantile(ratios, (0.25, 0.5, 0.75)))
    return Ratio(median, low, high, *(statistics.median(t) for t in times))


def _seconds(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start
