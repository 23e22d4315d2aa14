"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?

First along the axes that are hard on it (``axes``), then in cases with limits (``bounds``).
"""

from __future__ import annotations

from mrt_mitsuba.validation.studies.stability import axes, bounds
from mrt_mitsuba.validation.study import Study

TITLE = "Numerical stability on stiff and extreme cases"
PARTS = (axes.show, bounds.reflectance, bounds.light_paths, bounds.placements)


def run(study: Study, *, quick: bool) -> None:
    """Draw the axes, and hold cases to their limits."""
    study.texts.append("The least fault that a case shows is as large as its limit; of counts, a single one.")
    for part in PARTS:
        part(study, quick=quick)
