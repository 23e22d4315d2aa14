"""Where people wait: the start of the command and small renders, against an earlier version, in turns.

Each turn starts a process of each side, which times the cases of ``small_renders``; so a load on the machine
meets both.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrt_mitsuba.validation.tools import small_renders

# What any program on Mitsuba waits for: import, variant, one kernel
BARE = """
from mrt_mitsuba import llvm
import mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
dr.eval(dr.arange(mi.Float, 16) + dr.opaque(mi.Float, 1))
dr.sync_thread()
"""
START = "mrt out 0 / a bare start of Mitsuba"


@dataclass(frozen=True)
class Waits:
    """Seconds of a case, medians over turns, and their ratio to the other side's with its quartiles."""

    name: str
    seconds: float
    other_seconds: float | None  # None: there is no other side
    ratio: float | None = None
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, name: str, ours: Sequence[float], theirs: Sequence[float]) -> Waits:
        """Return what pairs of seconds, taken in turns, say."""
        if not theirs:
            return cls(name, float(np.median(ours)), None)
        low, ratio, high = np.quantile(np.divide(ours, theirs), (0.25, 0.5, 0.75)).tolist()
        return cls(name, float(np.median(ours)), float(np.median(theirs)), ratio, low, high)


def waits(before: str | None, turns: int, cases: Sequence[str] | None = None) -> list[Waits]:
    """Measure the start and the cases, in turns with the Python ``before`` that has an earlier version."""
    names = list(small_renders.CASES) if cases is None else list(cases)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "mrt_mitsuba.command.main", f"{folder}/out", "0", "quiet=1"]
        pair = lambda: _seconds(command), lambda: _seconds([sys.executable, "-c", BARE])
        found = [Waits.of(START, *_in_turns(pair, turns))]
    if not names:
        return found
    sides = [lambda: _small(sys.executable, names)]
    if before is not None:
        sides.append(lambda: _small(before, names))
    runs: list[list[Mapping[str, float]]] = _in_turns(sides, turns)
    for name in names:
        ours, theirs = ([run[name] for run in side] for side in (*runs, *([[]] if before is None else [])))
        found.append(Waits.of(name, ours, theirs))
    return found


def _in_turns(sides: Sequence[Callable[[], Any]], turns: int) -> list[list[Any]]:
    """Return what each side gives in each turn; the first to go changes. One turn before does not count."""
    results: list[list[Any]] = [[] for _ in sides]
    for turn in range(turns + 1):
        order = range(len(sides)) if turn % 2 else reversed(range(len(sides)))
        for index in order:
            result = sides[index]()
            if turn:
                results[index].append(result)
    return results


def _seconds(command: Sequence[str]) -> float:
    # as after installation: Python compiles a module once
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=600, env=environment)
    return time.perf_counter() - start


def _small(python: str, names: Sequence[str]) -> Mapping[str, float]:
    script = str(Path(small_renders.__file__))
    ran = subprocess.run([python, script, *names], check=True, stdout=subprocess.PIPE, timeout=3600)
    found: Mapping[str, float] = json.loads(ran.stdout.splitlines()[-1])
    return found


def table(found: Sequence[Waits]) -> str:
    """Return the figures as text."""
    width = max(len(one.name) for one in found)
    lines = [f"{'ms':<{width}}{'now':>10}{'other':>10}{'ratio':>8}  quartiles"]
    for one in found:
        line = f"{one.name:<{width}}{1000 * one.seconds:>10.2f}"
        if one.other_seconds is not None:
            line += f"{1000 * one.other_seconds:>10.2f}{one.ratio:>8.2f}  {one.low:.2f} to {one.high:.2f}"
        lines.append(line)
    return "\n".join(lines)


def as_dicts(found: Sequence[Waits]) -> list[dict[str, Any]]:
    """Return the figures for JSON."""
    return [asdict(one) for one in found]
