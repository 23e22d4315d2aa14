"""A law that a plugin must obey, and the result of checking several: figures, limits, reasons, snippets."""

from __future__ import annotations

import ctypes
import math
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.tools import report
from mrt_mitsuba.validation.tools.study import Bound, Study

TITLE = "Laws of plugins"
LEVEL = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
SIGMAS = 6  # the same for a normal distribution: 2e-9
TIMEOUT = 120.0  # seconds for each law: sound plugins take a few, those of scalar variants a dozen


class Skip(Exception):
    """Raised by the check of a law that makes no sense for its subject; the text is the reason."""


class TimedOut(BaseException):
    """Raised within a law that takes too long. No ``except Exception`` of a plugin catches it."""


@dataclass(frozen=True)
class Part(Bound):
    """One figure of a law; the note is the reason for its limit, the snippet shows its worst case."""

    snippet: str = ""

    @property
    def severity(self) -> float:
        """Return how much of the limit is used: above 1 it is exceeded."""
        if math.isnan(self.measured):
            return math.inf
        over, under = (self.measured, self.limit) if self.at_most else (self.limit, self.measured)
        return over / under if under > 0 else (math.inf if over > under else 0.0)


@dataclass
class Law:
    """One law: its figures, or why it was skipped. ``measured``, ``limit``, ``why`` are of the worst one."""

    name: str
    parts: list[Part] = field(default_factory=list)
    skipped: str = ""
    notes: list[str] = field(default_factory=list)

    def at_most(self, what: str, measured: float, limit: float, why: str, snippet: str = "") -> None:
        """Hold a figure to an upper bound."""
        self.parts.append(Part(what, float(measured), float(limit), True, why, snippet))

    def at_least(self, what: str, measured: float, limit: float, why: str, snippet: str = "") -> None:
        """Hold a figure to a lower bound."""
        self.parts.append(Part(what, float(measured), float(limit), False, why, snippet))

    def most(self, what: str, errors: Any, limit: float, why: str, show: Callable[[int], str]) -> None:
        """Hold the largest of N errors to an upper bound; ``show(i)`` is the snippet of one."""
        i = int(np.where(np.isnan(errors), np.inf, errors).argmax())
        self.at_most(what, errors[i], limit, why, show(i))

    def none(self, what: str, bad: Any, why: str, show: Callable[[int], str]) -> None:
        """Count how many of N are bad: there must be none."""
        self.at_most(what, bad.sum(), 0, why, show(int(bad.argmax())))

    def share(self, what: str, bad: Any, limit: float, why: str, show: Callable[[int], str]) -> None:
        """Hold the share of N that is bad to an upper bound."""
        self.at_most(what, bad.mean(), limit, why, show(int(bad.argmax())))

    def quantile(self, what: str, errors: Any, share: float, limit: float, why: str, show: Any) -> None:
        """Hold what this share of N errors, NaN left out, stays below; the snippet is of one about there."""
        measured = float(np.nanquantile(errors, share))
        self.at_most(what, measured, limit, why, show(int(np.nanargmin(np.abs(errors - measured)))))

    @property
    def worst(self) -> Part:
        """Return the figure that uses most of its limit."""
        none = Part("", math.nan, math.nan)
        return max(self.parts, key=lambda part: (not part.holds, part.severity), default=none)

    @property
    def holds(self) -> bool:
        """Return whether every figure is within its limit; a skipped law does not fail."""
        return bool(self.skipped) or (bool(self.parts) and all(part.holds for part in self.parts))

    @property
    def measured(self) -> float:
        return self.worst.measured

    @property
    def limit(self) -> float:
        return self.worst.limit

    @property
    def why(self) -> str:
        return self.worst.note

    @property
    def snippet(self) -> str:
        return self.worst.snippet

    @property
    def note(self) -> str:
        """Return what the worst figure is, and remarks."""
        return "; ".join([*([self.worst.name] if self.parts else []), *self.notes])

    @property
    def verdict(self) -> str:
        return "skipped" if self.skipped else "holds" if self.holds else "FAILS"

    def __str__(self) -> str:
        if self.skipped:
            return f"{self.verdict:<7} {self.name}: {self.skipped}"
        figure = f"{self.measured:.4g} {self.worst.sign} {self.limit:.4g}"
        return f"{self.verdict:<7} {self.name}: {figure}, {self.note}"


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
        study = Study(self.subject, f"{self.subject}, {self.variant}", seconds=self.seconds)
        for law in self.laws.values():
            for part in law.parts:
                name = f"{law.name}: {part.name}"
                study.bounds.append(Bound(name, part.measured, part.limit, part.at_most, part.note))
        rows = [[law.name, law.verdict, law.skipped or law.note] for law in self.laws.values()]
        study.table("laws", "Laws", ["law", "verdict", "note"], rows, first=True)
        worst = [[law.name, law.snippet] for law in self.laws.values() if law.snippet and not law.holds]
        if worst:
            study.table("snippets", "Worst cases, to run by themselves", ["law", "snippet"], worst)
        return study

    def save(self, folder: str | Path) -> None:
        """Write the page (``index.html``), ``summary.json`` and CSV files. Raises ``OutputError``."""
        report.save(folder, self.study(), title=TITLE, quick=self.quick)

    def _repr_html_(self) -> str:
        return report.notebook(self.study(), title=TITLE)


