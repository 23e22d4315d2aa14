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
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mrt_mitsuba.cores import usable_cores
from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.output.files import to_8bit
from mrt_mitsuba.output.replacing import check_target, replacing
from mrt_mitsuba.validation.tools.study import Image, Study, Table

DOTS_PER_INCH = 110
COLUMN = 6.5  # inches from which on a plot has a row of the page to itself, too
BROAD = 2  # width over height from which on a picture has a row of the page to itself
VALIDATION = "Validation of mrt-mitsuba"


def machine() -> dict[str, Any]:
    """Return the number of cores and the system, without the name of the machine."""
    return {"cores": usable_cores(), "system": f"{platform.system()} {platform.machine()}"}


def versions() -> dict[str, str]:
    """Return the versions of everything that bears on speed or accuracy, by name."""
    import drjit as dr
    import mitsuba as mi

    import mrt_mitsuba

    usable = dr.has_backend(dr.JitBackend.LLVM)
    return {
        "version": mrt_mitsuba.__version__,
        "mitsuba": mi.MI_VERSION,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, dr.detail.llvm_version())) if usable else "none",
        "python": platform.python_version(),
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
    images: dict[int, dict[str, Any]] = {}  # as the page shows them, by the id of the part
    for study in studies:
        for part in study.parts:
            if isinstance(part, str):
                continue
            stem = "-".join(
                re.sub(r"[^A-Za-z0-9.]+", "-", n).strip("-.").lower() for n in (study.name, part.name)
            )
            if isinstance(part, Table):
                text = io.StringIO()
                csv.writer(text, lineterminator="\n").writerows([part.columns, *part.rows])
                _write(place / f"{stem}.csv", text.getvalue().encode())
            else:
                images[id(part)] = _drawn(part)
                _write(place / f"{stem}.png", images[id(part)]["data"])
    result = {
        **versions(),
        **machine(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "quick": quick,
        "passed": all(study.passed for study in studies),
        "studies": {study.name: study.summary() for study in studies},
    }
    _write(place / "summary.json", json.dumps(result, indent=2, allow_nan=False).encode() + b"\n")
    template = (files("mrt_mitsuba.validation.tools") / "templates" / "report.html").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters |= {"cell": cell, "id": id}
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode()
    shown = {**result, "studies": studies, "images": images, "title": title, "explain": title == VALIDATION}
    _write(place / "index.html", environment.from_string(template).render(shown).encode())


def notebook(study: Study, *, title: str) -> str:
    """Return the page of a study as a frame for a notebook, whose own style it leaves alone."""
    with tempfile.TemporaryDirectory() as folder:
        save(folder, study, title=title)
        page = (Path(folder) / "index.html").read_text("utf-8")
    return f'<iframe srcdoc="{html.escape(page)}" style="width: 100%; height: 40rem; border: 0"></iframe>'


def _drawn(image: Image) -> dict[str, Any]:
    """Return the bytes of a PNG, the class of the picture, and whether it has a row of the page to itself."""
    import PIL.Image

    buffer, content = io.BytesIO(), image.content
    if isinstance(content, np.ndarray):
        PIL.Image.fromarray(to_8bit(content, "srgb")).save(buffer, format="PNG")
        return {
            "data": buffer.getvalue(),
            "kind": "picture",
            "broad": content.shape[1] > BROAD * len(content),
        }
    content.savefig(buffer, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight", facecolor="white")
    return {"data": buffer.getvalue(), "kind": "plot", "broad": content.get_figwidth() > COLUMN}


def cell(value: Any) -> str:
    """Return a value as people read it: floats to four digits, the rest as it is."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as file:
        file.write(data)
