"""The findings of a check and their page: what failed comes first, with a program, its output and a plot."""

from __future__ import annotations

import base64
import csv
import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .law import Measurement, Outcome

STYLE = """
body { margin: 0 auto; padding: 1rem; max-width: 76rem; color: #1c1e21; background: #fff;
       font: 1rem/1.5 system-ui, "DejaVu Sans", sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.3rem; } h3 { font-size: 1.1rem; margin-bottom: .2rem; }
section, article { border-top: 1px solid #d5d8dd; margin-top: 1rem; }
p { max-width: 46rem; margin: .4rem 0; }
.mild { color: #5b616b; font-size: .875rem; }
.good { color: #13703a; } .bad { color: #b3261e; font-weight: 600; }
.both { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); }
.both > div { min-width: 0; }
h4 { margin: .5rem 0 .2rem; font-size: .875rem; }
pre { background: #f4f5f7; padding: .6rem; margin: 0; font-size: .75rem; white-space: pre-wrap; }
img { display: block; max-width: 100%; height: auto; }
table { border-collapse: collapse; font-size: .875rem; margin: .4rem 0; }
th, td { text-align: left; vertical-align: top; padding: .25rem .6rem .25rem 0;
         border-bottom: 1px solid #d5d8dd; }
td.number { white-space: nowrap; }
summary { cursor: pointer; margin: .6rem 0; }
@media (max-width: 40rem) {
  table, tbody, tr, td { display: block; } thead { display: none; }
  td { border: 0; padding: 0; } tr { border-bottom: 1px solid #d5d8dd; padding: .3rem 0; }
}
"""
COLUMNS = ("subject", "law", "verdict", "criterion", "measured", "sense", "limit", "note")


@dataclass(frozen=True)
class Check:
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
        """Whether something was checked and every law that was checked holds."""
        return not self.failed and any(law.parts for law in self.laws.values())

    @property
    def verdict(self) -> str:
        if self.failed:
            return f"FAILED {', '.join(self.failed)}"
        return "passed" if self.passed else "skipped, nothing could be checked"

    def __str__(self) -> str:
        title = f"{self.subject} in {self.variant}: {self.verdict} ({self.seconds:.1f} s)"
        return "\n".join([title, *(f"  {law}" for law in self.laws.values())])

    def save(self, folder: str | Path) -> None:
        """Write a page (``index.html``), ``summary.json`` and ``laws.csv``. Raises ``OSError``."""
        write(folder, files({self.subject: self}, f"Laws of plugins: {self.subject}"))

    def _repr_html_(self) -> str:
        return frame({self.subject: self}, f"Laws of plugins: {self.subject}")


def files(checks: Mapping[str, Check], title: str, remarks: Sequence[str] = ()) -> dict[str, bytes]:
    """The contents of ``index.html``, ``summary.json`` and ``laws.csv``. Remarks are lines of the page."""
    rows = io.StringIO()
    table = csv.writer(rows, lineterminator="\n")
    table.writerow(COLUMNS)
    for name, check in checks.items():
        for law in check.laws.values():
            for part in law.parts or [Measurement("", np.nan, np.nan, note=law.skipped)]:
                numbers = (part.measured, part.sign, part.limit)
                table.writerow([name, law.name, law.verdict, part.name, *numbers, part.note])
    summary = {
        "title": title,
        "passed": not any(check.failed for check in checks.values()),
        "versions": {"mitsuba": mi.__version__, "drjit": dr.__version__},
        "remarks": list(remarks),
        "checks": {name: _summary(check) for name, check in checks.items()},
    }
    text = json.dumps(json.loads(json.dumps(summary), parse_constant=str), indent=2)  # NaN as text
    return {
        "index.html": _page(checks, title, remarks).encode(),
        "summary.json": text.encode() + b"\n",
        "laws.csv": rows.getvalue().encode(),
    }


