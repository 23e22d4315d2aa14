"""Checks laws one by one, whatever a plugin does, and reports what was found."""

from __future__ import annotations

import contextlib
import ctypes
import io
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from .case import Case, Given, reason_of
from .law import Law, Outcome, Skip, UsageError
from .page import Check

TIMEOUT = 120.0  # seconds for each law: sound plugins take a few, those of scalar variants a dozen


class TimedOut(BaseException):
    """Raised within a law that takes too long. No ``except Exception`` of a plugin catches it."""


def examine(
    kind: Callable[[Given, bool, int], Case],
    given: Given,
    laws: Mapping[str, Law],
    *,
    quick: bool,
    seed: int,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check laws one by one; a law fails if the plugin raises while it is checked, or takes too long.

    ``kind(given, quick, seed)`` makes the case that each law is called with.
    """
    if not mi.variant():
        mi.set_variant("llvm_ad_rgb")
    chosen = list(laws if only is None else only)
    for name in chosen:
        if name not in laws:
            raise UsageError(f"unknown law {name!r}: choose from {', '.join(laws)}")
    start = time.perf_counter()
    variant = mi.variant()
    with settings_restored():
        case = kind(given, quick, seed)
    checked = {}
    obstacle = ""  # why the laws that are left cannot be judged
    for name in laws:
        if name in chosen:
            checked[name] = outcome = Outcome(laws[name], program=case.program)
            obstacle = _judge(outcome, case, obstacle, timeout)
            outcome.program = None
    return Check(case.name, variant, checked, time.perf_counter() - start, quick)


def _judge(outcome: Outcome, case: Case, obstacle: str, timeout: float) -> str:
    """Check one law, unless there is an obstacle; the obstacle for the laws after it, "" if none."""
    if obstacle:
        outcome.skip(obstacle)
        return obstacle
    try:
        with settings_restored(), _limited(timeout):
            outcome.law.judge(outcome, case)
            if not outcome.holds and outcome.snippet:
                outcome.output = _run(outcome.snippet, {case.word: case.plugin})
        if not outcome.parts:
            outcome.skip("; ".join(outcome.notes) or "nothing of it could be measured")
    except Skip as why:
        outcome.skip(f"{why}: {reason_of(why.__cause__)}" if why.__cause__ else str(why))
    except TimedOut:
        late = f"took longer than {timeout:g} s"
        outcome.fail(f"it {late}", "a plugin must terminate", timeout)
        return f"a law before it {late}"
    except Exception as error:
        outcome.fail(f"it raised {type(error).__name__}: {reason_of(error)}", "a plugin must not raise")
    return ""


def _run(program: str, names: dict[str, object]) -> str:
    """Output of a program, or the reason why it stops. Names are for those that cannot load the plugin."""
    printed = io.StringIO()
    both = contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed)
    with both[0], both[1], dr.scoped_set_flag(dr.JitFlag.Debug, True):
        try:
            exec(compile(program, "the program", "exec"), names)
        except Exception as error:
            print(f"{type(error).__name__}: {reason_of(error)}")
        finally:
            names.clear()  # its functions refer to it, and it to the plugin: a cycle keeps that registered
    return printed.getvalue()


@contextlib.contextmanager
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
            mi.set_variant(variant)
        for flag, value in flags.items():
            if dr.flag(flag) != value:
                dr.set_flag(flag, value)


@contextlib.contextmanager
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
