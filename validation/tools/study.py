"""The findings of a validation study: bounds, tables, plots and pictures, collected while it runs.

A study is a module with ``TITLE`` and ``run(study, *, quick)``. It states its findings through the ``Study``
it is given; ``report`` turns the result into a table on the terminal, ``summary.json``, CSV files and a page.
"""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from mrt_mitsuba.rendering.progress import Progress

Item = TypeVar("Item")
Rows = Sequence[Sequence[Any]]


@dataclass(frozen=True)
class Bound:
    """A figure and the limit it is held to."""

    name: str
    measured: float
    limit: float
    at_most: bool = True  # else: at least
    note: str = ""

    @property
    def holds(self) -> bool:
        """Return whether the figure is within the limit; NaN never is."""
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit

    @property
    def sign(self) -> str:
        return "<=" if self.at_most else ">="

    @property
    def verdict(self) -> str:
        return "ok" if self.holds else "MISSED"

    def __str__(self) -> str:
        return f"{self.verdict:<6} {self.name}: {self.measured:.4g} {self.sign} {self.limit:.4g}"

    def as_dict(self) -> dict[str, Any]:
        """Return the values of ``summary.json``."""
        figures = {"measured": self.measured, "limit": self.limit, "sense": self.sign}
        return {"name": self.name, **figures, "holds": self.holds, "verdict": self.verdict, "note": self.note}


@dataclass(frozen=True)
class Goal(Bound):
    """A time, or a ratio of times, and what is aimed at; decided only where its whole interval is."""

    low: float = -math.inf
    high: float = math.inf

    @property
    def verdict(self) -> str:
        """Return "goal" (reached), "slower", or "open" where the interval holds the limit."""
        return "goal" if self.high <= self.limit else "slower" if self.low > self.limit else "open"


@dataclass(frozen=True)
class Table:
    """Rows of values under named columns; written as CSV under ``name``."""

    name: str
    title: str
    columns: Sequence[str]
    rows: Rows
    note: str = ""
    first: bool = False  # an answer: shown before the pictures


@dataclass(frozen=True)
class Image:
    """A matplotlib figure, or a linear picture [H, W, 3], with a caption that says what it shows."""

    name: str
    title: str
    content: Any
    caption: str = ""


@dataclass
class Study:
    """The findings of one study, in the order in which they were made."""

    name: str
    title: str
    progress: Progress = field(default_factory=Progress)
    parts: list[Table | Image | str] = field(default_factory=list)
    bounds: list[Bound] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)  # of speed: shown, but the verdict does not hang on them
    figures: dict[str, float] = field(default_factory=dict)  # single numbers worth keeping, without a bound
    seconds: float = 0.0  # that it took
    failure: str = ""  # the traceback where it broke off

    @property
    def passed(self) -> bool:
        return self.verdict == "passed"

    @property
    def verdict(self) -> str:
        """Return one word: passed, missed (a bound), failed (broke off) or empty (nothing was held)."""
        if self.failure:
            return "failed"
        return "empty" if not self.bounds else "missed" if self.missed else "passed"

    @property
    def missed(self) -> set[str]:
        """Return the names of the bounds that do not hold."""
        return {bound.name for bound in self.bounds if not bound.holds}

    @property
    def tables(self) -> dict[str, Table]:
        return {part.name: part for part in self.parts if isinstance(part, Table)}

    @property
    def images(self) -> dict[str, Image]:
        """Return plots and pictures."""
        return {part.name: part for part in self.parts if isinstance(part, Image)}

    def at_most(self, name: str, measured: float, limit: float, note: str) -> None:
        """Hold a figure to an upper bound; ``note``: why it is this one."""
        self.bounds.append(Bound(name, float(measured), float(limit), True, note))

    def at_least(self, name: str, measured: float, limit: float, note: str) -> None:
        """Hold a figure to a lower bound; ``note``: why it is this one."""
        self.bounds.append(Bound(name, float(measured), float(limit), False, note))

    def goal(
        self, name: str, measured: float, limit: float, note: str, *, interval: tuple[float, float]
    ) -> None:
        """Show whether a time or a ratio of times is at most so much; a busy machine must fail no study."""
        self.goals.append(Goal(name, float(measured), float(limit), True, note, *map(float, interval)))

    def record(self, name: str, value: float) -> None:
        """Keep a number in the summary."""
        self.figures[name] = float(value)

    def table(
        self,
        name: str,
        title: str,
        columns: Sequence[str],
        rows: Rows,
        note: str = "",
        *,
        first: bool = False,
    ) -> None:
        """Add a table; ``first``: before the pictures."""
        self.parts.append(Table(name, title, columns, rows, note, first))

    def records(
        self, name: str, title: str, rows: Sequence[Mapping[str, Any]], note: str = "", *, first: bool = False
    ) -> None:
        """Add a table of rows that name their values: the columns are those of the first row."""
        self.table(name, title, list(rows[0]), [list(row.values()) for row in rows], note, first=first)

    def plot(self, name: str, title: str, figure: Any, caption: str = "") -> None:
        """Add a matplotlib figure."""
        self.parts.append(Image(name, title, figure, caption))

    def picture(self, name: str, title: str, image: np.ndarray, caption: str = "") -> None:
        """Add a linear picture [H, W, 3]."""
        self.parts.append(Image(name, title, np.asarray(image, np.float32), caption))

    def text(self, paragraph: str) -> None:
        """Add a paragraph."""
        self.parts.append(paragraph)

    def each(self, title: str, items: Collection[Item]) -> Iterator[Item]:
        """Yield items and show progress; frees scenes, which would slow down the kernels of later ones."""
        with self.progress.stage(title, len(items)) as advance:
            for item in items:
                yield item
                gc.collect()
                advance(1)

    def summary(self) -> dict[str, Any]:
        """Return the study as values that JSON can hold; infinite and undefined numbers become text."""
        tables = {
            t.name: {"title": t.title, "columns": t.columns, "rows": t.rows} for t in self.tables.values()
        }
        found = {
            "title": self.title,
            "bounds": [bound.as_dict() for bound in self.bounds],
            "goals": [goal.as_dict() for goal in self.goals],
            "figures": self.figures,
            "tables": tables,
            "passed": self.passed,
            "verdict": self.verdict,
            "failure": self.failure,
            "seconds": round(self.seconds, 2),
        }
        text = json.dumps(found, default=lambda v: v.item() if isinstance(v, np.generic) else str(v))
        values: dict[str, Any] = json.loads(text, parse_constant=str)
        return values


def findings(part: Callable[..., None], **options: Any) -> Study:
    """Return what a part of a study, or the ``run`` of a whole one, finds."""
    study = Study("", "")
    part(study, **options)
    return study