def class_name(plugin: Any) -> str:
    """Return the name of a plugin's class: Mitsuba calls all those in Python by that of their base."""
    python = type(plugin).__module__.split(".")[0] != "mitsuba"
    return type(plugin).__name__ if python or not hasattr(plugin, "class_name") else plugin.class_name()


def examine(
    subject: str,
    case: Any,
    laws: Mapping[str, Callable[[Law, Any], None]],
    *,
    only: Iterable[str] | None = None,
    quick: bool = False,
    timeout: float = TIMEOUT,
) -> Check:
    """Check laws one by one; a law fails if the plugin raises while it is checked, or takes too long."""
    chosen = list(laws if only is None else only)
    unknown = [name for name in chosen if name not in laws]
    if unknown:
        raise UsageError(f"unknown law {unknown[0]!r}: choose from {', '.join(laws)}")
    start, variant, found, late = time.perf_counter(), mi.variant(), {}, ""
    for name in laws:
        if name not in chosen:
            continue
        law = found[name] = Law(name)
        if late:
            law.skipped = f"a law before it {late}"
            continue
        with settings_restored():
            try:
                with _limited(timeout):
                    laws[name](law, case)
            except Skip as reason:
                law.skipped = str(reason)
            except TimedOut:
                late = f"took longer than {timeout:g} s"
                law.at_most(f"it {late}", math.inf, timeout, "a plugin must come to an end")
            except Exception as error:
                lines = str(error).strip().splitlines() or [""]
                # Mitsuba quotes the traceback of an error in a Python plugin, with the error last
                line = lines[-1] if lines[0].startswith("Traceback") else lines[0]
                what = f"it raised {type(error).__name__}: {line}"
                law.at_most(what, math.inf, 0, "a plugin must not raise")
    return Check(subject, variant, found, time.perf_counter() - start, quick)


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
    thread, over, lock = ctypes.c_ulong(threading.get_ident()), threading.Event(), threading.Lock()
    done = False

    def interrupt() -> None:
        with lock:
            if not done:
                over.set()
                ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(TimedOut))

    timer = threading.Timer(seconds, interrupt)
    timer.daemon = True
    timer.start()
    try:
        yield
    except Exception as error:  # Mitsuba passes on what a Python plugin raises as an error of its own
        raise (TimedOut if over.is_set() else error) from error
    finally:
        timer.cancel()
        with lock:
            done = True
