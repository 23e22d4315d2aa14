"""What a law of plugins is: its figures, each with its limit and reason, and the faults that it must find.

A figure's ``snippet`` is a program in plain Mitsuba with the numbers of its worst case: ``Subject.program``
puts before it what loads the plugin, and what the names of ``hold`` need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import FunctionType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba.validation.laws.probe import Lanes
from mrt_mitsuba.validation.study import Bound

LEVEL = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
ONE_IN_A_MILLION = "one false alarm in a million checks"
SIGMAS = 6  # the same for a normal distribution: 2e-9
FEWEST = 20  # errors of which a quantile says something
NOWHERE = Lanes()
Found = TypeVar("Found")
Description = dict[str, Any]  # of a plugin, as ``mi.load_dict`` takes it
Judge = Callable[..., None]  # checks one law of a case
Change = Callable[..., Any]  # of a size, an answer of a plugin, and what was asked


class Skip(Exception):
    """Raised by the check of a law that makes no sense: the text says why, and an error that it is from."""


@dataclass(frozen=True)
class Figure:
    """What a law measures, and the limit that it is held to.

    ``statistic``: a number "at least" the limit; or, of one or N errors, the "most", the "count" or the
    "share" of those that are wrong, or a quantile (a float) without NaN: at most the limit. ``what`` and
    ``snippet``, the body of a program that shows the worst case, have places for the names given to
    ``Law.hold``.
    """

    statistic: str | float
    what: str
    limit: float
    why: str
    snippet: str = ""


STATISTICS: dict[str | float, Callable[..., float]]
STATISTICS = {"at least": np.min, "most": np.max, "count": np.sum, "share": np.mean}

# A figure by its statistic: what it is, its limit, the reason for that, and a snippet
at_least = partial(Figure, "at least")
most = partial(Figure, "most")
number_of = partial(Figure, "count")
share_of = partial(Figure, "share")


def rare(what: str, snippet: str = "") -> Figure:
    """The chance of what was seen, if a plugin is sound."""
    return at_least(what, LEVEL, ONE_IN_A_MILLION, snippet)


def figures(**rows: Figure) -> Callable[[Found], Found]:
    """Give a law the figures that it measures, by name."""

    def mark(law: Found) -> Found:
        vars(law)["figures"] = rows
        return law

    return mark


@dataclass(frozen=True)
class Fault:
    """A fault in words, and the least size that a check finds, in full and ``quick``; infinity for none."""

    law: str
    figure: str  # that finds it
    what: str
    full: float
    quick: float
    changes: Mapping[str, Change]  # by the answer that they change
    nested: Mapping[str, Any] | None  # what is changed, if not a diffuse BSDF, a cube or a constant sky


def finds(
    figure: str,
    what: str,
    full: float,
    *,
    quick: float | None = None,
    nested: Mapping[str, Any] | None = None,
    **changes: Change,
) -> Callable[[Judge], Judge]:
    """State a fault that a figure of this law finds. ``quick`` is ``full`` if left out.

    Of a BSDF, ``changes`` is one of ``value`` (values and weights), ``eval``, ``pdf``, ``pair`` (what
    eval_pdf() alone returns), ``sample``, ``u`` (its random numbers) and ``context``; of a shape, any of its
    methods; of a sky, any of ``direction``, ``weight``, ``pdf``, ``value`` (of eval_direction()) and ``seen``
    (of eval()).
    """

    def mark(law: Judge) -> Judge:
        fault = Fault(law.__name__, figure, what, full, full if quick is None else quick, changes, nested)
        vars(law).setdefault("faults", []).insert(0, fault)  # Python applies the last decorator first
        return law

    return mark


@dataclass(frozen=True)
class Part(Bound):
    """A figure that was measured; the note is the reason for its limit, the snippet shows its worst case."""

    figure: str = ""  # its name in the law
    snippet: str = ""

    def used(self) -> float:
        """The share of its limit that it uses; infinity beyond it."""
        if not self.holds:
            return math.inf
        over, under = sorted((self.measured, self.limit))
        return over / under if under > 0 else 0.0


@dataclass
class Law:
    """One law: its figures, or why it was skipped. ``measured``, ``limit``, ``why`` are of the worst one."""

    name: str
    parts: list[Part] = field(default_factory=list)
    skipped: str = ""
    notes: list[str] = field(default_factory=list)
    figures: Mapping[str, Figure] = field(default_factory=dict)
    program: Callable[..., str] | None = None  # writes snippets, while the law is checked

    def hold(
        self,
        name: str,
        measured: ArrayLike,
        at: Lanes = NOWHERE,
        *,
        where: ArrayLike = True,
        limit: float | None = None,
        **names: Any,
    ) -> None:
        """Hold a figure, a number or N errors, to its limit.

        ``at`` and ``names`` fill its words and its snippet: values, or arrays that have a row for each error.
        ``where``: which errors count. A quantile of fewer than ``FEWEST`` says nothing, and is left out.
        """
        figure = self.figures[name]
        statistic = STATISTICS.get(figure.statistic)
        errors = np.where(where, np.asarray(measured, np.float64), 0 if statistic else np.nan)
        worst = np.where(np.isnan(errors), np.inf, errors).argmax()
        if statistic:
            amount = statistic(errors)
        elif np.count_nonzero(~np.isnan(errors)) < FEWEST:
            return
        else:
            amount = np.nanquantile(errors, float(figure.statistic))
            worst = np.nanargmin(abs(errors - amount))
        names = vars(at) | names
        if errors.ndim:
            names = {key: x[worst] if isinstance(x, np.ndarray) else x for key, x in names.items()}
        snippet = ""
        if self.program and figure.snippet:
            snippet = self.program(figure.snippet, **names)
        part = Part(
            name=figure.what.format(**names),
            measured=float(amount),
            limit=float(figure.limit if limit is None else limit),
            at_most=figure.statistic != "at least",
            note=figure.why,
            figure=name,
            snippet=snippet,
        )
        self.parts.append(part)

    @property
    def worst(self) -> Part:
        """The figure that uses most of its limit."""
        return max(self.parts, key=Part.used, default=Part("", math.nan, math.nan))

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
        """Whether every figure is within its limit; a skipped law does not fail."""
        if self.skipped:
            return True
        return bool(self.parts) and all(part.holds for part in self.parts)

    @property
    def note(self) -> str:
        """The worst figure in words, and remarks."""
        return "; ".join(filter(None, [self.worst.name, *self.notes]))

    @property
    def verdict(self) -> str:
        if self.skipped:
            return "skipped"
        return "holds" if self.holds else "FAILS"

    def __str__(self) -> str:
        text = self.skipped
        if not text:
            text = f"{self.measured:.4g} {self.worst.sign} {self.limit:.4g}, {self.note}"
        return f"{self.verdict:<7} {self.name}: {text}"


def laws_in(*modules: ModuleType) -> dict[str, Judge]:
    """The laws that modules define, by name."""
    functions = [x for module in modules for x in vars(module).values() if isinstance(x, FunctionType)]
    return {law.__name__: law for law in functions if "figures" in vars(law)}


def faults_of(laws: Iterable[Judge]) -> list[Fault]:
    return [fault for law in laws for fault in vars(law).get("faults", ())]
