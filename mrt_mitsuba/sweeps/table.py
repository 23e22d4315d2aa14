"""The table of a sweep: a row for each job that ended, in memory and as CSV."""

from __future__ import annotations

import csv
import io
import json
import os
import time
from collections.abc import Mapping
from contextlib import suppress

from mrt_mitsuba.errors import OutputError, UsageError
from mrt_mitsuba.files.replacing import check_target, replacing
from mrt_mitsuba.options import Values
from mrt_mitsuba.rendering.api import Result
from mrt_mitsuba.sweeps.jobs import Facts, Job, word
from mrt_mitsuba.sweeps.mean import mean_of_seeds

FACTS = {"file": str, "error": str, "seconds": float, "rays": int, "rmse": float, "attempts": int}
FACTS |= {"worker": str, "versions": str}
PAUSE = 1.0  # seconds from one writing to the next, so that short jobs do not rewrite it all the time


class Table:
    """The outcome of each job of a sweep.

    ``folder``: of the pictures and of ``table.csv``; ``points``: values of each job by key, by its name;
    ``earlier``: the facts in the file of an earlier sweep, by the name of the picture.

    Raises ``OutputError`` for a ``table.csv`` that no sweep made, or that cannot be written.
    """

    def __init__(self, folder: str, points: Mapping[str, Values]) -> None:
        self.folder = folder
        self.keys = tuple(next(iter(points.values()), ()))
        self._points = points
        self._ended: dict[str, Facts] = {}
        self._path = os.path.join(folder, "table.csv")
        self._written = 0.0
        check_target(self._path)
        self.earlier = _read(self._path)

    @property
    def rows(self) -> list[Facts]:
        """A dict for each job that ended, in the order of the grid.

        Its parameters by key, then "file" (its name in the folder, "" without one), "error" ("" without one),
        "seconds", "rays", "rmse", "attempts", "worker" and "versions". None stands for what is unknown: what
        an earlier sweep did not record, an error that the render did not estimate.
        """
        return [self._ended[name] for name in self._points if name in self._ended]

    @property
    def failed(self) -> list[Facts]:
        """The rows of jobs that left no picture."""
        return [row for row in self.rows if row["error"]]

    def __str__(self) -> str:
        return f"{self._made} in {self.folder}"

    @property
    def _made(self) -> str:
        return f"{len(self._ended) - len(self.failed)} of {len(self._points)} pictures"

    def mean(self) -> Result:
        """Return the mean of pictures that differ in their seed alone.

        ``error`` is estimated from the spread of the pictures, and so is the layer "error.Y". Raises
        ``UsageError`` for a grid with another axis, and for fewer than two pictures.
        """
        if self.keys != ("seed",):
            raise UsageError(
                f"mean: the pictures differ in {', '.join(self.keys) or 'nothing'}, not in their seed alone"
            )
        if self.failed:
            raise UsageError(f"mean: {self._made} are there: run the sweep again")
        if len(self.rows) < 2:
            raise UsageError("mean: one picture has no spread: give two seeds or more")
        return mean_of_seeds(self.folder, self._job, self.rows)

    def add(self, job: Job, facts: Facts) -> None:
        """Add the row of a job that ended; ``write`` follows at most once a second."""
        self._job = job  # any of them: what they share is that of the mean
        self._ended[job.name] = {
            **self._points[job.name],
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
        writer.writerows({name: _cell(value) for name, value in row.items()} for row in self.rows)
        with replacing(self._path) as (file,):
            file.write(text.getvalue().encode())
        self._written = time.monotonic()


def _cell(value: object) -> str | float | None:
    if isinstance(value, str | float | int | None):
        return value
    return json.dumps(value, default=word) if isinstance(value, list | tuple) else word(value)


def _read(path: str) -> dict[str, Facts]:
    """Return the facts of an earlier table by the name of the picture."""
    facts: dict[str, Facts] = {}
    if not os.path.exists(path):
        return facts
    with suppress(OSError, ValueError, csv.Error), open(path, encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        if FACTS.keys() <= {*(reader.fieldnames or ())}:
            for row in reader:
                known = {name: kind(row[name]) for name, kind in FACTS.items() if row[name]}
                facts[row["file"]] = {"file": ""} | known
            return facts
    raise OutputError(f"{path} is not the table of a sweep: move it away, or choose another folder")
