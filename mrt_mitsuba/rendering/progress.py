"""Progress of a render: what runs now, and a bar with the time left."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TextIO

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


def default() -> Progress:
    """Return a progress that shows a bar in a notebook, and is silent elsewhere."""
    return TerminalProgress() if "ipykernel" in sys.modules else Progress()


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
        self.show_plan = show_plan
        self.unit = unit
        self.file = file or sys.stdout
        self.bar_file = bar_file or sys.stderr

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

        with tqdm(
            total=total,
            desc=title,
            unit=self.unit,
            unit_scale=True,
            dynamic_ncols=True,
            leave=False,
            file=self.bar_file,
        ) as bar:
            yield bar.update
