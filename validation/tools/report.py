"""Output of ``mrt-validate``: a table on the terminal, ``summary.json``, CSV files, pictures and a page."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.output.files import to_8bit, write_exr
from mrt_mitsuba.output.replacing import check_target, replacing
from mrt_mitsuba.validation.tools import machine
from mrt_mitsuba.validation.tools.study import Picture, Plot, Study, Table

LONG_TABLE = 12  # rows from which on a table of the page is folded
LONG_LIST = 30  # bounds from which on they are folded if all hold
DOTS_PER_INCH = 110
COLUMN = 6.5  # inches from which on a plot has a row of the page to itself, too
VALIDATION = "Validation of mrt-mitsuba"
BROAD = 2  # width over height from which on a picture has a row of the page to itself


@dataclass(frozen=True)
class Outcome:
    """A study after its run; ``failure`` is the traceback where it broke off."""

    study: Study
    seconds: float
    failure: str = ""

    @property
    def passed(self) -> bool:
        return not self.failure and self.study.passed

    @property
    def verdict(self) -> str:
        """Return one word: passed, missed (a bound), failed (broke off) or empty (nothing was held)."""
        if self.failure:
            return "failed"
        if not self.study.bounds:
            return "empty"
        return "passed" if self.study.passed else "missed"


def header(*, quick: bool) -> dict[str, Any]:
    """Return what the figures were made with."""
    found = machine.versions()
    return {
        "version": found.pop("mrt-mitsuba"),
        **found,
        **machine.machine(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "quick": quick,
    }


def summary(outcomes: Sequence[Outcome], about: Mapping[str, Any]) -> dict[str, Any]:
    """Return everything that was found, as JSON-ready values."""
    studies = {
        outcome.study.name: {
            **outcome.study.summary(),
            "passed": outcome.passed,
            "verdict": outcome.verdict,
            "failure": outcome.failure,
            "seconds": round(outcome.seconds, 2),
        }
        for outcome in outcomes
    }
    return {**about, "passed": all(outcome.passed for outcome in outcomes), "studies": studies}


def terminal_table(outcomes: Sequence[Outcome]) -> str:
    """Return the bounds of all studies, one per line, under the verdict on each study."""
    lines = []
    for outcome in outcomes:
        study = outcome.study
        lines += ["", f"{study.name}: {study.title} - {outcome.verdict.upper()} in {outcome.seconds:.1f} s"]
        shown = [*study.bounds, *study.goals]
        width = max((len(bound.name) for bound in shown), default=0)
        lines += [
            f"  {b.verdict:<6} {b.name:<{width}}  {b.measured:>10.4g} {b.sign} {b.limit:.4g}" for b in shown
        ]
        lines += [f"  FAILED {outcome.failure.splitlines()[-1]}"] if outcome.failure else []
    return "\n".join(lines[1:])


def prepare(folder: Path, *names: str) -> None:
    """Make the folder, and find out now whether files of these names can be written there, before the work.

    Raises ``OutputError``.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the folder {folder}: {error.strerror}; choose another --out"
        ) from error
    for name in names:
        check_target(folder / name)


def write(
    folder: Path, outcomes: Sequence[Outcome], about: Mapping[str, Any], *, title: str = VALIDATION
) -> None:
    """Write every file of the report into an existing folder; ``title`` heads the page.

    A figure is drawn once: the file and the page hold the same bytes. Raises ``OutputError``.
    """
    sections = [_section(folder, outcome) for outcome in outcomes]
    result = summary(outcomes, about)
    _write(folder / "summary.json", json.dumps(result, indent=2, allow_nan=False).encode() + b"\n")
    _write(folder / "index.html", _page(sections, result, title).encode())


def save(folder: str | os.PathLike[str], study: Study, *, title: str, quick: bool = False) -> None:
    """Write the report of a tool's study into a folder, made if need be. Raises ``OutputError``."""
    place = Path(folder)
    prepare(place, "summary.json", "index.html")
    write(place, [Outcome(study, study.seconds)], header(quick=quick), title=title)


def notebook(study: Study, *, title: str) -> str:
    """Return the page of a study as a frame for a notebook, whose own style it leaves alone."""
    with tempfile.TemporaryDirectory() as folder:
        save(folder, study, title=title)
        page = (Path(folder) / "index.html").read_text("utf-8")
    return f'<iframe srcdoc="{html.escape(page)}" style="width: 100%; height: 40rem; border: 0"></iframe>'


def _section(folder: Path, outcome: Outcome) -> dict[str, Any]:
    """Write the files of one study and return what the page shows of it."""
    study = outcome.study
    section: dict[str, Any] = {"outcome": outcome, "study": study, "texts": [], "images": [], "tables": []}
    for part in study.parts:
        if isinstance(part, str):
            section["texts"].append(part)
            continue
        stem = f"{_slug(study.name)}-{_slug(part.name)}"
        if isinstance(part, Table):
            _write(folder / f"{stem}.csv", _csv(part))
            section["tables"].append(
                {"part": part, "numeric": _numeric(part), "folded": len(part.rows) >= LONG_TABLE}
            )
            continue
        png = _plot_png(part) if isinstance(part, Plot) else _picture_png(part)
        _write(folder / f"{stem}.png", png)
        if isinstance(part, Picture) and part.exr:
            write_exr(folder / f"{stem}.exr", part.image)
        section["images"].append(
            {
                "part": part,
                "data": base64.b64encode(png).decode(),
                "kind": type(part).__name__.lower(),
                "broad": _is_broad(part),
            }
        )
    return section


def _is_broad(part: Plot | Picture) -> bool:
    """Return whether an image needs the whole width of the page to be read."""
    if isinstance(part, Picture):
        return part.image.shape[1] > BROAD * part.image.shape[0]
    return bool(part.figure.get_figwidth() > COLUMN)


def _page(sections: Sequence[Mapping[str, Any]], result: Mapping[str, Any], title: str) -> str:
    """Return the self-contained HTML page."""
    from importlib.resources import files

    import jinja2

    template = (files("mrt_mitsuba.validation.tools") / "templates" / "report.html").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["cell"] = cell
    return environment.from_string(template).render(
        sections=sections, long_list=LONG_LIST, title=title, explain=title == VALIDATION, **result
    )


def cell(value: Any) -> str:
    """Return a value as people read it: floats to four digits, the rest as it is."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    try:
        return value if isinstance(value, str) else f"{float(value):.4g}"
    except (TypeError, ValueError):
        return str(value)


def _numeric(table: Table) -> list[bool]:
    """Return which columns hold numbers only, and are set flush right."""
    import numbers

    columns = zip(*table.rows, strict=True) if table.rows else [[]] * len(table.columns)
    return [all(isinstance(value, numbers.Number) for value in column) for column in columns]


def _csv(table: Table) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(table.rows)
    return text.getvalue().encode()


def _plot_png(plot: Plot) -> bytes:
    buffer = io.BytesIO()
    plot.figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight", facecolor="white")
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None:  # which keeps every figure that it made
        pyplot.close(plot.figure)
    return buffer.getvalue()


def _picture_png(picture: Picture) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(to_8bit(picture.image, "srgb")).save(buffer, format="PNG")
    return buffer.getvalue()


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as file:
        file.write(data)


def _slug(name: str) -> str:
    """Return a name that is safe in file names."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", name).strip("-.").lower()
