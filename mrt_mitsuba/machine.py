"""The machine's memory, the share of it to use at once, and its cores, by limits and control groups."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mrt_mitsuba.errors import MrtError, UsageError

# For every pixel: what is kept, by channel, and what Pillow needs to write a PNG
BYTES_PER_CHANNEL = 4
BYTES_TO_WRITE = 4

# A wavefront's arrays, per ray and channel: what the kernel writes, what is formed of it, and the part before
BYTES_PER_CHANNEL_OF_RAY = 12
# What filters need for every pixel under work; measured: by the blur 131, where each pixel has another amount
# 230, by the detectors 21, copies of what they read apart
BYTES_PER_PIXEL_OF_FILTER = 256

# Kernels: what their compilation takes for a moment, and their code
BYTES_OF_KERNELS = 2**25

# Textures, per texel; measured: at most 22 stay, of a map of the surroundings 39; 17 more while one is read
BYTES_PER_TEXEL = 24
BYTES_PER_TEXEL_AROUND = 40
BYTES_PER_TEXEL_READ = 20

# Addresses, which only matter where they are limited (ulimit -v): Mitsuba and its compiler, and each thread's
# stack and heap
ADDRESSES_TO_START = 2**29
ADDRESSES_AT_WORK = 2**27
ADDRESSES_PER_THREAD = 72 * 2**20

# Rays of one wavefront at most: more bring no speed, and progress is reported by the wavefront
MOST_RAYS = 2**23
# and at least: fewer, and starting the kernels costs more than running them
LEAST_RAYS = 2**16
# Pixels of one band of a filter at most, and rows at least: fewer, and most of the work is done twice
MOST_PIXELS = 2**22
LEAST_ROWS = 24


@dataclass
class Budget:
    """Bytes that a render may use, and how many its scene has taken for textures."""

    size: int
    taken: int = 0
    inputs: set[str] = field(default_factory=set)  #: paths of the files that the scene is read from

    @classmethod
    def of(cls, wanted: int | None) -> Budget:
        """The bytes asked for, by default half of those that are free; never more than the machine has."""
        free, most = _look(memory, int(time.monotonic()))
        return cls(min(free // 2 if wanted is None else wanted, most))

    def take_texture(self, path: str, width: int, height: int, *, around: bool = False) -> None:
        """Take the memory of a picture used as a texture; ``around``: as a map of the surroundings.

        Raises ``UsageError`` where that is too much.
        """
        stays = width * height * (BYTES_PER_TEXEL_AROUND if around else BYTES_PER_TEXEL)
        needed = self.taken + stays + width * height * BYTES_PER_TEXEL_READ
        if needed > self.size:
            raise UsageError(
                f"with the picture {path} of {width}x{height} texels, the scene needs {_text(needed)} of "
                f"memory, and {_text(self.size)} may be used: choose a smaller picture or a larger memory="
            )
        self.taken += stays


@functools.lru_cache(maxsize=1)
def _look(function: Callable[[], tuple[int, int]], second: int) -> tuple[int, int]:
    """The result of a function, which is called once a second: it takes a tenth of a small render."""
    return function()


@dataclass(frozen=True)
class Workspace:
    """Memory for the rays and the filters at work, without that of the picture: ``size`` bytes."""

    size: int

    @classmethod
    def next_to(
        cls,
        width: int,
        height: int,
        channels: int,
        *,
        budget: Budget,
        pictures: int = 1,
        rays_per_pixel: int = 1,
    ) -> Workspace:
        """The memory that a budget leaves next to a picture of so many float32 channels, kept ``pictures``
        times.

        ``rays_per_pixel``: traced at once. Raises ``UsageError`` where the budget does not suffice.
        """
        pixels = width * height
        finished = pixels * (pictures * channels * BYTES_PER_CHANNEL + BYTES_TO_WRITE) + BYTES_OF_KERNELS
        finished += budget.taken
        least = max(
            max(min(LEAST_RAYS, pixels), rays_per_pixel) * channels * BYTES_PER_CHANNEL_OF_RAY,
            min(LEAST_ROWS, height) * width * BYTES_PER_PIXEL_OF_FILTER,
        )
        if finished + least > budget.size:
            raise UsageError(
                f"a picture of {width}x{height} pixels needs {_text(finished + least)} of memory, "
                f"and {_text(budget.size)} may be used: choose a smaller width and height, "
                f"fewer layers or samples, or a larger memory="
            )
        return cls(budget.size - finished)

    def rays_at_once(self, channels: int) -> int:
        """The rays of one wavefront, which returns so many channels."""
        return max(1, min(self.size // (channels * BYTES_PER_CHANNEL_OF_RAY), MOST_RAYS))

    def rows_at_once(self, width: int) -> int:
        """The rows of a picture that a filter works on at once."""
        return max(1, min(self.size // BYTES_PER_PIXEL_OF_FILTER, MOST_PIXELS) // width)

    def give_back(self, used: int) -> None:
        """Give the system what Dr.Jit keeps for reuse, after a pass that used so many bytes, if many.

        A picture takes up to four passes, which seldom reuse each other's arrays: they differ in size.
        """
        import drjit as dr

        if used > self.size // 4:
            dr.flush_malloc_cache()


def memory(root: Path = Path("/")) -> tuple[int, int]:
    """The bytes that are free without swapping, and those of the machine, within the limits of control groups
    and of addresses.

    ``root``: where the system's folders ``proc`` and ``sys`` are.
    """
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    free = []
    for names in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
        for limit, used, statistics in control_groups("memory", (*names, "memory.stat"), root):
            with contextlib.suppress(ValueError):  # "max"
                limits.append(int(limit))
                inactive = re.search(r"^inactive_file (\d+)", statistics, re.MULTILINE)
                free.append(limits[-1] - int(used) + int(inactive[1] if inactive else 0))
    addresses = _free_addresses()
    if addresses is not None:
        limits.append(max(0, addresses - ADDRESSES_AT_WORK - (os.cpu_count() or 1) * ADDRESSES_PER_THREAD))
    with contextlib.suppress(OSError, IndexError):  # a container may hide it
        free.append(int(re.findall(r"MemAvailable: *(\d+) kB", Path("/proc/meminfo").read_text())[0]) * 1024)
    return max(0, min(limits + free)), min(limits)


def check_start() -> None:
    """Raise ``MrtError`` where Mitsuba could not even be imported: its libraries would crash."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise MrtError(
            "the working folder has been deleted, and Mitsuba needs one: change to another"
        ) from error
    free = _free_addresses()
    if free is not None and free < ADDRESSES_TO_START:
        raise UsageError(
            f"the limit of addresses (ulimit -v) leaves {_text(free)}, but Mitsuba and its compiler need "
            f"{_text(ADDRESSES_TO_START)} in addition to memory=: raise it, and limit memory= instead"
        )


