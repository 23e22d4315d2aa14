"""Progress of a render: what runs now, and a bar with the time left where someone is watching."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TextIO

Advance = Callable[[int], object]


class Progress:
    """Receives what a render tells of its progress. This one keeps it to itself."""

    def plan(self, plan: object) -> None:
        """Called once, before anything is traced, with the render plan."""

    def kernels(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Called now and then with what Dr.Jit recorded of its kernels since the last call."""

    @contextlib.contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Advance]:
        """Open a stage of ``total`` steps; the value is called with the number of steps just done.

        ``title`` names the stage on the bar, ``message`` is a line of its own.
        """
        yield lambda steps: None


class TerminalProgress(Progress):
    """Prints messages, and a bar if ``bar_file`` is a terminal, or in a notebook.

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
