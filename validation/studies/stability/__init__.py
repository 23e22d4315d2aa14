"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from mrt_mitsuba.validation.studies.stability import finite, geometry, reflectance, transport
from mrt_mitsuba.validation.studies.stability.cases import Case
from mrt_mitsuba.validation.tools.study import Bound, Study

TITLE = "Numerical stability on stiff and extreme cases"
COLUMNS = ("case", "what", "why", "measured", "bound", "")

# By the name of their table: its title, its cases, and a note
PARTS: dict[str, tuple[str, Callable[[bool], Iterable[Case]], str]] = {
    "bsdf": ("Reflectance", reflectance.cases, reflectance.NOTE),
    "geometry": ("Geometry", geometry.cases, "A rounding is 2⁻²⁴ = 6e-8. Truth: the same rays in float64."),
    "transport": ("Light transport", transport.cases, transport.NOTE),
    "filters": ("Filters", finite.of_filters, ""),
    "finite": ("Finite and not negative", finite.in_bulk, finite.NOTE),
}


def run(study: Study, *, quick: bool) -> None:
    """Make a table of each part, and hold its cases to their limits."""
    for name, (title, cases, note) in study.each(TITLE, PARTS.items()):
        rows = []
        for case in cases(quick):
            first, measured = (case.name, case.what, case.why), float(case.measured)
            if case.limit is None:
                rows.append((*first, measured, "-", "cannot hold"))
                continue
            least = case.fault[0] if case.fault else f"{case.limit:.3g}" if case.limit else "a single one"
            why = f"least fault: {least}" if case.at_most else case.why
            held = [(first, Bound(f"{title}: {case.name}", measured, case.limit, case.at_most, why))]
            if case.fault:
                made = (f"{case.name}, its fault", least, "must be seen")
                limit = 2 * case.limit or 1.0
                held.append((made, Bound(f"{title}: {made[0]}", float(case.fault[1]), limit, False, "seen")))
            for words, bound in held:
                rows.append((*words, bound.measured, f"{bound.sign} {bound.limit:.3g}", bound.verdict))
                study.bounds.append(bound)
        study.table(name, title, COLUMNS, rows, note)
