"""The stability study: it passes, and it misses its bounds once a formula or a renderer loses its care."""

from __future__ import annotations

from typing import Any

import drjit as dr
import pytest
from cases import Cases

from mrt_mitsuba.plugins import fresnel, lobes
from mrt_mitsuba.validation.studies import stability
from mrt_mitsuba.validation.study import findings

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.slow
def test_every_case_holds_and_is_a_row_with_a_mark():
    whole = findings(stability.run, quick=True)
    assert whole.missed == set()
    assert len(whole.bounds) > 40
    axes = whole.tables.pop("roundings")  # has a bound for each axis
    rows = [row for table in whole.tables.values() for row in table["rows"]]
    assert {row[-1] for row in rows} == {"ok", "cannot hold"}
    assert sum(row[-1] == "ok" for row in rows) == len(whole.bounds) - len(axes["rows"])
    # what cannot hold says why
    assert all(len(row[2]) > 30 for row in rows if row[-1] == "cannot hold")


dielectric = fresnel.fresnel_dielectric


def report_tan2_theta(v: Any) -> Any:
    """From the cosine of the vector made one unit long, as in the report."""
    c2 = dr.square(dr.normalize(v).z)
    return (1 - c2) / c2


def steep(cos_theta: Any, *iors: Any) -> Any:
    return dielectric(dr.sqrt(1 - dr.square(dr.sqrt(1 - dr.square(cos_theta)))), *iors)


losses = Cases()
Change = tuple[Any, str, Any]  # of a module, or a class: a name and what it becomes


def loss(name: str, part: str, *changes: Change, missed: list[str]) -> None:
    """Add changes that lose digits, and the bounds of a part of the study that they must miss."""
    losses(part, changes, missed, name=name)


smooth = [f"value, alpha {alpha:g}" for alpha in (1e-4, 1e-3)]
loss("tan θ in the plugin", "bsdf", (lobes, "tan2_theta", report_tan2_theta), missed=smooth)
at_grazing = ["F, largest", "F at the critical angle"]
loss("Fresnel", "bsdf", (fresnel, "fresnel_dielectric", steep), missed=at_grazing)


@pytest.mark.parametrize(("part", "changes", "expected"), losses)
def test_a_loss_of_care_misses_its_bounds(monkeypatch, part, changes, expected):
    for place, name, value in changes:
        monkeypatch.setattr(place, name, value)
    monkeypatch.setattr(stability, "PARTS", {part: stability.PARTS[part]})
    monkeypatch.setattr(stability.axes, "AXES", ())
    missed = findings(stability.run, quick=True).missed
    assert {f"{stability.PARTS[part][0]}: {name}" for name in expected} <= missed
