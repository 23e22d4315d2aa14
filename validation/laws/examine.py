"""Checks laws one by one, whatever a plugin does, and reports what was found."""

from __future__ import annotations

import ctypes
import math
import re
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.laws.law import Judge, Law, Part, Skip
from mrt_mitsuba.validation.laws.subject import Given, Subject
from mrt_mitsuba.validation.page import notebook, save_report
from mrt_mitsuba.validation.study import Study

TITLE = "Laws of plugins"
TIMEOUT = 120.0  # seconds for each law: sound plugins take a few, those of scalar variants a dozen


class TimedOut(BaseException):
    """Raised within a law that takes too long. No ``except Exception`` of a plugin catches it."""


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
        """Names of the laws that do not hold."""
        return [name for name, law in self.laws.items() if not law.holds]

    @property
    def passed(self) -> bool:
        """Whether something was checked and every law that was checked holds."""
        return not self.failed and any(not law.skipped for law in self.laws.values())

    def __str__(self) -> str:
        verdict = "passed" if self.passed else "skipped, nothing could be checked"
        if self.failed:
            verdict = f"FAILED {', '.join(self.failed)}"
        title = f"{self.subject} in {self.variant}: {verdict} ({self.seconds:.1f} s)"
        return "\n".join([title, *(f"  {law}" for law in self.laws.values())])

    def study(self) -> Study:
        """The findings in the form that pages are made of."""
        study = Study(self.subject, f"{self.subject}, {self.variant}", seconds=self.seconds)
        rows = []
        for law in self.laws.values():
            study.bounds += [replace(part, name=f"{law.name}: {part.name}") for part in law.parts]
            row = {"law": law.name, "verdict": law.verdict, "note": law.skipped or law.note}
            rows.append(row | {"the worst case, to run by itself": "" if law.holds else law.snippet})
        study.records("laws", "Laws", rows, first=True)
        return study

    def save(self, folder: str | Path) -> None:
        """Write the page (``index.html``), ``summary.json`` and CSV files. Raises ``OutputError``."""
        save_report(folder, self.study(), title=TITLE, quick=self.quick)

    def _repr_html_(self) -> str:
        return notebook(self.study(), title=TITLE)


def examine(
    kind: Callable[[Given, bool, int], Subject],
    given: Given,
    laws: Mapping[str, Judge],
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
    for name in chosen:
        if name not in laws:
            raise UsageError(f"unknown law {name!r}: choose from {', '.join(laws)}")
    start = time.perf_counter()
    variant = mi.variant()
    with settings_restored():
        case = kind(given, quick, seed)
    checked = {}
    obstacle = case.unsupported  # why the laws that are left cannot be judged
    for name in laws:
        if name in chosen:
            law = Law(name, figures=vars(laws[name])["figures"], program=case.program)
            obstacle = _judge(law, laws[name], case, obstacle, timeout)
            law.program = None
            checked[name] = law
    return Check(case.name, variant, checked, time.perf_counter() - start, quick)


def _judge(law: Law, judge: Judge, case: Subject, obstacle: str, timeout: float) -> str:
    """Check one law, unless there is an obstacle; the obstacle for the laws after it, "" if none."""
    if obstacle:
        law.skipped = obstacle
        return obstacle
    try:
        with settings_restored(), _limited(timeout):
            judge(law, case)
        if not law.parts:
            law.skipped = "; ".join(law.notes)
    except Skip as why:
        law.skipped = f"{why}: {_reason(why.__cause__)}" if why.__cause__ else str(why)
    except TimedOut:
        late = f"took longer than {timeout:g} s"
        law.parts.append(Part(f"it {late}", math.inf, timeout, note="a plugin must come to an end"))
        return f"a law before it {late}"
    except Exception as error:
        law.skipped = _missing_inside(case.plugin, error)
        if not law.skipped:
            what = f"it raised {type(error).__name__}: {_reason(error)}"
            law.parts.append(Part(what, math.inf, 0, note="a plugin must not raise"))
    return ""


def _reason(problem: BaseException) -> str:
    """The line of an error that says what happened: the last of a traceback that Mitsuba quotes."""
    text = str(problem).strip()
    lines = text.splitlines() or [""]
    return lines[-1] if "Traceback (most recent" in text else lines[0]


_NOT_IMPLEMENTED = re.compile(r"\[(\w+)\] \w+::(\w+)\(\).*not implemented")
_PURE_VIRTUAL = re.compile(r"(\w+)::(\w+)\(\)'\): tried to call a pure virtual")


def _missing_inside(plugin: mi.Object, error: Exception) -> str:
    """Which method a plugin nested in this one lacks, if an error is about that; else ""."""
    match = _NOT_IMPLEMENTED.search(str(error)) or _PURE_VIRTUAL.search(str(error))
    if match is None or match[1] in [base.__name__ for base in type(plugin).__mro__]:
        return ""
    return f"the {match[1]} nested in it has no {match[2]}(), which it needs"


@contextmanager
def settings_restored() -> Iterator[None]:
    """Put back the variant and Dr.Jit's flags, which a plugin or a switch of variants may change."""
    variant = mi.variant()
    flags = {flag: dr.flag(flag) for flag in dr.JitFlag if flag != dr.JitFlag.Default}
    try:
        # numbers that are not finite are left to the law ``finite``
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # Mitsuba loads its integrators anew with each variant, and Dr.Jit counts how often
            warnings.filterwarnings("ignore", "The AST-transforming decorator")
            yield
    finally:
        if mi.variant() != variant:
            runtime.use(variant)
        for flag, value in flags.items():
            if dr.flag(flag) != value:
                dr.set_flag(flag, value)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise ``TimedOut`` in this thread's Python code after so many seconds. A kernel is not interrupted."""
    start = time.perf_counter()
    thread = ctypes.c_ulong(threading.get_ident())
    interrupt = ctypes.pythonapi.PyThreadState_SetAsyncExc
    timer = threading.Timer(seconds, interrupt, (thread, ctypes.py_object(TimedOut)))
    timer.daemon = True
    timer.start()
    try:
        yield
    except Exception as error:  # Mitsuba passes on what a Python plugin raises as an error of its own
        if time.perf_counter() - start > seconds:
            raise TimedOut from error
        raise
    finally:
        timer.cancel()
        timer.join()  # if it is about to interrupt: then it does here, and not later
