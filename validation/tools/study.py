"""What a validation study produces: bounds, tables, plots and pictures, collected while it runs.

A study is a module with ``TITLE`` and ``run(study, *, quick)``. It says what it finds through the ``Study``
it is given; ``report`` turns the result into a table on the terminal, ``summary.json``, CSV files and a page.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrt_mitsuba.rendering.progress import Progress


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
        """NaN never holds."""
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit

    def __str__(self) -> str:
        sign = "<=" if self.at_most else ">="
        return (
            f"{'ok    ' if self.holds else 'MISSED'} {self.name}: {self.measured:.4g} {sign} {self.limit:.4g}"
        )


@dataclass(frozen=True)
class Table:
    """Rows of values under named columns; written as CSV under ``name``."""

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""
    first: bool = False  # an answer: shown before the pictures


@dataclass(frozen=True)
class Plot:
    """A matplotlib figure with a caption that says what it shows."""

    name: str
    title: str
    figure: Any
    caption: str = ""


@dataclass(frozen=True)
class Picture:
    """A linear picture [H, W, 3] with a caption; shown in sRGB, and written as EXR where ``exr`` is set."""

    name: str
    title: str
    image: np.ndarray
    caption: str = ""
    exr: bool = False


@dataclass
class Study:
    """The findings of one study, in the order in which they were made."""

    name: str
    title: str
    progress: Progress = field(default_factory=Progress)
    parts: list[Table | Plot | Picture | str] = field(default_factory=list)
    bounds: list[Bound] = field(default_factory=list)
    goals: list[Bound] = field(default_factory=list)  # of speed: shown, but the verdict does not hang on them
    figures: dict[str, float] = field(default_factory=dict)  # single numbers worth keeping, without a bound

    @property
    def passed(self) -> bool:
        return bool(self.bounds) and all(bound.holds for bound in self.bounds)

    def at_most(self, name: str, measured: float, limit: float, note: str = "") -> Bound:
        """Hold a figure to an upper bound."""
        return self._hold(Bound(name, float(measured), float(limit), True, note))

    def at_least(self, name: str, measured: float, limit: float, note: str = "") -> Bound:
        """Hold a figure to a lower bound."""
        return self._hold(Bound(name, float(measured), float(limit), False, note))

    def _hold(self, bound: Bound) -> Bound:
        self.bounds.append(bound)
        return bound

    def goal(self, name: str, measured: float, limit: float, note: str = "") -> None:
        """Show whether a time or a ratio of times is at most so much; a busy machine must fail no study."""
        self.goals.append(Bound(name, float(measured), float(limit), True, note))

    def record(self, name: str, value: float) -> None:
        """Keep a number in the summary."""
        self.figures[name] = float(value)

    def table(
        self,
        name: str,
        title: str,
        columns: Sequence[str],
        rows: Sequence[Sequence[Any]],
        note: str = "",
        *,
        first: bool = False,
    ) -> None:
        """Add a table; ``first``: before the pictures."""
        wrong = [row for row in rows if len(row) != len(columns)]
        if wrong:
            raise ValueError(f"table {name}: {wrong[0]} does not fit the columns {columns}")
        self.parts.append(Table(name, title, columns, rows, note, first))

    def plot(self, name: str, title: str, figure: Any, caption: str = "") -> None:
        """Add a matplotlib figure."""
        self.parts.append(Plot(name, title, figure, caption))

    def picture(
        self, name: str, title: str, image: np.ndarray, caption: str = "", *, exr: bool = False
    ) -> None:
        """Add a linear picture [H, W, 3]."""
        self.parts.append(Picture(name, title, np.asarray(image, np.float32), caption, exr))

    def text(self, paragraph: str) -> None:
        """Add a paragraph."""
        self.parts.append(paragraph)

    @contextmanager
    def stage(self, title: str, total: int) -> Iterator[Any]:
        """Show progress; the value is called with the number of steps just done."""
        with self.progress.stage(title, total) as advance:
            yield advance

    def summary(self) -> Mapping[str, Any]:
        """The study as JSON-ready values; numbers that JSON cannot hold become text."""
        return {
            "title": self.title,
            "passed": self.passed,
            "bounds": [_bound(b) for b in self.bounds],
            "goals": [_bound(b) for b in self.goals],
            "figures": {name: _number(value) for name, value in self.figures.items()},
            "tables": {
                part.name: {
                    "title": part.title,
                    "columns": list(part.columns),
                    "rows": [[_plain(value) for value in row] for row in part.rows],
                }
                for part in self.parts
                if isinstance(part, Table)
            },
        }


def _bound(b: Bound) -> dict[str, Any]:
    return {
        "name": b.name,
        "measured": _number(b.measured),
        "limit": _number(b.limit),
        "sense": "<=" if b.at_most else ">=",
        "holds": b.holds,
        "note": b.note,
    }


def _plain(value: Any) -> Any:
    """A cell of a table as JSON has it."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return _number(value)
    return value if isinstance(value, (bool, int, str)) else str(value)


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)
