"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?

A case is a row: its name; what is measured; why it is held to its limit, or cannot hold; the figure; the
limit, if there is one; and whether the figure must be at most that, the default, or at least.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from mrt_mitsuba.validation.studies.stability import finite, geometry, reflectance, transport
from mrt_mitsuba.validation.tools.study import Bound, Study

TITLE = "Numerical stability on stiff and extreme cases"
COLUMNS = ("case", "what", "why", "measured", "bound", "")

# By the name of their table: its title, its cases, and a note
PARTS: dict[str, tuple[str, Callable[[bool], Iterable[tuple[Any, ...]]], str]] = {
    "bsdf": ("Reflectance", reflectance.cases, reflectance.NOTE),
    "geometry": ("Geometry", geometry.cases, "A rounding is 2⁻²⁴ = 6e-8. Truth: the same rays in float64."),
    "transport": ("Light transport", transport.cases, transport.NOTE),
    "filters": ("Filters", finite.of_filters, ""),
    "finite": ("Finite and not negative", finite.in_bulk, finite.NOTE),
}


def run(study: Study, *, quick: bool) -> None:
    """Make a table of each part, and hold its cases to their limits."""
    study.texts.append("The least fault that a case shows is as large as its limit; of counts, a single one.")
    for table, (title, cases, note) in study.each(TITLE, PARTS.items()):
        rows: list[tuple[Any, ...]] = []
        for name, what, why, measured, *held in cases(quick):
            verdict = "-", "cannot hold"
            if held:
                limit, at_most = (*held, True)[:2]
                bound = Bound(f"{title}: {name}", float(measured), limit, at_most, why)
                study.bounds.append(bound)
                verdict = f"{bound.sign} {bound.limit:.3g}", bound.verdict
            rows.append((name, what, why, float(measured), *verdict))
        study.table(table, title, COLUMNS, rows, note)