def write(folder: str | os.PathLike[str], contents: Mapping[str, bytes]) -> None:
    """Write files into a folder, made if need be, none of them in part. Raises ``OSError``."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, data in contents.items():
        part = Path(folder) / f".{name}.part"
        part.write_bytes(data)
        part.replace(Path(folder) / name)


def frame(checks: Mapping[str, Check], title: str, remarks: Sequence[str] = ()) -> str:
    """The page as a frame for a notebook, whose own style it leaves alone."""
    page = escape(_page(checks, title, remarks))
    return f'<iframe srcdoc="{page}" style="width: 100%; height: 40rem; border: 1px solid #d5d8dd"></iframe>'


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


def _page(checks: Mapping[str, Check], title: str, remarks: Sequence[str]) -> str:
    failed = any(check.failed for check in checks.values())
    body = [f"<h1>{escape(title)} {_mark('not passed' if failed else 'passed', not failed)}</h1>"]
    body += [f"<p>{escape(remark)}</p>" for remark in remarks]
    for name, check in sorted(checks.items(), key=lambda item: not item[1].failed):  # what failed comes first
        body += _section(name, check)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body>\n"
        + "\n".join(body)
        + f'\n<p class="mild">Mitsuba {mi.__version__}, Dr.Jit {dr.__version__}</p></body></html>\n'
    )


def _mark(words: str, good: bool) -> str:
    return f'<span class="{"good" if good else "bad"}">{"✓" if good else "✗"} {escape(words)}</span>'


def _section(name: str, check: Check) -> Iterator[str]:
    """A check: laws that fail, and, folded, those that hold or were skipped."""
    yield f"<section><h2>{escape(name)} {_mark(check.verdict, not check.failed)}</h2>"
    quick = ", quick" if check.quick else ""
    yield f'<p class="mild">{escape(check.variant)}{quick}, {check.seconds:.1f} s</p>'
    for law in check.laws.values():
        if not law.holds:
            yield from _failure(law)
    others = [law for law in check.laws.values() if law.holds]
    yield f"<details><summary>{len(others)} laws hold or were skipped</summary>"
    for law in others:
        yield f"<h3>{_code(law.name)} {_mark(law.verdict, True)}</h3><p>{_words(law.law.states)}</p>"
        yield f"<p>{escape(law.skipped)}</p>" if law.skipped else _table(law.parts)
        yield from (f'<p class="mild">{escape(note)}</p>' for note in law.notes)
    yield "</details></section>"


def _failure(law: Outcome) -> Iterator[str]:
    """A law that fails: what it states, what was measured, the program, what that prints, and the plot."""
    yield f"<article><h3>{_code(law.name)} {_mark('fails', False)}</h3><p>{_words(law.law.states)}</p>"
    yield _table([part for part in law.parts if not part.holds])
    yield from (f'<p class="mild">{escape(note)}</p>' for note in law.notes)
    yield '<div class="both">'
    if law.output:
        yield f"<div><h4>A program that shows the worst case</h4><pre>{escape(law.snippet)}</pre></div>"
        yield f"<div><h4>What it prints</h4><pre>{escape(law.output)}</pre>{_plot(law)}</div>"
    else:
        yield f"<div>{_plot(law)}</div>"
    yield "</div>"
    within = [part for part in law.parts if part.holds]
    if within:
        yield f"<details><summary>{len(within)} other criteria of it hold</summary>{_table(within)}</details>"
    yield "</article>"


def _code(text: str) -> str:
    return f"<code>{escape(text)}</code>"


def _words(text: str) -> str:
    """A line of a docstring."""
    return re.sub("``([^`]+)``", r"<code>\1</code>", escape(text))


def _table(parts: Sequence[Measurement]) -> str:
    rows = []
    for part in parts:
        kind = "number" if part.holds else "number bad"
        limit = escape(f"{part.sign} {part.limit:.4g}")
        numbers = f'<td class="{kind}">{part.measured:.4g}</td><td class="number">{limit}</td>'
        rows.append(
            f'<tr><td>{escape(part.name)}</td>{numbers}<td class="mild">{escape(part.note)}</td></tr>'
        )
    head = "<thead><tr><th>measured</th><th></th><th>limit</th><th>why this limit</th></tr></thead>"
    return f"<table>{head}<tbody>{''.join(rows)}</tbody></table>"


def _plot(law: Outcome) -> str:
    if law.plot is None:
        return ""
    try:
        figure = law.plot()
    except ImportError:
        return '<p class="mild">Install matplotlib to see a plot here.</p>'
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, bbox_inches="tight", facecolor="white")
    text = base64.b64encode(data.getvalue()).decode()
    return f'<h4>Plot</h4><img alt="plot of the failure" src="data:image/png;base64,{text}">'
