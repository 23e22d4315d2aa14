"""Progress of a render: what runs now, and a bar with the time left."""

from __future__ import annotations

import contextlib
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.interrupts import deliver_pending

if TYPE_CHECKING:
    from mrt_mitsuba.adaptive.error import RoundPicture

SECONDS = 0.1  # between two looks at what kernels took

ROUNDS = "Rounds"  # title of the stages in which rays go to where they are needed

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
        yield _ignore


@dataclass(kw_only=True)
class TerminalProgress(Progress):
    """Print messages, and a bar on standard error if that is a terminal, or in a notebook.

    ``show_plan``, ``messages``: whether to print the render plan, and the parameters of the render and
    messages. Bars count in ``unit``, for stages that take longer than ``delay`` seconds.
    """

    show_plan: bool = False
    messages: bool = True
    delay: float = 0.0
    unit: str = "px"

    def plan(self, plan: Any) -> None:  # a ``Plan``
        if self.messages:
            print(plan.parameters(), flush=True)
        if self.show_plan:
            print(plan, flush=True)

    @contextlib.contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Advance]:
        bars = sys.stderr.isatty() or "ipykernel" in sys.modules
        on_bar = message if bars and title == ROUNDS else ""  # one line, which each round updates
        if message and not on_bar and self.messages:
            print(message, flush=True)
        if not bars:
            yield _ignore
            return
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "IProgress not found")  # then bars are text
            from tqdm.auto import tqdm

        looks: Any = {"unit": self.unit, "unit_scale": True, "dynamic_ncols": True, "leave": False}
        looks["delay"] = self.delay
        with tqdm(total=total, desc=title, postfix=on_bar or None, **looks) as bar:
            yield bar.update


def default_progress() -> Progress:
    """Return the progress of a render that is given none: bars in notebooks and on terminals."""
    if "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty()):
        return TerminalProgress(messages=False, delay=0.5)
    return Progress()


def _ignore(steps: int) -> None:
    """Progress callback that does nothing."""


@dataclass
class Timings:
    """Seconds of one render; ``load`` and ``passes`` add up to about ``total``."""

    total: float = 0.0  #: all of the render
    load: float = 0.0  #: scene and plan
    compile: float = 0.0  #: kernels that were not in the cache
    kernels: float = 0.0  #: kernels running
    passes: dict[str, float] = field(default_factory=dict)  #: by the name of the pass

    def __repr__(self) -> str:
        parts = {"load": self.load, **self.passes, "of these: compile": self.compile, "kernels": self.kernels}
        named = ", ".join(f"{name} {seconds:.3g}" for name, seconds in parts.items())
        return f"<Timings: {self.total:.3g} s: {named}>"


class Job:
    """A render under way: where it reports, how much it does at once, and what it has cost so far."""

    workspace: int  #: bytes for rays and filters, known once there is a plan

    def __init__(
        self, progress: Progress, budget: int, on_round: Callable[[RoundPicture], object] | None
    ) -> None:
        self.progress = progress
        self.budget = budget  #: bytes that it may use
        self.on_round = on_round  #: called after each round; stops the render by returning False
        self.timings = Timings()  #: up to now
        self.rays = Counter(primary=0)  #: traced, by kind
        self.launches = 0  #: of kernels
        self._began = time.perf_counter()
        self._collected = 0.0  # when Dr.Jit's records were read last

    def start(self, plan: object, workspace: int) -> None:
        """Begin with a plan, and with the memory next to its picture."""
        self.workspace = workspace
        self.progress.plan(plan)
        self.timings.load = time.perf_counter() - self._began

    def collect(self) -> None:
        """Add up what Dr.Jit recorded since the last call. Records hold the kernels' text: many take room."""
        import drjit as dr

        timings = self.timings
        self._collected = time.perf_counter()
        timings.total = self._collected - self._began
        records = dr.kernel_history()
        self.progress.kernels(records)
        own = [record for record in records if record["type"] == dr.KernelType.JIT]
        self.launches += len(own)
        timings.compile += sum(record["codegen_time"] + record["backend_time"] for record in own) / 1000
        timings.kernels += sum(record["execution_time"] for record in own) / 1000

    @contextlib.contextmanager
    def stage(self, name: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of the progress, and measure its time."""
        start = time.perf_counter()
        self.collect()
        with self.progress.stage(name.capitalize(), total, message) as advance:

            def advance_and_collect(steps: int) -> None:
                advance(steps)
                deliver_pending()
                if time.perf_counter() - self._collected > SECONDS:
                    self.collect()

            yield advance_and_collect
            self.collect()
        seconds = time.perf_counter() - start
        self.timings.passes[name] = self.timings.passes.get(name, 0.0) + seconds
