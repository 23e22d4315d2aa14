"""How much memory a render may take: what the picture needs, and how much to do at once with the rest."""

from __future__ import annotations

import os
from dataclasses import dataclass

from mrt_mitsuba.errors import UsageError

# Of every pixel: what is kept, by channel, and what Pillow needs to write a PNG
BYTES_PER_CHANNEL = 4
BYTES_TO_WRITE = 4

# A wavefront's arrays, per ray and channel: what the kernel writes, what is formed of it, and the part before
BYTES_PER_CHANNEL_OF_RAY = 12
# What filters need for every pixel under work; measured: 131 at most by the blur, 21 by the detectors, beside
# copies of what they read
BYTES_PER_PIXEL_OF_FILTER = 192

# Kernels: what their compilation takes for a moment, and their code
BYTES_OF_KERNELS = 2**25

# Rays of one wavefront at most: more gain no speed, and progress is told by the wavefront
MOST_RAYS = 2**23
# and at least: fewer, and starting the kernels costs more than running them
LEAST_RAYS = 2**16
# Pixels of one band of a filter at most, and rows at least: fewer, and most of the work is done twice
MOST_PIXELS = 2**22
LEAST_ROWS = 24


@dataclass(frozen=True)
class Workspace:
    """Memory for the rays and the filters at work, beside the picture: ``size`` bytes."""

    size: int

    @classmethod
    def beside(
        cls,
        width: int,
        height: int,
        channels: int,
        *,
        pictures: int = 1,
        rays_per_pixel: int = 1,
        memory: int | None = None,
    ) -> Workspace:
        """What is left beside a picture of so many float32 channels, held ``pictures`` times over.

        ``rays_per_pixel``: which are traced at once. ``memory``: bytes for all of it; by default half of what
        is free. Raises ``UsageError`` where that does not suffice.
        """
        pixels = width * height
        budget = memory if memory is not None else free_memory() // 2
        finished = pixels * (pictures * channels * BYTES_PER_CHANNEL + BYTES_TO_WRITE) + BYTES_OF_KERNELS
        least = max(
            max(min(LEAST_RAYS, pixels), rays_per_pixel) * channels * BYTES_PER_CHANNEL_OF_RAY,
            min(LEAST_ROWS, height) * width * BYTES_PER_PIXEL_OF_FILTER,
        )
        allowed = min(budget, all_memory())  # whatever was asked for
        if finished + least > allowed:
            raise UsageError(
                f"a picture of {width}x{height} pixels needs {_text(finished + least)} of memory, "
                f"and {_text(allowed)} may be used: choose a smaller width and height, "
                f"fewer layers or samples, or a larger memory="
            )
        return cls(budget - finished)

    def rays_at_once(self, channels: int) -> int:
        """Rays of one wavefront, which returns so many channels."""
        return max(1, min(self.size // (channels * BYTES_PER_CHANNEL_OF_RAY), MOST_RAYS))

    def rows_at_once(self, width: int) -> int:
        """Rows of a picture that a filter works on at once."""
        return max(1, min(self.size // BYTES_PER_PIXEL_OF_FILTER, MOST_PIXELS) // width)

    def after_rays(self, rays: int, channels: int) -> None:
        """To be called after a pass that traced so many rays at once."""
        self._give_back(rays * channels * BYTES_PER_CHANNEL_OF_RAY)

    def after_filter(self, pixels: int) -> None:
        """To be called after a pass that filtered so many pixels at once."""
        self._give_back(pixels * BYTES_PER_PIXEL_OF_FILTER)

    def _give_back(self, used: int) -> None:
        """Give the system what Dr.Jit keeps for reuse, after a pass that used much.

        A frame has up to four passes, and one seldom reuses another's arrays: they differ in size.
        """
        import drjit as dr

        if used > self.size // 4:
            dr.flush_malloc_cache()


def free_memory() -> int:
    """Bytes that can be had without swapping; where the system does not tell, all there are."""
    try:
        with open("/proc/meminfo") as file:
            fields = dict(line.split(":", 1) for line in file)
        return int(fields["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return all_memory()


def all_memory() -> int:
    """Bytes that the machine has."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _text(count: float) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
