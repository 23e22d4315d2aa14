"""A render under way: where it reports, how much it does at once, and what it costs."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from mrt_mitsuba.interrupts import heed
from mrt_mitsuba.memory import Workspace
from mrt_mitsuba.rendering.progress import Advance, Progress

log = logging.getLogger(__name__)

SECONDS = 0.1  # between two looks at what kernels took


@dataclass
class Job:
    """Progress and memory of a render, and what it has cost so far."""

    progress: Progress
    workspace: Workspace = field(init=False)
    passes: dict[str, float] = field(default_factory=dict)  #: seconds by name
    rays: dict[str, int] = field(default_factory=lambda: {"primary": 0})  #: traced, by kind
    launches: int = 0  #: of kernels
    compiling: float = 0.0  #: seconds
    running: float = 0.0  #: seconds that kernels ran
    collected: float = 0.0  #: when Dr.Jit's records were read last

    def count(self, kind: str, rays: int) -> None:
        """Add rays of a kind."""
        self.rays[kind] = self.rays.get(kind, 0) + rays

    def collect(self) -> None:
        """Add up what Dr.Jit recorded since the last call. Records hold the kernels' text: many take room."""
        import drjit as dr

        self.collected, records = time.perf_counter(), dr.kernel_history()
        self.progress.kernels(records)
        own = [record for record in records if record["type"] == dr.KernelType.JIT]
        self.launches += len(own)
        self.compiling += sum(record["codegen_time"] + record["backend_time"] for record in own) / 1000
        self.running += sum(record["execution_time"] for record in own) / 1000

    @contextmanager
    def stage(self, name: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of the progress, and measure its time."""
        # does the progress want to know which kernels ran in a stage?
        asked = type(self.progress).kernels is not Progress.kernels
        if asked:
            self.collect()
        start = time.perf_counter()
        with self.progress.stage(name.capitalize(), total, message) as advance:

            def advance_and_collect(steps: int) -> None:
                advance(steps)
                heed()
                if time.perf_counter() - self.collected > SECONDS:
                    self.collect()

            yield advance_and_collect
            if asked:
                self.collect()
        seconds = time.perf_counter() - start
        self.passes[name] = self.passes.get(name, 0.0) + seconds
        log.info("%s: %d pixels in %.3f s", name, total, seconds)
