"""Laws of plugins: criteria, each with its limit and reason, and the faults that it must find.

A criterion's ``snippet`` is a program in plain Mitsuba with the numbers of its worst case: ``Case.program``
adds the lines that load the plugin, and those that the names given to ``Outcome.check`` need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pkgutil import resolve_name
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .probe import Lanes

SIGNIFICANCE = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
ONE_IN_A_MILLION = "one false alarm in a million checks"
SIGMAS = 6  # the same for a normal distribution: 2e-9
MIN_QUANTILE_ERRORS = 20  # a quantile of fewer is not judged
NO_LANES = Lanes()
Change = Callable[..., Any]  # a function of a size, of what a plugin returned, and of its arguments


class UsageError(ValueError):
    """An argument of a check is wrong."""


class LoadError(RuntimeError):
    """Mitsuba cannot load the dict of a plugin."""


class Skip(Exception):
    """Raised if a law does not apply, or cannot be checked here; the message says why."""


@dataclass(frozen=True)
class Criterion:
    """A measured quantity of a law, and its limit.

    ``statistic``: "at least" for a number of which the limit is the least; or, of one or N errors, the
    "most", the "count" or the "share" of those that are wrong, or a quantile (a float) without NaN: at most
    the limit. ``what`` and ``snippet``, the body of a program that shows the worst case, are formatted with
    the names given to ``Outcome.check``.
    """

    statistic: str | float
    what: str
    limit: float
    why: str
    snippet: str = ""


STATISTICS: dict[str | float, Callable[..., float]]
STATISTICS = {"at least": np.min, "most": np.max, "count": np.sum, "share": np.sum}

# A criterion by its statistic: what it is, its limit, the reason for that, and a snippet
at_least = partial(Criterion, "at least")
most = partial(Criterion, "most")
number_of = partial(Criterion, "count")
share_of = partial(Criterion, "share")


def p_value(what: str, snippet: str = "") -> Criterion:
    """p-value criterion, under the hypothesis that the plugin is correct."""
    return at_least(what, SIGNIFICANCE, ONE_IN_A_MILLION, snippet)


def sidak(p: float, count: int) -> float:
    """The probability 1 - (1 - p)^count that the smallest of ``count`` p values is ``p`` or less."""
    return 1.0 if p >= 1 else float(-np.expm1(count * np.log1p(-p)))


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """The difference of the means of two samples [N] and [M], beyond chance, relative to the larger mean."""
    error = np.sqrt(one.var() / len(one) + other.var() / len(other))
    means = one.mean(), other.mean()
    return float(max(abs(means[0] - means[1]) - SIGMAS * error, 0) / max(*means, 1e-30))


@dataclass(frozen=True)
class Fault:
    """A fault, and the smallest size that a check finds, in full and ``quick``; infinity for none."""

    law: str
    criterion: str  # that finds it
    what: str
    full: float
    quick: float
    changes: Mapping[str, Change]  # by the method or value that they change
    nested: Mapping[str, Any] | None  # what is changed, if not a diffuse BSDF, a cube or a constant sky


@dataclass(frozen=True)
class Law:
    """A law: the function that checks it, what that measures, and faults that it finds."""

    judge: Callable[..., None]  # of an ``Outcome`` and a case
    criteria: Mapping[str, Criterion]
    faults: tuple[Fault, ...] = ()

    def __reduce__(self) -> tuple[Callable[[str], Any], tuple[str]]:
        """Pickle a law by its name: its function has the same one."""
        return resolve_name, (f"{self.judge.__module__}:{self.name}",)

    @property
    def name(self) -> str:
        return self.judge.__name__

    @property
    def states(self) -> str:
        """The law in one sentence."""
        return str(self.judge.__doc__).splitlines()[0]


def measures(**criteria: Criterion) -> Callable[[Callable[..., None]], Law]:
    """Declare a law by the function that checks it, with its criteria by name."""
    return partial(Law, criteria=criteria)


def finds(
    criterion: str,
    what: str,
    full: float,
    *,
    quick: float | None = None,
    nested: Mapping[str, Any] | None = None,
    **changes: Change,
) -> Callable[[Law], Law]:
    """State a fault that a criterion of this law finds. ``quick`` is ``full`` if left out.

    Of a BSDF, ``changes`` is one of ``value`` (values and weights), ``eval``, ``pdf``, ``pair`` (what
    eval_pdf() alone returns), ``null`` (eval_null_transmission()), ``sample``, ``u`` (its random numbers) and
    ``context``; of a shape, any of its methods; of a sky, any of ``direction``, ``weight``, ``pdf``,
    ``value`` (of eval_direction()) and ``seen`` (of eval()).
    """

    def mark(law: Law) -> Law:
        fault = Fault(law.name, criterion, what, full, full if quick is None else quick, changes, nested)
        return replace(law, faults=(fault, *law.faults))  # Python applies the last decorator first

    return mark


def by_name(*laws: Law) -> dict[str, Law]:
    return {law.name: law for law in laws}


@dataclass(frozen=True)
class Measurement:
    """A criterion as measured; the note is the reason for its limit, the snippet shows its worst case."""

    name: str
    measured: float
    limit: float
    at_most: bool = True  # else: at least
    note: str = ""
    criterion: str = ""  # its name in the law
    snippet: str = ""

    @property
    def holds(self) -> bool:
        """True if within the limit; NaN never is."""
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit

    @property
    def sign(self) -> str:
        return "<=" if self.at_most else ">="

    def used(self) -> float:
        """The share of its limit that it uses; infinity beyond it."""
        if not self.holds:
            return math.inf
        under, over = sorted((self.measured, self.limit))
        return under / over if over > 0 else 0.0


@dataclass
class Outcome:
    """Result of checking one law, or the reason why it was skipped.

    ``measured``, ``limit``, ``why`` and ``snippet`` are those of the worst criterion.
    """

    law: Law
    parts: list[Measurement] = field(default_factory=list)
    skipped: str = ""
    notes: list[str] = field(default_factory=list)
    program: Callable[..., str] | None = None  # writes snippets, while the law is checked
    output: str = ""  # what the snippet of the worst criterion prints, where the law fails
    plot: Callable[..., None] | None = None  # draws the failure into a figure of matplotlib

    def check(
        self,
        name: str,
        measured: ArrayLike,
        at: Lanes = NO_LANES,
        *,
        where: ArrayLike = True,
        limit: float | None = None,
        **names: object,
    ) -> None:
        """Compare a number, or N errors, with the limit of a criterion.

        ``at`` and ``names`` fill its words and its snippet: values, or arrays that have a row for each error.
        ``where``: which errors are judged. A share of none, and a quantile of fewer than
        ``MIN_QUANTILE_ERRORS``, are not judged.
        """
        criterion = self.law.criteria[name]
        statistic = STATISTICS.get(criterion.statistic)
        errors = np.asarray(measured, np.float64)
        judged = np.broadcast_to(where, errors.shape)
        errors = np.where(judged, errors, 0 if statistic else np.nan)
        worst = np.where(np.isnan(errors), np.inf, errors).argmax()
        if statistic:
            amount = statistic(errors)
        elif np.count_nonzero(~np.isnan(errors)) < MIN_QUANTILE_ERRORS:
            return
        else:
            amount = np.nanquantile(errors, float(criterion.statistic))
            worst = np.nanargmin(abs(errors - amount))
        if criterion.statistic == "share":
            if not judged.any():
                return
            amount /= np.count_nonzero(judged)
        names = vars(at) | names
        if errors.ndim:
            names = {key: x[worst] if isinstance(x, np.ndarray) else x for key, x in names.items()}
        self.parts.append(
            Measurement(
                name=criterion.what.format(**names),
                measured=float(amount),
                limit=float(criterion.limit if limit is None else limit),
                at_most=criterion.statistic != "at least",
                note=criterion.why,
                criterion=name,
                snippet=self.program(criterion.snippet, **names)
                if self.program and criterion.snippet
                else "",
            )
        )

    def fail(self, what: str, why: str) -> None:
        """Fail for a reason that is no criterion's."""
        self.parts.append(Measurement(what, math.inf, 0, note=why))

    def skip(self, reason: str) -> None:
        """Stop here. What was measured before counts; where nothing was, the law is skipped."""
        if self.parts:
            self.notes.append(reason)
        else:
            self.skipped = reason

    @property
    def name(self) -> str:
        return self.law.name

    @property
    def worst(self) -> Measurement:
        """The criterion that uses most of its limit."""
        return max(self.parts, key=Measurement.used, default=Measurement("", math.nan, math.nan))

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
    def holds(self) -> bool:
        """True if every criterion is within its limit; a skipped law does not fail."""
        return all(part.holds for part in self.parts) and bool(self.parts or self.skipped)

    @property
    def note(self) -> str:
        """The worst criterion in words, and remarks."""
        return "; ".join(filter(None, [self.worst.name, *self.notes]))

    @property
    def verdict(self) -> str:
        if not self.holds:
            return "FAILS"
        return "holds" if self.parts else "skipped"

    def __str__(self) -> str:
        text = self.skipped
        if self.parts:
            text = f"{self.measured:.4g} {self.worst.sign} {self.limit:.4g}, {self.note}"
        return f"{self.verdict:<7} {self.name}: {text}"
