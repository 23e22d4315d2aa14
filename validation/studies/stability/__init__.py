"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?

First along the axes that are hard on it (``axes``), then in tables of cases with limits (``bounds``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from mrt_mitsuba.validation.studies.stability import axes, bounds
from mrt_mitsuba.validation.study import Study

TITLE = "Numerical stability on stiff and extreme cases"

# by the name of their table: its title, its cases, quick or not, and its note
PARTS: dict[str, tuple[str, Callable[[bool], Iterable[bounds.Case]], str]] = {
    "bsdf": ("Reflectance", bounds.reflectance, bounds.REFLECTANCE),
    "transport": ("Light paths", bounds.light_paths, bounds.PATHS),
    "placements": ("Scenes scaled and moved", bounds.placements, ""),
}


def run(study: Study, *, quick: bool) -> None:
    """Make a table of each part, and hold its cases to their limits."""
    axes.show(study, quick=quick)
    study.texts.append("The least fault that a case shows is as large as its limit; of counts, a single one.")
    for table, (title, cases, note) in study.each(TITLE, PARTS.items()):
        rows = []
        for case in cases(quick):
            row = {"case": case.name, "what": case.what, "why": case.why, "measured": float(case.measured)}
            if case.limit is None:
                row |= {"bound": "-", "": "cannot hold"}
            else:
                study.at_most(f"{title}: {case.name}", case.measured, case.limit, case.why)
                row |= {"bound": f"<= {case.limit:.3g}", "": study.bounds[-1].verdict}
            rows.append(row)
        study.records(table, title, rows, note)
