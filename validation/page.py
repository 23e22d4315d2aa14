"""The report of studies: a page, ``summary.json``, CSV files and pictures."""

from __future__ import annotations

import base64
import csv
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

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import needs_extra
from mrt_mitsuba.files.images import png
from mrt_mitsuba.files.replacing import check_target, make_folder, replacing
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.validation.study import Study, Values

VALIDATION = "Validation of mrt-mitsuba"


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


def prepare_folder(folder: Path, *names: str, inputs: Sequence[str] = ()) -> None:
    """Make the folder, and find out now whether files of these names can be written there, before the work.

    The names default to those of a report; no file may be one of the ``inputs``. Raises ``OutputError``.
    """
    make_folder(folder)
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
            writer = csv.DictWriter(text, [*table["rows"][0]], lineterminator="\n")
            writer.writeheader()
            writer.writerows(table["rows"])
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
    """Return the bytes of a PNG, and whether it shows a picture or a plot."""
    if isinstance(content, np.ndarray):
        kind = "picture"
        data = png(content)
    else:
        kind = "plot"
        buffer = io.BytesIO()
        content.savefig(buffer, format="png", dpi=110, bbox_inches="tight", facecolor="white")
        data = buffer.getvalue()
    return {"data": data, "base64": base64.b64encode(data).decode(), "kind": kind}


def cell(value: object) -> str:
    """Return a value as text: four significant digits, yes or no, a dash for None and NaN."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)
