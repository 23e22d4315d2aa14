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
import tempfile
from collections.abc import Sequence
from datetime import datetime, timezone
from importlib import resources
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

DOTS_PER_INCH = 110
# Pictures this many times wider than high, and plots of so many inches, have a row of the page to themselves
BROAD, COLUMN = 2, 6.5
VALIDATION = "Validation of mrt-mitsuba"


def machine() -> dict[str, Any]:
    """Return everything that bears on speed or accuracy, without the name of the machine."""
    found: dict[str, Any] = dict(runtime.versions())
    return {
        "version": found.pop("mrt-mitsuba"),
        **found,
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

    A figure is drawn once: the file and the page hold the same bytes. Raises ``OutputError``.
    """
    import jinja2

    place = Path(folder)
    prepare(place)
    images = {study.name: {n: _drawn(i["content"]) for n, i in study.images.items()} for study in studies}
    for study in studies:
        files = {f"{name}.png": image["data"] for name, image in images[study.name].items()}
        for name, table in study.tables.items():
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([table["columns"], *table["rows"]])
            files[f"{name}.csv"] = text.getvalue().encode()
        for name, data in files.items():
            words = (re.sub(r"[^A-Za-z0-9.]+", "-", n).strip("-.").lower() for n in (study.name, name))
            _write(place / "-".join(words), data)
    result = {
        **machine(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "quick": quick,
        "passed": all(study.passed for study in studies),
        "studies": {study.name: study.summary() for study in studies},
    }
    _write(place / "summary.json", json.dumps(result, indent=2, allow_nan=False).encode() + b"\n")
    template = (resources.files(__package__) / "templates" / "report.html").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters |= {"cell": cell, "base64": lambda data: base64.b64encode(data).decode()}
    shown = {**result, "studies": studies, "images": images, "title": title, "explain": title == VALIDATION}
    _write(place / "index.html", environment.from_string(template).render(shown).encode())


def notebook(study: Study, *, title: str) -> str:
    """Return the page of a study as a frame for a notebook, whose own style it leaves alone."""
    with tempfile.TemporaryDirectory() as folder:
        save(folder, study, title=title)
        page = (Path(folder) / "index.html").read_text("utf-8")
    return f'<iframe srcdoc="{html.escape(page)}" style="width: 100%; height: 40rem; border: 0"></iframe>'


def _drawn(content: Any) -> dict[str, Any]:
    """Return the bytes of a PNG, the class of the picture, and whether it has a row of the page to itself."""
    buffer = io.BytesIO()
    if isinstance(content, np.ndarray):
        kind, broad = "picture", content.shape[1] > BROAD * len(content)
        PIL.Image.fromarray(to_8bit(content.astype(np.float32), "srgb")).save(buffer, format="PNG")
    else:
        kind, broad = "plot", content.get_figwidth() > COLUMN
        content.savefig(buffer, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight", facecolor="white")
    return {"data": buffer.getvalue(), "kind": kind, "broad": broad}


def cell(value: Any) -> str:
    """Return a value as people read it: floats to four digits, the rest as it is."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as (file,):
        file.write(data)
