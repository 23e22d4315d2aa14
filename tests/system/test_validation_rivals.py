"""Speed against Mitsuba's own plugins: what is compared is alike, and a difference is noticed."""

from __future__ import annotations

from mrt_mitsuba.validation.studies import rivals, roughconductor
from mrt_mitsuba.validation.tools.study import findings

TINY = rivals.Extent((48, 36), 16, (0,), 2)


def test_both_sides_show_the_same_light_and_goals_do_not_decide(monkeypatch, variant):
    monkeypatch.setattr(rivals, "FULL", TINY)
    monkeypatch.setattr(rivals, "DIRECT_GOAL", 0.0)  # out of reach
    study = findings(rivals.run, quick=False)
    assert study.passed, study.missed
    assert {goal.verdict for goal in study.goals if "direct" in goal.name} == {"slower"}
    (table,) = study.tables.values()
    assert len(table.rows) == rivals.PAIRS == 4
    assert all(row[3] > 0 and row[5] > 0 for row in table.rows)


def test_another_material_is_noticed(variant, monkeypatch):
    ours = roughconductor.ours
    monkeypatch.setattr(roughconductor, "ours", lambda alpha: ours(alpha) | {"fresnel": "schlick"})
    (pair,) = rivals.conductor(0, TINY)
    found = rivals.compare_pair(pair, repeats=1)
    assert abs(found.means / pair.brightness - 1) > rivals.SAME_MEAN
