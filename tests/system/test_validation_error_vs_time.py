"""The study of error against time: the rays it records, the front it draws, the sentences it writes."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scenes import report_scene
from mrt_mitsuba.validation import cost, error_vs_time, knobs
from mrt_mitsuba.validation.floor import record
from mrt_mitsuba.validation.study import Plot, Study, Table
from mrt_mitsuba.validation.warm import Warm, measure

TINY = error_vs_time.Extent(
    knobs.Extent((40, 30), (1, 4), 8, (1, 16), 64),
    (0,),
    (),
    (0,),
    (),
    True,
    1,
    cost.Extent((40, 30), 1, (0,), 1, (32, 64), (), (), (), ()),
)


def _point(name: str, seconds: float, rmse: float) -> error_vs_time.Point:
    return error_vs_time.Point(name, Warm(None, seconds, 0.1, seconds), rmse, rmse, rmse, rmse)


@pytest.mark.parametrize("number", [0, 3])
def test_recorded_rays_are_those_of_the_render(number, variant):
    scene = knobs.load(mrt.scene_dict(number, width=48, height=36))
    options = {"aa": 2, "aamode": "none"}
    before = mrt.render(scene, **options, count_rays=True)
    recorder = record(scene, **options)
    counts = recorder.counts()
    assert (counts["camera"], counts["mirror"]) == (before.rays["primary"], before.rays["mirror"])
    assert counts["shadow"] == before.rays["shadow"]
    assert recorder.replay() > 0
    # the scene renders as before
    np.testing.assert_array_equal(mrt.render(scene, **options).image, before.image)


def test_front_is_what_nothing_beats_in_both():
    points = [
        _point("a", 1, 0.5),
        _point("b", 2, 0.6),
        _point("c", 3, 0.1),
        _point("d", 4, 0.1),
        _point("e", 0.5, 0.9),
    ]
    assert [p.name for p in error_vs_time.front(points)] == ["e", "a", "c"]


def test_reading_names_the_best_and_the_worst_buy():
    points = [_point(f"n={n}", n, n**-0.5) for n in (1, 4, 16)] + [_point("slow", 40, 0.5)]
    text = error_vs_time._reading(None, points, error_vs_time.front(points), 0.0)
    assert "to the power -0.5" in text and "1 of 4 settings are beaten" in text
    assert "worst buy is slow, 10 times as long" in text


def test_answers_take_the_fastest_that_is_good_enough():
    points = [_point("rough", 1, 0.02), _point("good", 3, 0.002), _point("slow", 9, 0.001)]
    rows = error_vs_time._answers(SimpleNamespace(scene="0"), points)
    assert [row[2] for row in rows] == ["rough", "good", "good", "slow"]


def test_times_are_medians_of_runs_in_turn():
    order = []
    found = measure({name: (lambda name=name: order.append(name) or name) for name in "ab"}, repeats=3)
    assert order == list("ab" * 4) and found["b"].result == "b"
    assert found["a"].seconds >= 0 and found["a"].spread >= 0


def test_meshed_cone_closes_on_the_analytic_one(variant):
    scene = report_scene(9)
    options = {"width": 64, "height": 48, "aa": 2, "aamode": "none"}
    exact = mrt.render(scene, **options).image
    errors = [np.abs(mrt.render(knobs.meshed(scene, n), **options).image - exact).mean() for n in (8, 64)]
    assert errors[1] < 0.1 * errors[0]
    mesh = knobs.meshed(scene, 16).meshes[0]
    edges = np.sort(
        np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1
    )
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed


def test_quick_study_holds(monkeypatch, variant):
    monkeypatch.setattr(error_vs_time, "QUICK", TINY)
    study = Study("error-vs-time", error_vs_time.TITLE)
    error_vs_time.run(study, quick=True)
    assert study.passed, [str(bound) for bound in study.bounds if not bound.holds]
    assert {part.name for part in study.parts if isinstance(part, Plot)} == {"sampling-0", "path-0", "cone-9"}
    tables = {part.name: part for part in study.parts if isinstance(part, Table)}
    assert {"settings", "floor", "plan", "growth", "exponents"} <= tables.keys()
    front = sorted((row[1], row[5]) for row in tables["sampling-0"].rows if row[-1] == "yes")
    assert front and [error for _, error in front] == sorted((error for _, error in front), reverse=True)


def test_samples_that_do_not_help_are_noticed(monkeypatch, variant):
    render = mrt.render
    one = dataclasses.replace(TINY, path=(), cone=False)
    monkeypatch.setattr(error_vs_time, "QUICK", one)

    def stuck(scene, **options):
        """Four samples a side are one."""
        return render(scene, **(options | {"aa": 1} if options["aa"] == 4 else options))

    monkeypatch.setattr(knobs.mrt, "render", stuck)
    study = Study("error-vs-time", error_vs_time.TITLE)
    error_vs_time.run(study, quick=True)
    assert any("RMSE at aa=4" in bound.name for bound in study.bounds if not bound.holds)
