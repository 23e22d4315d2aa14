"""Findings of a study while it runs: bounds, tables, figures.

A study is a module with ``TITLE`` and ``run(study, *, quick)``, which states findings through its ``Study``;
``page`` shows them.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation.laws.law import Measurement

Values = dict[str, Any]  # by name: a row of a table, options, what describes a picture
Item = TypeVar("Item")


class Bound(Measurement):
    """A figure and the limit it is held to."""

    def __str__(self) -> str:
        mark = "ok" if self.holds else "MISSED"
        return f"{mark:<6} {self.name}: {self.measured:.4g} {self.sign} {self.limit:.4g}"


@dataclass
class Study:
    """The findings of one study, by name in the order in which they were made."""

    name: str
    title: str
    progress: Progress = field(default_factory=Progress)
    texts: list[str] = field(default_factory=list)  # paragraphs
    tables: dict[str, Values] = field(default_factory=dict)  # title, rows, note, first
    images: dict[str, Values] = field(default_factory=dict)  # title, content, caption
    bounds: list[Bound] = field(default_factory=list)
    seconds: float = 0.0  # that it took
    failure: str = ""  # the traceback where it broke off

    @property
    def passed(self) -> bool:
        return self.verdict == "passed"

    @property
    def verdict(self) -> str:
        """One word: passed, missed (a bound), failed (broke off) or empty (nothing was held)."""
        if self.failure:
            return "failed"
        return "empty" if not self.bounds else "missed" if self.missed else "passed"

    @property
    def missed(self) -> set[str]:
        """The names of the bounds that do not hold."""
        return {bound.name for bound in self.bounds if not bound.holds}

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.title} - {self.verdict.upper()} in {self.seconds:.1f} s"]
        lines += [f"  {bound}" for bound in self.bounds]
        return "\n".join([*lines, *([f"  FAILED {self.failure.splitlines()[-1]}"] if self.failure else [])])

    def at_most(self, name: str, measured: float, limit: float, note: str) -> None:
        """Hold a figure to an upper bound; ``note``: why it is this one."""
        self.bounds.append(Bound(name, float(measured), float(limit), True, note))

    def at_least(self, name: str, measured: float, limit: float, note: str) -> None:
        """Hold a figure to a lower bound; ``note``: why it is this one."""
        self.bounds.append(Bound(name, float(measured), float(limit), False, note))

    def records(
        self,
        name: str,
        title: str,
        rows: Sequence[Mapping[str, object]],
        note: str = "",
        *,
        first: bool = False,
    ) -> None:
        """Add a table of rows that name their values: the columns are those of the first row.

        It is also written as CSV; ``first``: an answer, shown before the pictures.
        """
        self.tables[name] = {"title": title, "rows": rows, "note": note, "first": first}

    def picture(self, name: str, title: str, content: Any, caption: str = "") -> None:
        """Add a linear picture [H, W, 3] or a matplotlib figure, with a caption that says what it shows."""
        self.images[name] = {"title": title, "content": content, "caption": caption}

    def each(self, title: str, items: Collection[Item]) -> Iterator[Item]:
        """Yield items and show progress; frees scenes, which would slow down the kernels of later ones."""
        gc.freeze()  # collecting is quick where what was there before is left alone
        try:
            with self.progress.stage(title, len(items)) as advance:
                for item in items:
                    yield item
                    gc.collect()
                    advance(1)
        finally:
            gc.unfreeze()

    def summary(self) -> Values:
        """Return the study in values of JSON; infinite and undefined numbers become text."""

        def plain(value: object) -> object:
            return value.item() if isinstance(value, np.generic) else str(value)

        bounds = [
            {"name": b.name, "measured": b.measured, "limit": b.limit, "sense": b.sign}
            | {"holds": b.holds, "note": b.note}
            for b in self.bounds
        ]
        found = {
            "title": self.title,
            "bounds": bounds,
            "tables": self.tables,
            "passed": self.passed,
            "verdict": self.verdict,
            "failure": self.failure,
            "seconds": round(self.seconds, 2),
        }
        text = json.dumps(found, default=plain)
        return dict(json.loads(text, parse_constant=str))


def findings(part: Callable[..., None], **options: Any) -> Study:
    """Return the findings of a part of a study, or of the ``run`` of a whole one."""
    study = Study("", "")
    part(study, **options)
    return study
