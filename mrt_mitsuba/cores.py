"""How many cores this process may use: affinity and control groups may grant fewer than there are."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path


def usable_cores(root: Path = Path("/")) -> int:
    """Return the cores of this process's affinity, or what its control groups grant if that is less.

    A quota of one and a half cores counts as two. ``root``: where the system's ``proc`` and ``sys`` are.
    """
    counts = [len(affinity())]
    for folder in control_groups("cpu", root):
        for files in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):  # versions 2 and 1
            with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
                quota, period = map(float, " ".join((folder / file).read_text() for file in files).split())
                counts += [math.ceil(quota / period)] if quota > 0 and period > 0 else []
    return min(counts)


def affinity() -> tuple[int, ...]:
    """Return the numbers of the cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def control_groups(controller: str, root: Path = Path("/")) -> Iterator[Path]:
    """Yield the folders of the control groups that this process is in, and of those above them."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, names, path = line.split(":", 2)
        if names and controller not in names.split(","):
            continue
        group = Path(path.lstrip("/"))
        for base in {names, controller if names else ""}:  # version 2 of the interface has no names
            for folder in (group, *group.parents):
                yield root / "sys/fs/cgroup" / base / folder
