"""Checks laws one by one, whatever a plugin does, and reports what was found."""

from __future__ import annotations

import contextlib
import io
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from .case import Case, Given, reason_of
from .law import Law, Outcome, Skip, UsageError
from .page import Check


def examine(
    kind: Callable[[Given, bool, int], Case],
    given: Given,
    laws: Mapping[str, Law],
    *,
    quick: bool,
    seed: int,
    only: Iterable[str] | None = None,
) -> Check:
    """Check laws one by one; a law fails if the plugin raises while it is checked.

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
    with variant_restored():
        case = kind(given, quick, seed)
    checked = {}
    for name in laws:
        if name in chosen:
            checked[name] = outcome = Outcome(laws[name], program=case.program)
            _judge(outcome, case)
            outcome.program = None
    return Check(case.name, variant, checked, time.perf_counter() - start, quick)


def _judge(outcome: Outcome, case: Case) -> None:
    """Check one law."""
    try:
        with variant_restored():
            outcome.law.judge(outcome, case)
            if not outcome.holds and outcome.snippet:
                outcome.output = _run(outcome.snippet, {case.word: case.plugin})
        if not outcome.parts:
            outcome.skip("; ".join(outcome.notes) or "nothing of it could be measured")
    except Skip as why:
        outcome.skip(f"{why}: {reason_of(why.__cause__)}" if why.__cause__ else str(why))
    except Exception as error:
        outcome.fail(f"it raised {type(error).__name__}: {reason_of(error)}", "a plugin must not raise")


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
def variant_restored() -> Iterator[None]:
    """Put back the variant, which programs switch, and warn of nothing."""
    variant = mi.variant()
    try:
        # numbers that are not finite are left to the law ``finite``
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # Mitsuba loads its integrators anew with each variant, and Dr.Jit counts how often
            warnings.filterwarnings("ignore", "The AST-transforming decorator")
            yield
    finally:
        if mi.variant() != variant:
            mi.set_variant(variant)
