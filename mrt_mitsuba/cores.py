"""How many cores this process may use: affinity and control groups may grant fewer than there are."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")


def usable_cores(membership: Path = MEMBERSHIP, cgroups: Path = CGROUPS) -> int:
    """Return the cores of this process's affinity, or what its control groups grant if that is less.

    A quota of one and a half cores counts as two. ``membership`` and ``cgroups`` are where Linux shows them.
    """
    quotas = [math.ceil(quota) for quota in _quotas(membership, cgroups)]
    return min([len(affinity()), *quotas])


def affinity() -> tuple[int, ...]:
    """Return the numbers of the cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def _quotas(membership: Path, cgroups: Path) -> Iterator[float]:
    """Yield the quota, in cores, of each control group above this process that has one."""
    try:
        lines = membership.read_text().splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = cgroups / controllers
        group = root / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(root):
                quota, period = _limits(folder)
                if quota > 0 and period > 0:
                    yield quota / period


def _limits(folder: Path) -> tuple[float, float]:
    """Return quota and period by version 2 or 1 of the interface; a quota below 0 is none."""
    for files in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        try:
            words = " ".join((folder / file).read_text() for file in files).replace("max", "-1").split()
            return float(words[0]), float(words[1])
        except (OSError, ValueError, IndexError):
            continue
    return -1.0, 0.0
