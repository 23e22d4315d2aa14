"""Timing of warm renders: compilation apart, settings in turn, medians."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Warm:
    """What a run returned, and its seconds after a first run that compiled its kernels."""

    result: Any
    seconds: float  # the median
    spread: float  # (slowest - fastest) / median
    first: float  # seconds of the first run, in which kernels are compiled or read from the cache


def measure(runs: Mapping[str, Callable[[], Any]], *, repeats: int = 3) -> dict[str, Warm]:
    """Run everything once, then ``repeats`` times in turn, so that a load on the machine meets all alike."""
    results, first = {}, {}
    for name, run in runs.items():
        results[name], first[name] = _timed(run)
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            times[name].append(_timed(run)[1])
    return {name: _summary(results[name], times[name], first[name]) for name in runs}


def _timed(run: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    result = run()
    return result, time.perf_counter() - start


def _summary(result: Any, times: list[float], first: float) -> Warm:
    median = statistics.median(times)
    return Warm(result, median, (max(times) - min(times)) / median, first)
