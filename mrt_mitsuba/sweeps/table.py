"""The table of a sweep: a row for each job that ended, in memory and as CSV."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.output.replacing import check_target, replacing
from mrt_mitsuba.sweeps.jobs import Job, word

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


class Table:
    """The outcome of each job of a sweep.

    ``folder``: of the pictures, whose ``table.csv`` it is; ``keys``: of the grid; ``earlier``: the facts that
    the file held before, by the name of the picture.

    Raises ``OutputError`` for a ``table.csv`` that no sweep made, or that cannot be written.
    """

    def __init__(self, folder: str, keys: tuple[str, ...], jobs: Sequence[Job]) -> None:
        self.folder, self.keys = folder, keys
        self._parameters = {job.name: job.parameters for job in jobs}
        self._ended: dict[str, dict[str, Any]] = {}
        self._path = os.path.join(folder, "table.csv")
        self._written = 0.0
        check_target(self._path)
        self.earlier = _read(self._path)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A dict for each job that ended, in the order of the grid.

        Its parameters by key, then "file" (its name in the folder, "" without one), "error" ("" without one),
        "seconds", "rays", "rmse", "attempts", "worker" and "versions". None stands for the
        unknown: what an earlier sweep did not record, an error that the render did not estimate.
        """
        return [self._ended[name] for name in self._parameters if name in self._ended]

    @property
    def failed(self) -> list[dict[str, Any]]:
        """The rows of jobs that left no picture."""
        return [row for row in self.rows if row["error"]]

    def __len__(self) -> int:
        return len(self._ended)

    def __str__(self) -> str:
        return f"{len(self) - len(self.failed)} of {len(self._parameters)} pictures in {self.folder}"

    def add(self, name: str, facts: Mapping[str, Any]) -> None:
        """Add the row of a job that ended; the file follows once in a while."""
        self._ended[name] = {
            **self._parameters[name],
            **dict.fromkeys(FACTS),
            "file": "",
            "error": "",
            **facts,
        }
        if time.monotonic() > self._written + PAUSE:
            self.write()

    def write(self) -> None:
        """Write the file, which replaces the one before when it is complete."""
        text = io.StringIO()
        writer = csv.DictWriter(text, (*self.keys, *FACTS), lineterminator="\n")
        writer.writeheader()
        for row in self.rows:
            cells = {key: value for key, value in row.items() if isinstance(value, str | float | int | None)}
            for key in row.keys() - cells.keys():
                value = row[key]
                cells[key] = (
                    json.dumps(value, default=word) if isinstance(value, list | tuple) else word(value)
                )
            writer.writerow(cells)
        with replacing(self._path) as (file,):
            file.write(text.getvalue().encode())
        self._written = time.monotonic()


def _read(path: str) -> dict[str, dict[str, Any]]:
    """Return the facts of an earlier table by the name of the file."""
    if not os.path.exists(path):
        return {}
    rows: list[dict[str, str]] = []
    columns: Sequence[str] = ()
    with (
        contextlib.suppress(OSError, UnicodeDecodeError, csv.Error),
        open(path, encoding="utf-8", newline="") as file,
    ):
        reader = csv.DictReader(file)
        rows, columns = list(reader), reader.fieldnames or ()
    if tuple(columns[-len(FACTS) :]) != tuple(FACTS):
        raise OutputError(f"{path} is not the table of a sweep: move it away, or choose another folder")
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        facts = found.setdefault(row["file"], {})
        for name, kind in FACTS.items():
            with contextlib.suppress(ValueError, TypeError):
                facts[name] = kind(row[name])
    return found
