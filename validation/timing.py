"""Timing of renders in turns, and the kernels that Dr.Jit launches for them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from mrt_mitsuba.rendering.progress import Progress

Item = TypeVar("Item")


def in_turns(sides: Sequence[Callable[[int], Item]], turns: int) -> list[list[Item]]:
    """Return the results of each side, called with the number of each turn.

    Sides alternate, and their order changes from turn to turn, so that a load on the machine meets all.
    """
    results: list[list[Item]] = [[] for _ in sides]
    for turn in range(turns):
        order = list(zip(sides, results, strict=True))
        for side, result in order if turn % 2 == 0 else reversed(order):
            result.append(side(turn))
    return results


def timed_in_turns(sides: Sequence[Callable[[int], Any]], turns: int) -> list[tuple[list[Any], np.ndarray]]:
    """Return the results of each side, see ``in_turns``, and their seconds [turns].

    Each side runs once before, which compiles its kernels.
    """

    def timed(side: Callable[[int], Any], turn: int) -> tuple[Any, float]:
        start = time.perf_counter()
        return side(turn), time.perf_counter() - start

    in_turns(sides, 1)
    runs = in_turns([partial(timed, side) for side in sides], turns)
    return [([result for result, _ in run], np.array([seconds for _, seconds in run])) for run in runs]


def ratio_of(seconds: Sequence[float], others: Sequence[float]) -> dict[str, float]:
    """Return the median "ratio" of paired seconds, its quartiles "low" and "high", and both medians."""
    low, middle, high = np.quantile(np.divide(seconds, others), (0.25, 0.5, 0.75)).tolist()
    medians = {"seconds": float(np.median(seconds)), "other seconds": float(np.median(others))}
    return {**medians, "ratio": middle, "low": low, "high": high}


def operations(render: Callable[..., object]) -> list[int]:
    """Return the length of the code of each distinct kernel of a ``mrt.render``."""
    lengths: dict[Any, int] = {}

    class Watch(Progress):
        def kernels(self, records: Sequence[Mapping[str, Any]]) -> None:
            lengths.update({r["hash"]: r["operation_count"] for r in records if r.get("operation_count")})

    render(progress=Watch())
    return list(lengths.values())
