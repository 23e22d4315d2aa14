"""Validation studies: the findings collected while they run, timing, and the report.

A study is a module with ``TITLE`` and ``run(study, *, quick)``. It states its findings through the ``Study``
it is given. The report is a table on the terminal, ``summary.json``, CSV files, pictures and a page.
"""

from __future__ import annotations

import base64
import csv
import gc
import html
import io
import json
import os
import platform
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import OutputError, needs_extra
from mrt_mitsuba.files.images import png
from mrt_mitsuba.files.replacing import check_target, replacing
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.rendering.progress import Progress

VALIDATION = "Validation of mrt-mitsuba"
Values = dict[str, Any]  # by name: a row of a table, options, what describes a picture
Item = TypeVar("Item")
Run = Callable[..., object]  # a render, or another task that takes time


@dataclass(frozen=True)
class Bound:
    """A figure and the limit it is held to; one with an ``interval`` is a goal, open within it."""

    name: str
    measured: float
    limit: float
    at_most: bool = True  # else: at least
    note: str = ""
    interval: Sequence[float] | None = field(default=None, kw_only=True)

    @property
    def holds(self) -> bool:
        """Whether the figure is within the limit; NaN never is."""
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit

    @property
    def sign(self) -> str:
        return "<=" if self.at_most else ">="

    @property
    def verdict(self) -> str:
        """One word: ok or MISSED; for a goal "goal" (reached), slower or open."""
        if self.interval is None:
            return "ok" if self.holds else "MISSED"
        low, high = self.interval
        return "goal" if high <= self.limit else "slower" if low > self.limit else "open"

    def __str__(self) -> str:
        return f"{self.verdict:<6} {self.name}: {self.measured:.4g} {self.sign} {self.limit:.4g}"

    def as_dict(self) -> Values:
        """The values of ``summary.json``."""
        figures = {"measured": self.measured, "limit": self.limit, "sense": self.sign}
        return {"name": self.name, **figures, "holds": self.holds, "verdict": self.verdict, "note": self.note}


@dataclass
class Study:
    """The findings of one study, by name in the order in which they were made."""

    name: str
    title: str
    progress: Progress = field(default_factory=Progress)
    texts: list[str] = field(default_factory=list)  # paragraphs
    tables: dict[str, Values] = field(default_factory=dict)  # title, columns, rows, note, first
    images: dict[str, Values] = field(default_factory=dict)  # title, content, caption
    bounds: list[Bound] = field(default_factory=list)
    goals: list[Bound] = field(default_factory=list)  # of speed: shown, but the verdict ignores them
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

    def at_most(self, name: str, measured: float, limit: float, note: str) -> None:
        """Hold a figure to an upper bound; ``note``: why it is this one."""
        self.bounds.append(Bound(name, float(measured), float(limit), True, note))

    def at_least(self, name: str, measured: float, limit: float, note: str) -> None:
        """Hold a figure to a lower bound; ``note``: why it is this one."""
        self.bounds.append(Bound(name, float(measured), float(limit), False, note))

    def goal(self, name: str, measured: float, limit: float, note: str, *, interval: Sequence[float]) -> None:
        """Show whether a time or a ratio of times is within a limit; a busy machine must fail no study."""
        self.goals.append(Bound(name, float(measured), float(limit), note=note, interval=interval))

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
        columns = [*rows[0]] if rows else []
        values = [[*row.values()] for row in rows]
        self.tables[name] = {"title": title, "columns": columns, "rows": values, "note": note, "first": first}

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
        """The study in values of JSON; infinite and undefined numbers become text."""

        def plain(value: object) -> object:
            return value.item() if isinstance(value, np.generic) else str(value)

        found = {
            "title": self.title,
            "bounds": [bound.as_dict() for bound in self.bounds],
            "goals": [goal.as_dict() for goal in self.goals],
            "tables": self.tables,
            "passed": self.passed,
            "verdict": self.verdict,
            "failure": self.failure,
            "seconds": round(self.seconds, 2),
        }
        text = json.dumps(found, default=plain)
        return dict(json.loads(text, parse_constant=str))


def findings(part: Callable[..., None], **options: Any) -> Study:
    """The findings of a part of a study, or of the ``run`` of a whole one."""
    study = Study("", "")
    part(study, **options)
    return study


# ---------------------------------------------- The report ---------------------------------------------


