"""The stability study: it passes, and it misses its bounds once a formula or a renderer loses its care."""

from __future__ import annotations

from typing import Any

import drjit as dr
import pytest

from mrt_mitsuba.plugins import fresnel, lobes
from mrt_mitsuba.validation.studies import stability
from mrt_mitsuba.validation.study import findings

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.slow
def test_every_case_holds():
    whole = findings(stability.run, quick=True)
    assert whole.missed == set()
    assert len(whole.bounds) == 27
    assert [*whole.tables] == ["roundings"]


HIGHLIGHT = "value of a highlight along the roughness α"
dielectric = fresnel.fresnel_dielectric


def report_tan2_theta(v: Any) -> Any:
    """From the cosine of the vector made one unit long, as in the report."""
    c2 = dr.square(dr.normalize(v).z)
    return (1 - c2) / c2


def steep(cos_theta: Any, *iors: Any) -> Any:
    return dielectric(dr.sqrt(1 - dr.square(dr.sqrt(1 - dr.square(cos_theta)))), *iors)


@pytest.mark.parametrize(
    ("module", "name", "value", "bound"),
    [
        (
            lobes,
            "tan2_theta",
            report_tan2_theta,
            "roundings of the value of a highlight along the roughness α",
        ),
        (fresnel, "fresnel_dielectric", steep, "error of F within 40 float32 cosines of the critical angle"),
    ],
)
def test_a_loss_of_care_misses_its_bound(monkeypatch, module, name, value, bound):
    monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(stability, "PARTS", stability.PARTS[:2])
    monkeypatch.setattr(stability.axes, "AXES", stability.axes.AXES[:1])
    assert bound in findings(stability.run, quick=True).missed