def _free_addresses() -> int | None:
    """The bytes of addresses that are left, or None without a limit."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return None
    return limit - int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _text(count: float) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


def affinity() -> list[int]:
    """Return the numbers of the cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # neither macOS nor Windows
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def usable_cores(root: Path = Path("/")) -> int:
    """The cores of this process's affinity, or as many as its control groups grant if that is less.

    A quota of one and a half cores counts as two. ``root``: where the system's ``proc`` and ``sys`` are.
    """
    counts = [len(affinity())]
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):  # versions 2 and 1
        for texts in control_groups("cpu", names, root):
            with contextlib.suppress(ValueError):  # "max"
                quota, period = map(float, " ".join(texts).split())
                if quota > 0 and period > 0:
                    counts.append(math.ceil(quota / period))
    return min(counts)


def control_groups(controller: str, names: Sequence[str], root: Path) -> Iterator[list[str]]:
    """The texts of files of each control group that this process is in, and of those above it; groups
    that lack one are passed over."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # a container may hide it
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        group = Path(path.lstrip("/"))
        for base in {controllers, controller if controllers else ""}:  # version 2 of the interface has none
            for folder in (group, *group.parents):
                with contextlib.suppress(OSError):
                    yield [(root / "sys/fs/cgroup" / base / folder / name).read_text() for name in names]
