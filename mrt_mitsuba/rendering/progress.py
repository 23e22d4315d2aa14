"""Progress of a render: what runs now, and a bar with the time left."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TextIO

from mrt_mitsuba.interrupts import heed
from mrt_mitsuba.machine import Workspace

log = logging.getLogger(__name__)

SECONDS = 0.1  # between two looks at what kernels took
# What the original program prints before a stage
SAID = {"anti-aliasing": "Computing Anti aliasing..", "depth of field": "Computing depth of field.."}

Advance = Callable[[int], object]


class Progress:
    """Receives the progress of a render; this base class ignores it."""

    def plan(self, plan: object) -> None:
        """Receive the render plan, once, before anything is traced."""

    def kernels(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Receive the records of the kernels that Dr.Jit ran since the last call."""

    @contextlib.contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of ``total`` steps, and give a function to call with the number of steps just done.

        ``title`` names the stage on the bar, ``message`` is printed on a line of its own.
        """
        yield lambda steps: None


class TerminalProgress(Progress):
    """Print messages, and a bar if ``bar_file`` is a terminal, or in a notebook.

    ``show_plan``: whether to print the render plan. Messages go to ``file``, bars to ``bar_file``; these
    count in ``unit``.
    """

    def __init__(
        self,
        *,
        show_plan: bool = False,
        unit: str = "px",
        file: TextIO | None = None,
        bar_file: TextIO | None = None,
    ) -> None:
        self.show_plan, self.unit = show_plan, unit
        self.file, self.bar_file = file or sys.stdout, bar_file or sys.stderr

    def plan(self, plan: object) -> None:
        if self.show_plan:
            print(plan, file=self.file, flush=True)

    @contextlib.contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Advance]:
        if message:
            print(message, file=self.file, flush=True)
        if not (self.bar_file.isatty() or "ipykernel" in sys.modules):
            yield lambda steps: None
            return
        from tqdm.auto import tqdm

        looks: Any = {"unit": self.unit, "unit_scale": True, "dynamic_ncols": True, "leave": False}
        with tqdm(total=total, desc=title, file=self.bar_file, **looks) as bar:
            yield bar.update


@dataclass
class Job:
    """A render under way: where it reports, how much it does at once, and what it has cost so far."""

    progress: Progress
    workspace: Workspace
    passes: dict[str, float] = field(default_factory=dict)  #: seconds by name
    rays: Counter[str] = field(default_factory=lambda: Counter(primary=0))  #: traced, by kind
    launches: int = 0  #: of kernels
    compiling: float = 0.0  #: seconds
    running: float = 0.0  #: seconds that kernels ran
    collected: float = 0.0  #: when Dr.Jit's records were read last

    def collect(self) -> None:
        """Add up what Dr.Jit recorded since the last call. Records hold the kernels' text: many take room."""
        import drjit as dr

        self.collected, records = time.perf_counter(), dr.kernel_history()
        self.progress.kernels(records)
        own = [record for record in records if record["type"] == dr.KernelType.JIT]
        self.launches += len(own)
        self.compiling += sum(record["codegen_time"] + record["backend_time"] for record in own) / 1000
        self.running += sum(record["execution_time"] for record in own) / 1000

    @contextlib.contextmanager
    def stage(self, name: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of the progress, and measure its time."""
        start = time.perf_counter()
        self.collect()
        with self.progress.stage(name.capitalize(), total, message or SAID.get(name, "")) as advance:

            def advance_and_collect(steps: int) -> None:
                advance(steps)
                heed()
                if time.perf_counter() - self.collected > SECONDS:
                    self.collect()

            yield advance_and_collect
            self.collect()
        seconds = time.perf_counter() - start
        self.passes[name] = self.passes.get(name, 0.0) + seconds
        log.info("%s: %d pixels in %.3f s", name, total, seconds)
