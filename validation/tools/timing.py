"""Timing: compilation apart, sides in turns, medians with quartiles; and the code of kernels."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mrt_mitsuba.rendering.progress import Progress


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
        both = list(zip(sides, results, strict=True))
        for side, result in both if turn % 2 == 0 else reversed(both):
            result.append(side(turn))
    return results


def ratio_of(seconds: Sequence[float], others: Sequence[float]) -> dict[str, float]:
    """Return the median "ratio" of pairs of seconds, its quartiles "low" and "high", and both medians."""
    low, middle, high = np.quantile(np.divide(seconds, others), (0.25, 0.5, 0.75)).tolist()
    medians = {"seconds": float(np.median(seconds)), "other_seconds": float(np.median(others))}
    return {"ratio": middle, "low": low, "high": high, **medians}


def ratio(run: Callable[[], Any], other: Callable[[], Any], *, repeats: int) -> dict[str, float]:
    """Compare two runs in turns, see ``ratio_of``. Both run once before, which compiles their kernels."""
    sides = [lambda _, side=side: timed(side)[1] for side in (run, other)]
    in_turns(sides, 1)
    return ratio_of(*in_turns(sides, repeats))


def operations(render: Callable[..., Any]) -> int:
    """Return the length of the code of all kernels of a ``mrt.render``, each counted once."""
    lengths: dict[Any, int] = {}  # by the hash of the code

    class Watch(Progress):
        def kernels(self, records: Sequence[Mapping[str, Any]]) -> None:
            lengths.update({r["hash"]: r["operation_count"] for r in records if r.get("operation_count")})

    render(progress=Watch())
    return sum(lengths.values())
