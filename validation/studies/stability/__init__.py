"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?

First along the axes that are hard on it (``curves``), then by cases, each a row with a limit or a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from mrt_mitsuba.validation.studies.stability import curves, finite, geometry, reflectance, transport
from mrt_mitsuba.validation.studies.stability.case import Case
from mrt_mitsuba.validation.study import Bound, Study

TITLE = "Numerical stability on stiff and extreme cases"


ROUNDINGS = "A rounding is 2⁻²⁴ = 6e-8. Truth: the same rays in float64."
# by the name of their table: its title, its cases, quick or not, and its note
PARTS: dict[str, tuple[str, Callable[[bool], Iterable[Case]], str]] = {
    "bsdf": ("Reflectance", reflectance.cases, reflectance.NOTE),
    "geometry": ("Geometry", geometry.cases, ROUNDINGS),
    "transport": ("Light transport", transport.cases, transport.NOTE),
    "filters": ("Filters", finite.of_filters, ""),
    "finite": ("Finite and not negative", finite.in_bulk, finite.NOTE),
}


def run(study: Study, *, quick: bool) -> None:
    """Make a table of each part, and hold its cases to their limits."""
    curves.show(study, quick=quick)
    study.texts.append("The least fault that a case shows is as large as its limit; of counts, a single one.")
    for table, (title, cases, note) in study.each(TITLE, PARTS.items()):
        rows = []
        for case in cases(quick):
            measured = float(case.measured)
            row = {"case": case.name, "what": case.what, "why": case.why, "measured": measured}
            if case.limit is None:
                rows.append(row | {"bound": "-", "": "cannot hold"})
            else:
                bound = Bound(f"{title}: {case.name}", measured, case.limit, case.at_most, case.why)
                study.bounds.append(bound)
                rows.append(row | {"bound": f"{bound.sign} {bound.limit:.3g}", "": bound.verdict})
        study.records(table, title, rows, note)
