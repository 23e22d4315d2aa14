"""A render under way: where it reports, how much it does at once, and what it costs."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from mrt_mitsuba.rendering.memory import Workspace
from mrt_mitsuba.rendering.progress import Advance, Progress

log = logging.getLogger(__name__)


@dataclass
class Job:
    """Progress and memory of a render, and the seconds of its passes."""

    progress: Progress
    workspace: Workspace
    passes: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of the progress, and measure its time."""
        start = time.perf_counter()
        with self.progress.stage(name.capitalize(), total, message) as advance:
            yield advance
        seconds = time.perf_counter() - start
        self.passes[name] = self.passes.get(name, 0.0) + seconds
        log.info("%s: %d pixels in %.3f s", name, total, seconds)


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
