"""The study of error against time: its trades, the settings it advises, and that it notices a fault."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.studies import error_vs_time
from mrt_mitsuba.validation.tools import knobs
from mrt_mitsuba.validation.tools.precision import Point
from mrt_mitsuba.validation.tools.study import Study, findings

SETTINGS = knobs.Extent((40, 30), (1, 4), 24, (1, 16), 256)


def _point(name: str, seconds: float, rmse: float) -> Point:
    grey = np.full((2, 2, 3), 0.5, np.float32)
    same = mrt.compare(grey, grey)
    return Point(name, {}, np.array([seconds]), np.array([[rmse**2]]), 0, 0, {}, grey, same, 0)


def test_advice_is_the_fastest_that_is_good_enough():
    rough, good, slow = _point("rough", 1, 0.02), _point("good", 3, 0.002), _point("slow", 9, 0.001)
    points = [rough, good, slow]
    assert [error_vs_time.fastest(points, e) for e in error_vs_time.ANSWERS] == [rough, good, good, slow]
    assert error_vs_time.fastest(points, 1e-4) is None
    # for several scenes: good enough in each, and the least time in all
    other = [_point("rough", 1, 0.001), _point("good", 2, 0.02), _point("slow", 5, 0.001)]
    every = [{p.name: p for p in scene} for scene in (points, other)]
    answers = [error_vs_time.for_all(every, error) for error in (0.02, 0.01, 1e-4)]
    assert answers == ["rough: 2e+03 ms", "slow: 1.4e+04 ms", "none of these"]


def _run(monkeypatch, quick: bool = True, **scenes: tuple[int, ...]) -> Study:
    monkeypatch.setattr(error_vs_time, "QUICK", error_vs_time.Extent(SETTINGS, scenes, 1))
    monkeypatch.setattr(error_vs_time, "FULL", error_vs_time.Extent(SETTINGS, scenes, 2))
    return findings(error_vs_time.run, quick=quick)


@pytest.mark.parametrize("quick", [True, False])
def test_small_study_holds(quick, monkeypatch, variant):
    study = _run(monkeypatch, quick, sampling=(0,), whitted=(0,), path=(0,))
    assert study.passed, study.missed
    plots, tables = study.plots.keys(), study.tables
    assert {f"scene 0, {name}-diagram" for name in ("sampling", "path")} <= plots
    assert ("choose" in tables) != quick  # one repeat says nothing of time
    assert quick or (tables["choose"].first and tables["choose"].rows[0][0] == 0)
    assert any("strip" in name for name in plots) != quick


@pytest.mark.parametrize(
    ("trade", "wrong", "bound"),
    [
        ("sampling", lambda o: o | {"aa": 1} if o["aa"] == 4 else o, "RMSE of none aa=4"),
        ("path", lambda o: o | {"spp": 8} if o.get("spp") == 16 else o, "theory"),
        ("path", lambda o: o | {"spp": 32} if o.get("spp") == 256 else o, "error of the reference"),
    ],
)
def test_faults_are_noticed(trade, wrong, bound, monkeypatch, variant):
    """Samples that do not help, noise that does not fall as it should, a reference that is too noisy."""
    make = knobs.TRADES[trade]

    def broken(number: int, extent: knobs.Extent) -> knobs.Trade:
        made = make(number, extent)
        cases = {name: wrong(options) for name, options in made.cases.items()}
        reference = wrong(made.reference) if isinstance(made.reference, dict) else made.reference
        return dataclasses.replace(made, cases=cases, reference=reference)

    monkeypatch.setitem(knobs.TRADES, trade, broken)
    assert any(bound in name for name in _run(monkeypatch, **{trade: (0,)}).missed)
