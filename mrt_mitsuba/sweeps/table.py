"""The table of a sweep: a row for each job that ended, in memory and as CSV."""

from __future__ import annotations

import csv
import io
import json
import os
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.sweeps.grid import word

FILE = "table.csv"
FACTS = {
    "file": str,
    "error": str,
    "seconds": float,
    "rays": int,
    "rmse": float,
    "attempts": int,
    "worker": str,
    "versions": str,
}
PAUSE = 1.0  # seconds from one writing to the next, so that short jobs do not rewrite it all the time


@dataclass(repr=False)
class Table:
    """The outcome of each job of a sweep."""

    folder: str
    keys: tuple[str, ...]  #: of the grid
    jobs: Mapping[str, Mapping[str, Any]]  #: the parameters of every job, by its name
    _ended: dict[str, dict[str, Any]] = field(default_factory=dict)
    _written: float = 0.0

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A dict for each job that ended, in the order of the grid.

        Its parameters by key, then "file" (its name in the folder, "" without one), "error" ("" without one),
        "seconds", "rays", "rmse", "attempts", "worker" and "versions". None stands for the
        unknown: what an earlier sweep did not record, an error that the render did not estimate.
        """
        return [self._ended[name] for name in self.jobs if name in self._ended]

    @property
    def failed(self) -> list[dict[str, Any]]:
        """The rows of jobs that left no picture."""
        return [row for row in self.rows if row["error"]]

    def __contains__(self, name: object) -> bool:
        return name in self._ended

    def __len__(self) -> int:
        return len(self._ended)

    def __str__(self) -> str:
        return f"{len(self) - len(self.failed)} of {len(self.jobs)} pictures in {self.folder}"

    def add(self, name: str, facts: Mapping[str, Any]) -> None:
        """Add the row of a job that ended; the file follows once in a while."""
        row = dict.fromkeys(FACTS) | {"file": "", "error": ""} | dict(facts)
        self._ended[name] = {**self.jobs[name], **row}
        if time.monotonic() > self._written + PAUSE:
            self.write()

    def keep(self, names: Collection[str], versions: str) -> None:
        """Add the rows of jobs whose pictures an earlier sweep made, as far as its table knows them."""
        known = _read(self.path)
        for name in names:
            file = f"{name}.exr"
            self.add(name, known.get(file, {}) | {"file": file, "error": "", "versions": versions})
        if names:
            self.write()

    @property
    def path(self) -> str:
        """Where the table is written."""
        return os.path.join(self.folder, FILE)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Write the file at the end, whatever is raised inside."""
        try:
            yield
        finally:
            self.write()

    def write(self) -> None:
        """Write the file, which replaces the one before when it is complete."""
        from mrt_mitsuba.output.replacing import replacing

        text = io.StringIO()
        writer = csv.DictWriter(text, (*self.keys, *FACTS), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in self.rows)
        with replacing(self.path) as file:
            file.write(text.getvalue().encode())
        self._written = time.monotonic()


def _read(path: str) -> dict[str, dict[str, Any]]:
    """Return the facts of an earlier table by the name of the file; nothing where it is missing or broken."""
    try:
        with open(path, encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OutputError(f"cannot read {path}: {error}; remove it, and the pictures stay") from error
    return {row["file"]: _facts(row) for row in rows if row.get("file")}


def _facts(row: Mapping[str, str]) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    for name, kind in FACTS.items():
        try:
            facts[name] = kind(row[name])
        except (KeyError, ValueError, TypeError):
            facts[name] = None
    return facts


def _cell(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return json.dumps(value, default=word)
    return value if isinstance(value, str | float | int | None) else word(value)
