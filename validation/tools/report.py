"""Output of ``mrt-validate``: a table on the terminal, ``summary.json``, CSV files, pictures and a page."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import os
import platform
import re
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.output.files import to_8bit
from mrt_mitsuba.output.replacing import check_target, replacing
from mrt_mitsuba.validation.tools.study import Study

# Pictures this many times wider than high, and plots of so many inches, have a row of the page to themselves
BROAD, COLUMN = 2, 6.5
VALIDATION = "Validation of mrt-mitsuba"


def machine() -> dict[str, Any]:
    """Return everything that bears on speed or accuracy, without the name of the machine."""
    versions = dict(runtime.versions())
    return {
        "version": versions.pop("mrt-mitsuba"),
        **versions,
        "python": platform.python_version(),
        "cores": usable_cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def terminal_table(studies: Sequence[Study]) -> str:
    """Return the bounds of all studies, one per line, under the verdict on each study."""
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


def prepare(folder: Path, *names: str, inputs: Sequence[str] = ()) -> None:
    """Make the folder, and find out now whether files of these names can be written there, before the work.

    By default those of a report; none of them may be one of the ``inputs``. Raises ``OutputError``.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = f"cannot make the folder {folder}: {error.strerror}; choose another --out"
        raise OutputError(problem) from error
    for name in names or ("summary.json", "index.html"):
        check_target(folder / name, inputs)


def save(
    folder: str | os.PathLike[str], *studies: Study, title: str = VALIDATION, quick: bool = False
) -> None:
    """Write every file of the report into a folder, made if need be; ``title`` heads the page.

    Raises ``OutputError``.
    """
    prepare(Path(folder))
    for name, data in _files(studies, title, quick).items():
        with replacing(Path(folder) / name) as (file,):
            file.write(data)


def notebook(study: Study, *, title: str) -> str:
    """Return the page of a study as a frame for a notebook, whose own style it leaves alone."""
    page = html.escape(_files([study], title)["index.html"].decode())
    return f'<iframe srcdoc="{page}" style="width: 100%; height: 40rem; border: 0"></iframe>'


def _files(studies: Sequence[Study], title: str, quick: bool = False) -> dict[str, bytes]:
    """Return every file of the report by name. A figure is drawn once, for its file and for the page."""
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
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    pages = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    pages.filters |= {"cell": cell, "base64": lambda data: base64.b64encode(data).decode()}
    shown = {**result, "studies": studies, "images": images, "title": title, "explain": title == VALIDATION}
    page = pages.get_template("report.html").render(shown)
    summary = json.dumps(result, indent=2, allow_nan=False) + "\n"
    return files | {"summary.json": summary.encode(), "index.html": page.encode()}


def _drawn(content: Any) -> dict[str, Any]:
    """Return the bytes of a PNG, the class of the picture, and whether it has a row of the page to itself."""
    buffer = io.BytesIO()
    if isinstance(content, np.ndarray):
        kind, broad = "picture", content.shape[1] > BROAD * len(content)
        PIL.Image.fromarray(to_8bit(content.astype(np.float32), "srgb")).save(buffer, format="PNG")
    else:
        kind, broad = "plot", content.get_figwidth() > COLUMN
        content.savefig(buffer, format="png", dpi=110, bbox_inches="tight", facecolor="white")
    return {"data": buffer.getvalue(), "kind": kind, "broad": broad}


def cell(value: Any) -> str:
    """Return a value as people read it: floats to four digits, a dash for what is not known."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)
