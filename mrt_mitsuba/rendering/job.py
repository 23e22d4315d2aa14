"""A render under way: where to report, how much to do at once, and what it has cost so far."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrt_mitsuba.rays.bundle import Bundle
from mrt_mitsuba.rendering.memory import Workspace
from mrt_mitsuba.rendering.progress import Advance, Progress
from mrt_mitsuba.rendering.trace import CHANNELS, Camera, Planes, Tracer, trace_bundle

log = logging.getLogger(__name__)

# Layers that count rays, by the kind of ray
SECONDARY_RAYS = {"mirror": "bounces", "shadow": "shadow_rays"}


@dataclass
class Job:
    """``passes``: seconds of each; ``rays``: how many of each kind."""

    progress: Progress
    workspace: Workspace
    passes: dict[str, float] = field(default_factory=dict)
    rays: dict[str, int] = field(default_factory=lambda: {"primary": 0})

    @contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of the progress, and measure its time."""
        start = time.perf_counter()
        with self.progress.stage(title, total, message) as advance:
            yield advance
        name, seconds = title.lower(), time.perf_counter() - start
        self.passes[name] = self.passes.get(name, 0.0) + seconds
        log.info("%s: %d pixels in %.3f s", name, total, seconds)

    def trace(
        self,
        tracer: Tracer,
        camera: Camera,
        bundle: Bundle,
        wanted: frozenset[str],
        *,
        seed: int,
        before: int = 0,
    ) -> Iterator[tuple[Any, Planes]]:
        """Trace a bundle in parts that fit into memory, see ``trace_bundle``, and count its rays."""
        channels = sum(CHANNELS[name] for name in wanted)
        rays = self.workspace.rays_at_once(channels)
        log.debug("tracing %d rays, at most %d at once", bundle.ray_count, rays)
        parts = trace_bundle(tracer, camera, bundle, wanted, seed=seed, before=before, rays_at_once=rays)
        for pixels, planes in parts:
            self._count(len(pixels), bundle.rays_per_pixel, planes)
            yield pixels, planes
        self.workspace.after_rays(min(rays, bundle.ray_count), channels)

    def _count(self, pixels: int, rays_per_pixel: int, planes: Planes) -> None:
        self.rays["primary"] += pixels * rays_per_pixel
        for kind, name in SECONDARY_RAYS.items():
            if name in planes:
                # means over the pixel's rays, counted in float32 ones: exact to 2^24 for each pixel
                count = round(rays_per_pixel * float(np.sum(planes[name][0], dtype=np.float64)))
                self.rays[kind] = self.rays.get(kind, 0) + count


@dataclass
class Kernels:
    """What Dr.Jit did: kernels launched, and seconds that it compiled and ran them."""

    launches: int = 0
    compile: float = 0.0
    run: float = 0.0


@contextmanager
def counting_kernels() -> Iterator[Kernels]:
    """Let Dr.Jit keep a record of its kernels meanwhile; it is added up at the end."""
    import drjit as dr

    kernels = Kernels()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield kernels
        history = dr.kernel_history([dr.KernelType.JIT])
    kernels.launches = len(history)
    kernels.compile = sum(entry["codegen_time"] + entry["backend_time"] for entry in history) / 1000
    kernels.run = sum(entry["execution_time"] for entry in history) / 1000
