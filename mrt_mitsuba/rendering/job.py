"""A render under way: where it reports, how much it does at once, and what it costs."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from mrt_mitsuba.memory import Workspace
from mrt_mitsuba.rendering.progress import Advance, Progress

log = logging.getLogger(__name__)

SECONDS = 0.1  # between two looks at what kernels took


@dataclass
class Kernels:
    """The work of Dr.Jit: kernels launched, and seconds that it compiled and ran them."""

    progress: Progress
    launches: int = 0
    compile: float = 0.0
    run: float = 0.0
    collected: float = 0.0  #: when that was done last

    def collect(self) -> None:
        """Add up what Dr.Jit recorded since the last call. Records hold the kernels' text: many take room."""
        import drjit as dr

        self.collected, records = time.perf_counter(), dr.kernel_history()
        self.progress.kernels(records)
        own = [record for record in records if record["type"] == dr.KernelType.JIT]
        self.launches += len(own)
        self.compile += sum(record["codegen_time"] + record["backend_time"] for record in own) / 1000
        self.run += sum(record["execution_time"] for record in own) / 1000

    def report(self) -> None:
        """Collect where the progress wants to know what ran in a stage."""
        if type(self.progress).kernels is not Progress.kernels:
            self.collect()


@contextmanager
def counting_kernels(progress: Progress) -> Iterator[Kernels]:
    """Let Dr.Jit record its kernels meanwhile, to be collected."""
    import drjit as dr

    kernels = Kernels(progress)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield kernels


@dataclass
class Job:
    """Progress, memory and kernels of a render, and the seconds of its passes."""

    progress: Progress
    workspace: Workspace
    kernels: Kernels
    passes: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of the progress, and measure its time."""
        self.kernels.report()
        start = time.perf_counter()
        with self.progress.stage(name.capitalize(), total, message) as advance:

            def advance_and_collect(steps: int) -> None:
                advance(steps)
                if time.perf_counter() - self.kernels.collected > SECONDS:
                    self.kernels.collect()

            yield advance_and_collect
            self.kernels.report()
        seconds = time.perf_counter() - start
        self.passes[name] = self.passes.get(name, 0.0) + seconds
        log.info("%s: %d pixels in %.3f s", name, total, seconds)
