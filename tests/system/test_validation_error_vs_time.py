"""The study of error against time: the front it draws, the sentences it writes, the settings it advises."""

from __future__ import annotations

import dataclasses

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import error_vs_time
from mrt_mitsuba.validation.tools import knobs
from mrt_mitsuba.validation.tools.points import Point, amounts, fastest, front
from mrt_mitsuba.validation.tools.readings import reading
from mrt_mitsuba.validation.tools.study import Plot, Study, Table
from mrt_mitsuba.validation.tools.warm import Warm, measure, ratio

TINY = error_vs_time.Extent(
    knobs.Extent((40, 30), (1, 4), 8, (1, 16), 64), (0,), (), (0,), (), cone=True, repeats=1
)


def _point(name: str, seconds: float, rmse: float) -> Point:
    return Point(name, Warm(None, seconds, 0.1, seconds), rmse, rmse, rmse, rmse, {"primary": 1})


def test_front_is_what_nothing_beats_in_both():
    points = [
        _point("a", 1, 0.5),
        _point("b", 2, 0.6),
        _point("c", 3, 0.1),
        _point("d", 4, 0.1),
        _point("e", 0.5, 0.9),
    ]
    assert [p.name for p in front(points)] == ["e", "a", "c"]


def test_advice_is_the_fastest_that_is_good_enough():
    rough, good, slow = _point("rough", 1, 0.02), _point("good", 3, 0.002), _point("slow", 9, 0.001)
    points = [rough, good, slow]
    assert [fastest(points, error) for error in error_vs_time.ANSWERS] == [rough, good, good, slow]
    assert fastest(points, 1e-4) is None
    # for several scenes: good enough in each, and the least time in all
    other = [_point("rough", 1, 0.001), _point("good", 2, 0.02), _point("slow", 5, 0.001)]
    samplings = {"0": points, "1": other}
    assert error_vs_time._for_all(samplings, 0.02) == "rough: 2e+03 ms"
    assert error_vs_time._for_all(samplings, 0.01) == "slow: 1.4e+04 ms"
    assert error_vs_time._for_all(samplings, 1e-4) == "none of these"


def test_amounts_are_read_from_names():
    points = [_point(name, 1, 1) for name in ("path spp=16", "path spp=4", "mrt_whitted", "luma aa=2 report")]
    assert (amounts(points, "spp="), amounts(points, "aa=")) == ([4, 16], [2])


def _sampling(default: tuple[float, float], report: float, centered: float) -> list[Point]:
    points = [_point("none aa=1 centered", 1, 0.01), _point("none aa=4 report", 4, report)]
    points += [_point("none aa=4 centered", 4, centered), _point("sobel aa=4 report", *default)]
    modes = {"luma": 3, "sobel": 2, "geometry": 4}
    return points + [_point(f"{mode} aa=4 centered", 2, k * centered) for mode, k in modes.items()]


def test_reading_of_anti_aliasing_follows_the_points():
    text = reading("sampling", _sampling((2, 0.02), 0.02, 0.002))
    assert "is matched by none aa=1 centered (1e+03 ms, RMSE 0.01), in 50% of its time" in text
    assert "shifts the picture" in text and "RMSE of 0.02 at aa=4, where the centered one has 0.002" in text
    assert "sobel comes nearest to it, with 2 times the error in 50% of the time" in text
    text = reading("sampling", _sampling((0.5, 0.001), 0.002, 0.002))
    assert "has less error than every faster setting" in text and "Both lattices come to the same" in text


def test_reading_of_whitted_follows_the_points():
    points = [_point(f"min_contribution={255 * c:g}/255", 2, 0) for c in knobs.CUT_OFFS]
    points[1] = _point(points[1].name, 1, 1e-5)
    limits = dict(zip(knobs.DEPTHS, (0.1, 0.001, 1e-4, 1e-5, 1e-5), strict=True))
    points += [_point(f"max_depth={d}", d / 10, error) for d, error in limits.items()]
    text = reading("whitted", [*points, _point("fresnel=schlick", 0.9, 0.03)])
    assert "takes 50% of the time of none, for an RMSE of 1e-05" in text
    assert "max_depth=2 is the least limit" in text and "takes 20% of the time of max_depth=10" in text
    assert "90% of the time of the exact one and is up to 0.03 off" in text
    assert "not to be seen" in reading("whitted", [*points, _point("fresnel=schlick", 0.9, 1e-4)])


