"""Speed against Mitsuba's own plugins: what is compared is alike, and a difference is noticed."""

from __future__ import annotations

import pytest

from mrt_mitsuba.validation.studies import rivals, roughconductor
from mrt_mitsuba.validation.tools.study import Study, Table

TINY = rivals.Extent((48, 36), 16, (0,), 2)


@pytest.fixture
def tiny(monkeypatch, variant):
    monkeypatch.setattr(rivals, "QUICK", TINY)


def _run() -> Study:
    study = Study("rivals", rivals.TITLE)
    rivals.run(study, quick=True)
    return study


def test_both_sides_show_the_same_light_and_goals_do_not_decide(tiny, monkeypatch):
    monkeypatch.setattr(rivals, "DIRECT_GOAL", 0.0)  # out of reach
    study = _run()
    assert study.passed, [str(bound) for bound in study.bounds if not bound.holds]
    assert {goal.holds for goal in study.goals if "direct" in goal.name} == {False}
    (table,) = (part for part in study.parts if isinstance(part, Table))
    assert len(table.rows) == rivals.PAIRS == 4
    assert all(row[3] > 0 and row[5] > 0 for row in table.rows)
    assert any("met in 0 of 2 scenes" in part for part in study.parts if isinstance(part, str))


def test_another_material_is_noticed(variant, monkeypatch):
    ours = roughconductor.ours
    monkeypatch.setattr(roughconductor, "ours", lambda alpha: ours(alpha) | {"fresnel": "schlick"})
    (pair,) = rivals._conductor(0, TINY)
    found = rivals._compare(pair, repeats=1)
    assert abs(found.means / pair.brightness - 1) > rivals.SAME_MEAN