def machine() -> Values:
    """Everything that bears on speed or accuracy, without the name of the machine."""
    versions = dict(runtime.versions())
    return {
        "version": versions.pop("mrt-mitsuba"),
        **versions,
        "python": platform.python_version(),
        "cores": usable_cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def terminal_table(studies: Sequence[Study]) -> str:
    """The bounds of all studies, one per line, under the verdict on each study."""
    lines = []
    for study in studies:
        lines += ["", f"{study.name}: {study.title} - {study.verdict.upper()} in {study.seconds:.1f} s"]
        shown = [*study.bounds, *study.goals]
        width = max((len(bound.name) for bound in shown), default=0)
        lines += [
            f"  {b.verdict:<6} {b.name:<{width}}  {b.measured:>10.4g} {b.sign} {b.limit:.4g}" for b in shown
        ]
        lines += [f"  FAILED {study.failure.splitlines()[-1]}"] if study.failure else []
    return "\n".join(lines[1:])


def prepare_folder(folder: Path, *names: str, inputs: Sequence[str] = ()) -> None:
    """Make the folder, and find out now whether files of these names can be written there, before the work.

    The names default to those of a report; no file may be one of the ``inputs``. Raises ``OutputError``.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = f"cannot make the folder {folder}: {error.strerror}; choose another --out"
        raise OutputError(problem) from error
    for name in names or ("summary.json", "index.html"):
        check_target(folder / name, inputs)


def save_report(
    folder: str | os.PathLike[str], *studies: Study, title: str = VALIDATION, quick: bool = False
) -> None:
    """Write every file of the report into a folder, made if need be; ``title`` heads the page.

    Raises ``OutputError``.
    """
    prepare_folder(Path(folder))
    for name, data in _files(studies, title, quick).items():
        with replacing(Path(folder) / name) as (file,):
            file.write(data)


def notebook(study: Study, *, title: str) -> str:
    """The page of a study as a frame for a notebook, whose own style it leaves alone."""
    page = html.escape(_files([study], title)["index.html"].decode())
    return f'<iframe srcdoc="{page}" style="width: 100%; height: 40rem; border: 1px solid #d5d8dd"></iframe>'


@needs_extra()
def _files(studies: Sequence[Study], title: str, quick: bool = False) -> dict[str, bytes]:
    """Every file of the report by name. A figure is drawn once, for its file and for the page."""
    import jinja2

    files: dict[str, bytes] = {}
    images = {study.name: {n: _drawn(i["content"]) for n, i in study.images.items()} for study in studies}
    for study in studies:
        parts = {f"{name}.png": image["data"] for name, image in images[study.name].items()}
        for name, table in study.tables.items():
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([table["columns"], *table["rows"]])
            parts[f"{name}.csv"] = text.getvalue().encode()
        for name, data in parts.items():
            words = (re.sub(r"[^A-Za-z0-9.]+", "-", n).strip("-.").lower() for n in (study.name, name))
            files["-".join(words)] = data
    result = {
        **machine(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "quick": quick,
        "passed": all(study.passed for study in studies),
        "studies": {study.name: study.summary() for study in studies},
    }
    options: Values = {"autoescape": True, "undefined": jinja2.StrictUndefined, "trim_blocks": True}
    pages = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"), **options)
    pages.filters["cell"] = cell
    shown = {**result, "studies": studies, "images": images, "title": title, "explain": title == VALIDATION}
    files["index.html"] = pages.get_template("report.html").render(shown).encode()
    return files | {"summary.json": json.dumps(result, indent=2, allow_nan=False).encode() + b"\n"}


def _drawn(content: Any) -> Values:
    """The bytes of a PNG, the class of the picture, and whether it has a row of the page to itself."""
    if isinstance(content, np.ndarray):
        kind = "picture"
        broad = content.shape[1] > 2 * len(content)
        data = png(content)
    else:
        kind = "plot"
        broad = content.get_figwidth() > 6.5  # inches
        buffer = io.BytesIO()
        content.savefig(buffer, format="png", dpi=110, bbox_inches="tight", facecolor="white")
        data = buffer.getvalue()
    return {"data": data, "base64": base64.b64encode(data).decode(), "kind": kind, "broad": broad}


def cell(value: object) -> str:
    """A value as people read it: floats to four digits, a dash for an unknown one."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)