def test_reading_of_path_follows_the_points():
    def points(noise: float) -> list[Point]:
        found = [_point(f"path spp={n}", n, noise * n**-0.5) for n in (1, 4, 16)]
        found += [_point(f"direct spp={n}", n, 0.5) for n in (1, 4, 16)]
        return [*found, _point("mrt_whitted", 2, 0.3), _point("mrt_whitted, no clamp", 2, 0.2)]

    text = reading("path", points(0.6))
    assert "RMSE of 0.3 in 2e+03 ms, 0.2 without its clamp; path spp=4 has less, and takes 2 times" in text
    assert "to the power -0.50; direct, without bounces, is left with 0.5" in text
    assert "no path up to spp=16 has less" in reading("path", points(9.0))
    assert "direct does no worse" in reading("path", points(9.0))


def test_readings_of_lens_and_cone_follow_the_points():
    filters = [_point("filter report", 1, 0.3), _point("filter corrected", 2, 0.2)]
    lenses = [_point("thinlens spp=4", 4, 0.4), _point("thinlens spp=16", 16, 0.1)]
    text = reading("lens", filters + lenses)
    assert "thinlens spp=16 is the fastest lens" in text and "takes 8 times as long" in text
    assert "No lens up to thinlens spp=4" in reading("lens", [*filters, lenses[0]])
    exact, coarse, fine = (
        _point("analytic", 3, 0),
        _point("8 segments", 1, 0.1),
        _point("32 segments", 2, 1e-4),
    )
    text = reading("cone", [coarse, fine, exact])
    assert "below half a step of 8 bits is 32 segments" in text and "takes 1.5 times as long" in text
    assert "No mesh" in reading("cone", [coarse, exact])


def test_times_are_medians_of_runs_in_turn():
    order: list[str] = []
    runs = {name: (lambda name=name: order.append(name) or name) for name in "ab"}
    found = measure(runs, repeats=3)
    assert order == list("ab" * 4) and found["b"].result == "b"
    assert found["a"].seconds >= 0 and found["a"].spread >= 0
    order.clear()
    measure(runs, repeats=9, enough=0)  # a median needs three
    assert order == list("ab" * 4)
    order.clear()
    assert ratio(runs["a"], runs["b"], repeats=3).median > 0
    assert order == list("ab" + "ab" + "ba" + "ab")


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
    plots = {part.name: part for part in study.parts if isinstance(part, Plot)}
    assert plots.keys() == {"sampling-0", "path-0", "cone-9"} and all(p.caption for p in plots.values())
    tables = {part.name: part for part in study.parts if isinstance(part, Table)}
    assert {"choose", "settings"} <= tables.keys() and tables["choose"].first
    rows = [dict(zip(error_vs_time.COLUMNS, row, strict=True)) for row in tables["sampling-0"].rows]
    ahead = sorted((row["seconds"], row["RMSE"]) for row in rows if row["front"])
    assert ahead and [error for _, error in ahead] == sorted((error for _, error in ahead), reverse=True)
    assert rows[0]["camera rays"] == 40 * 30 and rows[0]["shadow rays"] > 0
    by_path = {row[0]: row for row in tables["path-0"].rows}
    assert by_path["path spp=16"][4:7] == (40 * 30 * 16, "–", "–")


def test_samples_that_do_not_help_are_noticed(monkeypatch, variant):
    render = mrt.render
    monkeypatch.setattr(error_vs_time, "QUICK", dataclasses.replace(TINY, path=(), cone=False))

    def stuck(scene, **options):
        """Four samples a side are one."""
        return render(scene, **(options | {"aa": 1} if options["aa"] == 4 else options))

    monkeypatch.setattr(knobs.mrt, "render", stuck)
    study = Study("error-vs-time", error_vs_time.TITLE)
    error_vs_time.run(study, quick=True)
    assert any("RMSE at aa=4" in bound.name for bound in study.bounds if not bound.holds)
