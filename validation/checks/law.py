"""A law that a plugin must obey, and the result of checking several: figures, limits, reasons, snippets."""

from __future__ import annotations

import ctypes
import math
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.tools import report
from mrt_mitsuba.validation.tools.study import Bound, Study

TITLE = "Laws of plugins"
LEVEL = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
RARE = "one false alarm in a million checks"
SIGMAS = 6  # the same for a normal distribution: 2e-9
LawFunction = TypeVar("LawFunction", bound=Callable[..., None])
TIMEOUT = 120.0  # seconds for each law: sound plugins take a few, those of scalar variants a dozen


class Skip(Exception):
    """Raised by the check of a law that makes no sense for its subject; the text is the reason."""


class TimedOut(BaseException):
    """Raised within a law that takes too long. No ``except Exception`` of a plugin catches it."""


@dataclass(frozen=True)
class Part(Bound):
    """A figure that was measured; the note is the reason for its limit, the snippet shows its worst case."""

    figure: str = ""  # its name in the law
    snippet: str = ""

    @property
    def severity(self) -> float:
        """Return how much of the limit is used: above 1 it is exceeded."""
        over, under = (self.measured, self.limit) if self.at_most else (self.limit, self.measured)
        if math.isnan(self.measured) or under <= 0 < over - under:
            return math.inf
        return over / under if under > 0 else 0.0


def figures(**rows: tuple[Any, ...]) -> Callable[[LawFunction], LawFunction]:
    """Give a law its figures, by name: how, what is held to which limit, why that, and a snippet's body.

    How: a number "at most" or "at least"; or of N errors the "most", "none" or a "share" of those that are
    bad, or a quantile, NaN left out.
    """

    def mark(law: LawFunction) -> LawFunction:
        vars(law)["figures"] = rows
        return law

    return mark


@dataclass
class Law:
    """One law: its figures, or why it was skipped. ``measured``, ``limit``, ``why`` are of the worst one."""

    name: str
    parts: list[Part] = field(default_factory=list)
    skipped: str = ""
    notes: list[str] = field(default_factory=list)
    figures: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    program: Callable[..., str] | None = None  # writes snippets, while the law is checked

    def hold(self, name: str, measured: Any, *, limit: Any = None, **names: Any) -> None:
        """Hold a figure, a number or N errors, to its limit.

        ``names`` fill its words and its snippet: values, or arrays that have a row for each error.
        """
        how, what, usual, why, *body = self.figures[name]
        if how not in ("at most", "at least"):
            errors = np.asarray(measured, np.float64)
            if isinstance(how, float):
                measured = np.nanquantile(errors, how)
                i = int(np.nanargmin(np.abs(errors - measured)))
            else:
                i = int(np.where(np.isnan(errors), np.inf, errors).argmax())
                measured = {"most": errors[i], "none": errors.sum(), "share": errors.mean()}[how]
            names = {key: x[i] if isinstance(x, np.ndarray) else x for key, x in names.items()}
        snippet = self.program(*body, **names) if self.program and body else ""
        limit = float(usual if limit is None else limit)
        what = what.format(**names)
        self.parts.append(Part(what, float(measured), limit, how != "at least", why, name, snippet))

    @property
    def worst(self) -> Part:
        """Return the figure that uses most of its limit."""
        none = Part("", math.nan, math.nan)
        return max(self.parts, key=lambda part: (not part.holds, part.severity), default=none)

    measured = property(lambda self: self.worst.measured)
    limit = property(lambda self: self.worst.limit)
    why = property(lambda self: self.worst.note)
    snippet = property(lambda self: self.worst.snippet)

    @property
    def holds(self) -> bool:
        """Return whether every figure is within its limit; a skipped law does not fail."""
        return bool(self.skipped) or (bool(self.parts) and all(part.holds for part in self.parts))

    @property
    def note(self) -> str:
        """Return what the worst figure is, and remarks."""
        return "; ".join([*([self.worst.name] if self.parts else []), *self.notes])

    @property
    def verdict(self) -> str:
        return "skipped" if self.skipped else "holds" if self.holds else "FAILS"

    def __str__(self) -> str:
        figure = f"{self.measured:.4g} {self.worst.sign} {self.limit:.4g}, {self.note}"
        return f"{self.verdict:<7} {self.name}: {self.skipped or figure}"


