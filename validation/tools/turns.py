"""Where people wait: the start of the command and small renders, against an earlier version, in turns.

Each turn starts a process of each side, which times the cases of ``small_renders``; so a load on the machine
meets both.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mrt_mitsuba.validation.tools import small_renders
from mrt_mitsuba.validation.tools.warm import Ratio, in_turns, timed

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
    def of(cls, name: str, ours: Sequence[float], *theirs: Sequence[float]) -> Waits:
        """Return what pairs of seconds, taken in turns, say."""
        if not theirs:
            return cls(name, statistics.median(ours), None)
        found = Ratio.of(ours, *theirs)
        return cls(name, found.seconds, found.other_seconds, found.median, found.low, found.high)


def waits(before: str | None, turns: int, cases: Sequence[str] | None = None) -> list[Waits]:
    """Measure the start and the cases, in turns with the Python ``before`` that has an earlier version."""
    names = list(small_renders.CASES) if cases is None else list(cases)
    with tempfile.TemporaryDirectory() as folder:
        bare = [sys.executable, "-c", BARE]
        command = [sys.executable, "-m", "mrt_mitsuba.command.main", f"{folder}/out", "0", "quiet=1"]
        found = [Waits.of(START, *_warm([partial(seconds, c) for c in (command, bare)], turns))]
    pythons = [sys.executable, *([] if before is None else [before])]
    runs = _warm([partial(_small, python, names) for python in pythons], turns) if names else []
    return found + [Waits.of(name, *([run[name] for run in side] for side in runs)) for name in names]


def _warm(sides: Sequence[Callable[[], Any]], turns: int) -> list[list[Any]]:
    """Return what each side gives in each turn. One turn before does not count."""
    for side in sides:
        side()
    return in_turns([lambda _, side=side: side() for side in sides], turns)  # type: ignore[misc]


def seconds(command: Sequence[str]) -> float:
    """Return the seconds of a command, as after installation: Python compiles a module once."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    silent: dict[str, Any] = {"check": True, "stdout": subprocess.DEVNULL, "timeout": 600}
    return timed(lambda: subprocess.run(command, env=environment, **silent))[1]


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
