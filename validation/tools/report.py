"""Output of ``mrt-validate``: a table on the terminal, ``summary.json``, CSV files, pictures and a page."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import numbers
import os
import platform
import re
import sys
import tempfile
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from mrt_mitsuba.cores import usable_cores
from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.output.files import to_8bit, write_exr
from mrt_mitsuba.output.replacing import check_target, replacing
from mrt_mitsuba.validation.tools.study import Study, Table

LONG_TABLE = 12  # rows from which on a table of the page is folded
LONG_LIST = 30  # bounds from which on they are folded if all hold
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
    from importlib.resources import files

    import jinja2

    place = Path(folder)
    prepare(place)
    sections = [_section(place, study) for study in studies]
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
    environment.filters["cell"] = cell
    page = environment.from_string(template).render(
        sections=sections, long_list=LONG_LIST, title=title, explain=title == VALIDATION, **result
    )
    _write(place / "index.html", page.encode())


def notebook(study: Study, *, title: str) -> str:
    """Return the page of a study as a frame for a notebook, whose own style it leaves alone."""
    with tempfile.TemporaryDirectory() as folder:
        save(folder, study, title=title)
        page = (Path(folder) / "index.html").read_text("utf-8")
    return f'<iframe srcdoc="{html.escape(page)}" style="width: 100%; height: 40rem; border: 0"></iframe>'


def _section(folder: Path, study: Study) -> dict[str, Any]:
    """Write the files of one study and return what the page shows of it."""
    import PIL.Image

    section: dict[str, Any] = {"study": study, "texts": [], "images": [], "tables": []}
    for part in study.parts:
        if isinstance(part, str):
            section["texts"].append(part)
            continue
        stem = f"{_slug(study.name)}-{_slug(part.name)}"
        if isinstance(part, Table):
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([part.columns, *part.rows])
            _write(folder / f"{stem}.csv", text.getvalue().encode())
            columns = zip(*part.rows, strict=True) if part.rows else [[]] * len(part.columns)
            numeric = [all(isinstance(value, numbers.Number) for value in column) for column in columns]
            folded = len(part.rows) >= LONG_TABLE
            section["tables"].append({"part": part, "numeric": numeric, "folded": folded})
            continue
        buffer = io.BytesIO()
        if part.is_plot:
            kind, broad = "plot", part.content.get_figwidth() > COLUMN
            part.content.savefig(
                buffer, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight", facecolor="white"
            )
            if "matplotlib.pyplot" in sys.modules:  # which keeps every figure that it made
                sys.modules["matplotlib.pyplot"].close(part.content)
        else:
            kind, broad = "picture", part.content.shape[1] > BROAD * part.content.shape[0]
            PIL.Image.fromarray(to_8bit(part.content, "srgb")).save(buffer, format="PNG")
        _write(folder / f"{stem}.png", buffer.getvalue())
        if part.exr:
            write_exr(folder / f"{stem}.exr", part.content)
        data = base64.b64encode(buffer.getvalue()).decode()
        section["images"].append({"part": part, "data": data, "kind": kind, "broad": bool(broad)})
    return section


def cell(value: Any) -> str:
    """Return a value as people read it: floats to four digits, the rest as it is."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, str)):
        return str(value)
    try:
        return f"{float(value):.4g}"
    except (TypeError, ValueError):
        return str(value)


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as file:
        file.write(data)


def _slug(name: str) -> str:
    """Return a name that is safe in file names."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", name).strip("-.").lower()