@dataclass(frozen=True)
class Check:
    """The findings of a check of one plugin: its laws by name."""

    subject: str
    variant: str
    laws: Mapping[str, Law]
    seconds: float
    quick: bool = False

    @property
    def failed(self) -> list[str]:
        """Return the names of the laws that do not hold."""
        return [name for name, law in self.laws.items() if not law.holds]

    @property
    def passed(self) -> bool:
        """Return whether something was checked and every law that was holds."""
        return not self.failed and any(not law.skipped for law in self.laws.values())

    def __str__(self) -> str:
        verdict = "passed" if self.passed else f"FAILED {', '.join(self.failed)}"
        lines = [f"{self.subject} in {self.variant}: {verdict} ({self.seconds:.1f} s)"]
        return "\n".join(lines + [f"  {law}" for law in self.laws.values()])

    def study(self) -> Study:
        """Return the findings in the form that pages are made of."""
        study, laws = Study(self.subject, f"{self.subject}, {self.variant}"), self.laws.values()
        study.seconds = self.seconds
        study.bounds += [replace(p, name=f"{law.name}: {p.name}") for law in laws for p in law.parts]
        rows = [
            [law.name, law.verdict, law.skipped or law.note, "" if law.holds else law.snippet] for law in laws
        ]
        columns = ["law", "verdict", "note", "the worst case, to run by itself"]
        study.table("laws", "Laws", columns, rows, first=True)
        return study

    def save(self, folder: str | Path) -> None:
        """Write the page (``index.html``), ``summary.json`` and CSV files. Raises ``OutputError``."""
        report.save(folder, self.study(), title=TITLE, quick=self.quick)

    def _repr_html_(self) -> str:
        return report.notebook(self.study(), title=TITLE)


def examine(
    kind: Callable[[Any, bool, int], Any],
    given: Any,
    laws: Mapping[str, Callable[[Law, Any], None]],
    *,
    quick: bool,
    seed: int,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check laws one by one; a law fails if the plugin raises while it is checked, or takes too long.

    ``kind(given, quick, seed)`` makes the case that each law is called with.
    """
    runtime.use()
    chosen = list(laws if only is None else only)
    unknown = [name for name in chosen if name not in laws]
    if unknown:
        raise UsageError(f"unknown law {unknown[0]!r}: choose from {', '.join(laws)}")
    start, variant, found, late = time.perf_counter(), mi.variant(), {}, ""
    with settings_restored():
        case = kind(given, quick, seed)
    for name in (name for name in laws if name in chosen):
        figures = vars(laws[name]).get("figures", {})
        law = found[name] = Law(name, figures=figures, program=case.program)
        try:
            with settings_restored(), _limited(timeout):
                if late:
                    raise Skip(f"a law before it {late}")
                laws[name](law, case)
        except Skip as reason:
            law.skipped = str(reason)
        except TimedOut:
            late = f"took longer than {timeout:g} s"
            law.parts.append(Part(f"it {late}", math.inf, timeout, note="a plugin must come to an end"))
        except Exception as error:
            lines = str(error).strip().splitlines() or [""]
            # Mitsuba quotes the traceback of an error in a Python plugin, with the error last
            line = lines[-1] if lines[0].startswith("Traceback") else lines[0]
            what = f"it raised {type(error).__name__}: {line}"
            law.parts.append(Part(what, math.inf, 0, note="a plugin must not raise"))
        law.program = None
    return Check(case.name, variant, found, time.perf_counter() - start, quick)


@contextmanager
def settings_restored() -> Iterator[None]:
    """Put back the variant and Dr.Jit's flags, which a plugin or a switch of variants may change."""
    variant, flags = mi.variant(), {f: dr.flag(f) for f in dr.JitFlag if f != dr.JitFlag.Default}
    try:
        # what is not finite is the law ``finite``'s to deal with
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # Mitsuba loads its integrators anew with each variant, and Dr.Jit counts how often
            warnings.filterwarnings("ignore", "The AST-transforming decorator")
            yield
    finally:
        if mi.variant() != variant:
            mi.set_variant(variant)
        for flag, value in flags.items():
            if dr.flag(flag) != value:
                dr.set_flag(flag, value)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise ``TimedOut`` in this thread's Python code after so many seconds. A kernel is not interrupted."""
    thread, start = ctypes.c_ulong(threading.get_ident()), time.perf_counter()
    interrupt = ctypes.pythonapi.PyThreadState_SetAsyncExc
    timer = threading.Timer(seconds, interrupt, (thread, ctypes.py_object(TimedOut)))
    timer.daemon = True
    timer.start()
    try:
        yield
    except Exception as error:  # Mitsuba passes on what a Python plugin raises as an error of its own
        raise (TimedOut if time.perf_counter() - start > seconds else error) from error
    finally:
        timer.cancel()
        timer.join()  # if it is about to interrupt: then it does here, and not later
