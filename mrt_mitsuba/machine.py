"""The memory that a render may use, and the cores of this machine, within the limits of a container."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

from mrt_mitsuba.errors import UsageError

# For every pixel: what is kept, by channel, and what a PNG needs: 8 bit, and a copy that Pillow makes
BYTES_PER_CHANNEL = 4
BYTES_TO_WRITE = 7

# A wavefront's arrays, per ray and channel: what the kernel writes, what is formed of it, and the part before
BYTES_PER_CHANNEL_OF_RAY = 12
# Memory of filters for each pixel in work; measured: by the blur 131, where each pixel has another amount
# 230, by the detectors 21, copies of what they read apart
BYTES_PER_PIXEL_OF_FILTER = 256

# Kernels: what their compilation takes for a moment, and their code
BYTES_OF_KERNELS = 2**25

MAX_WAVEFRONT = 2**23  # rays; more bring no speed, and progress is reported by the wavefront
MIN_WAVEFRONT = 2**16  # rays; with fewer, starting the kernels costs more than running them
MAX_BAND = 2**22  # pixels of a band of the picture that a filter works on
MIN_BAND_ROWS = 24  # with fewer, most of the work is done twice

GROUP = Path("/sys/fs/cgroup")  # the control group (version 2) of a container, as it sees it


def budget(wanted: int | None) -> int:
    """Return the bytes asked for, by default half of those that are free; never more than the machine has."""
    free, most = memory()
    return min(free // 2 if wanted is None else wanted, most)


def workspace(
    budget: int, width: int, height: int, channels: int, *, pictures: int = 1, rays_per_pixel: int = 1
) -> int:
    """Return the bytes for rays and filters that a budget leaves next to pictures of float32 channels.

    ``rays_per_pixel``: traced at once. Raises ``UsageError`` if the budget does not suffice.
    """
    pixels = width * height
    finished = pixels * (pictures * channels * BYTES_PER_CHANNEL + BYTES_TO_WRITE) + BYTES_OF_KERNELS
    least = max(
        max(min(MIN_WAVEFRONT, pixels), rays_per_pixel) * channels * BYTES_PER_CHANNEL_OF_RAY,
        min(MIN_BAND_ROWS, height) * width * BYTES_PER_PIXEL_OF_FILTER,
    )
    if finished + least > budget:
        raise UsageError(
            f"a picture of {width}x{height} pixels needs {_text(finished + least)} of memory, "
            f"and {_text(budget)} may be used: choose a smaller width and height, "
            f"fewer layers or samples, or a larger memory="
        )
    return budget - finished


def wavefront_size(space: int, channels: int) -> int:
    """Return the number of rays of a wavefront that returns ``channels`` values each."""
    return max(1, min(space // (channels * BYTES_PER_CHANNEL_OF_RAY), MAX_WAVEFRONT))


def band_rows(space: int, width: int) -> int:
    """Return the number of rows of a picture that a filter works on at once."""
    return max(1, min(space // BYTES_PER_PIXEL_OF_FILTER, MAX_BAND) // width)


def flush_cache(space: int, used: int) -> None:
    """Flush Dr.Jit's allocation cache after a pass that used more than a quarter of the workspace.

    A picture takes up to four passes, which seldom reuse each other's arrays: they differ in size.
    """
    import drjit as dr

    if used > space // 4:
        dr.flush_malloc_cache()


def memory() -> tuple[int, int]:
    """Return the free bytes, and those of the machine, within the limit of this process's control group."""
    import psutil

    state = psutil.virtual_memory()
    free = state.available
    total = state.total
    with contextlib.suppress(OSError, ValueError):  # no such group, or "max"
        limit = int((GROUP / "memory.max").read_text())
        used = int((GROUP / "memory.current").read_text())
        free = min(free, limit - used)
        total = min(total, limit)
    return max(0, free), total


def _text(count: float) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


def affinity() -> list[int]:
    """Return the numbers of the cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # neither on macOS nor on Windows
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def usable_cores() -> int:
    """Return the number of cores of this process's affinity, or of its control group's quota if that is less.

    A quota of one and a half cores counts as two.
    """
    count = len(affinity())
    with contextlib.suppress(OSError, ValueError):  # no such group, or "max"
        quota, period = map(int, (GROUP / "cpu.max").read_text().split())
        count = min(count, math.ceil(quota / period))
    return count
