"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?

A case is a row: its name; what is measured; why it is held to its limit, or cannot hold; the figure; the
limit, if there is one; and the least fault that it shows, if one was made: in words, with the figure that
came of it, which must be twice the limit. Without one, the least fault is the limit itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from mrt_mitsuba.validation.studies.stability import finite, geometry, reflectance, transport
from mrt_mitsuba.validation.tools.study import Study

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
    for table, (title, cases, note) in study.each(TITLE, PARTS.items()):
        rows: list[tuple[Any, ...]] = []
        for name, what, why, measured, *held in cases(quick):
            if not held:
                rows.append((name, what, why, float(measured), "-", "cannot hold"))
                continue
            limit, (fault, seen) = held[0], held[1] if len(held) > 1 else ("", 0)
            least = fault or (f"{limit:.3g}" if limit else "a single one")
            study.at_most(f"{title}: {name}", measured, limit, f"least fault: {least}")
            words = [(name, what, why)]
            if fault:
                study.at_least(f"{title}: {name}, its fault", seen, 2 * limit or 1.0, "must be seen")
                words.append((f"{name}, its fault", fault, "must be seen"))
            for row, bound in zip(words, study.bounds[-len(words) :], strict=True):
                rows.append((*row, bound.measured, f"{bound.sign} {bound.limit:.3g}", bound.verdict))
        study.table(table, title, COLUMNS, rows, note)
