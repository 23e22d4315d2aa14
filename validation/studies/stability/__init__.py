"""``mrt-validate stability``: does float32 hold on stiff and extreme cases, and where must it give out?"""

from __future__ import annotations

from mrt_mitsuba.validation.studies.stability import bsdf, filters, finite, geometry, transport
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Numerical stability on stiff and extreme cases"

PARTS = (bsdf, geometry, transport, filters, finite)


def run(study: Study, *, quick: bool) -> None:
    """Run all parts, each with its tables: reflectance, geometry, light, filters, finite results."""
    for part in study.each(TITLE, PARTS):
        part.run(study, quick=quick)
