"""How much memory a render may take, and how many rays to trace at once within it."""

from __future__ import annotations

import os

from mrt_mitsuba.errors import UsageError

# A wavefront's arrays, per ray and channel: what the kernel writes and the mean reads, in float32, and as
# much again for what Dr.Jit keeps for reuse
BYTES_PER_CHANNEL_OF_RAY = 8

# Whole pictures, per pixel and channel: the result, its copy in Dr.Jit's arrays while a filter reads it, and
# what the filter writes
BYTES_PER_CHANNEL_OF_PIXEL = 12

# Rays of one wavefront at most: more gain no speed, and progress is told by the wavefront
MOST_RAYS = 2**23
# and at least: fewer, and starting the kernels costs more than running them
LEAST_RAYS = 2**16


def rays_at_once(pixels: int, channels: int, memory: int | None = None) -> int:
    """Rays of one wavefront, for a picture of so many pixels and float32 channels.

    ``memory``: bytes to stay within; by default half of what is free. Raises ``UsageError`` where the
    finished picture alone would not fit.
    """
    budget = memory if memory is not None else free_memory() // 2
    left = budget - pixels * channels * BYTES_PER_CHANNEL_OF_PIXEL
    rays = min(left // (channels * BYTES_PER_CHANNEL_OF_RAY), MOST_RAYS)
    if rays < min(LEAST_RAYS, pixels):
        needed = (
            pixels * channels * BYTES_PER_CHANNEL_OF_PIXEL + LEAST_RAYS * channels * BYTES_PER_CHANNEL_OF_RAY
        )
        raise UsageError(
            f"a picture of {pixels} pixels needs about {_text(needed)} of memory, "
            f"and {_text(budget)} may be used: choose a "
            f"smaller width and height, fewer layers, or a larger memory="
        )
    return int(rays)


def free_memory() -> int:
    """Bytes that can be had without swapping; where the system does not tell, all there are."""
    try:
        with open("/proc/meminfo") as file:
            fields = dict(line.split(":", 1) for line in file)
        return int(fields["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _text(count: float) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
