"""The findings of a check and their page: what failed comes first, with a program, its output and a plot."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

import drjit as dr
import jinja2
import mitsuba as mi
import numpy as np

from . import plots
from .law import Measurement, Outcome

COLUMNS = ("subject", "law", "verdict", "criterion", "measured", "sense", "limit", "note")


class Findings:
    """Findings of checks, which are saved, and shown in notebooks, as a page."""

    def files(self) -> dict[str, bytes]:
        """The contents of the files that ``save`` writes, by name."""
        raise NotImplementedError

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write a page (``index.html``), ``summary.json`` and ``laws.csv``. Raises ``OSError``."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        for name, data in self.files().items():
            (Path(folder) / name).write_bytes(data)

    def _repr_html_(self) -> str:
        """The page as a frame, which leaves the style of a notebook alone."""
        page = escape(self.files()["index.html"].decode())
        style = "width: 100%; height: 40rem; border: 1px solid #d5d8dd"
        return f'<iframe srcdoc="{page}" style="{style}"></iframe>'


@dataclass(frozen=True)
class Check(Findings):
    """The findings of a check of one plugin: its laws by name."""

    subject: str
    variant: str
    laws: Mapping[str, Outcome]
    seconds: float
    quick: bool = False

    @property
    def failed(self) -> list[str]:
        """Names of the laws that do not hold."""
        return [name for name, law in self.laws.items() if not law.holds]

    @property
    def passed(self) -> bool:
        """True if something was checked and every law that was checked holds."""
        return not self.failed and any(law.parts for law in self.laws.values())

    @property
    def verdict(self) -> str:
        if self.failed:
            return f"FAILED {', '.join(self.failed)}"
        return "passed" if self.passed else "skipped, nothing could be checked"

    def __str__(self) -> str:
        title = f"{self.subject} in {self.variant}: {self.verdict} ({self.seconds:.1f} s)"
        return "\n".join([title, *(f"  {law}" for law in self.laws.values())])

    def files(self) -> dict[str, bytes]:
        return files_of(self.subject, {self.subject: self}, passed=not self.failed)


def files_of(
    name: str, checks: Mapping[str, Check], *, passed: bool, remarks: Sequence[str] = ()
) -> dict[str, bytes]:
    """The contents of ``index.html``, ``summary.json`` and ``laws.csv``. Remarks are lines of the page."""
    rows = io.StringIO()
    table = csv.writer(rows, lineterminator="\n")
    table.writerow(COLUMNS)
    for subject, check in checks.items():
        for law in check.laws.values():
            for part in law.parts or [Measurement("", np.nan, np.nan, note=law.skipped)]:
                numbers = (part.measured, part.sign, part.limit)
                table.writerow([subject, law.name, law.verdict, part.name, *numbers, part.note])
    summary = {
        "title": f"Laws of plugins: {name}",
        "passed": passed,
        "versions": {"mitsuba": mi.__version__, "drjit": dr.__version__},
        "remarks": list(remarks),
    }
    found = {"checks": {subject: _summary(check) for subject, check in checks.items()}}
    text = json.dumps(json.loads(json.dumps(summary | found), parse_constant=str), indent=2)  # NaN as text
    pages = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    page = pages.from_string((Path(__file__).parent / "page.html").read_text("utf-8"))
    failed_first = sorted(checks.items(), key=lambda item: not item[1].failed)
    return {
        "index.html": page.render(summary, checks=failed_first, plot=plots.as_png).encode(),
        "summary.json": text.encode() + b"\n",
        "laws.csv": rows.getvalue().encode(),
    }


def _summary(check: Check) -> dict[str, Any]:
    laws = {
        law.name: {
            "verdict": law.verdict,
            "skipped": law.skipped,
            "notes": law.notes,
            "criteria": [asdict(part) | {"holds": part.holds} for part in law.parts],
            "output": law.output,
        }
        for law in check.laws.values()
    }
    return {
        "passed": check.passed,
        "failed": check.failed,
        "variant": check.variant,
        "quick": check.quick,
        "seconds": round(check.seconds, 2),
        "laws": laws,
    }
