"""Timing: compilation apart, sides in turns, medians with quartiles; and the code of kernels."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrt_mitsuba.rendering.progress import Progress

CACHE = "DRJIT_CACHE_DIR"
PREFIX = "mrt-kernels-"


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


@contextmanager
def own_cache() -> Iterator[None]:
    """Let Dr.Jit keep its kernels in a new folder, for ``forget`` to work; enter before it is imported."""
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as folder:
        before, os.environ[CACHE] = os.environ.get(CACHE), folder
        try:
            yield
        finally:
            del os.environ[CACHE]
            os.environ |= {} if before is None else {CACHE: before}


def forget() -> None:
    """Make the next render compile its kernels, or, without a cache of our own, read them from the cache."""
    import drjit as dr

    dr.flush_kernel_cache()
    folder = Path(os.environ.get(CACHE, ""))
    if folder.name.startswith(PREFIX):
        for file in folder.iterdir():
            file.unlink(missing_ok=True)


class _Kernels(Progress):
    """Notes the operations of each kernel that a render runs, by the hash of its code."""

    def __init__(self) -> None:
        self.operations: dict[str, int] = {}

    def kernels(self, records: Sequence[Mapping[str, Any]]) -> None:
        self.operations |= {str(r["hash"]): r["operation_count"] for r in records if r.get("operation_count")}


def operations(render: Callable[..., Any]) -> int:
    """Return the length of the code of all kernels of a ``mrt.render``."""
    watch = _Kernels()
    render(progress=watch)
    return sum(watch.operations.values())
