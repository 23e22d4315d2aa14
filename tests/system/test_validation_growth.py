"""The study of growth: its exponents, and that it notices code that grows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import growth
from mrt_mitsuba.validation.tools.study import Study, findings


def test_exponents_are_recovered_with_an_interval():
    sizes = [10**k for k in range(6)]
    found = growth.fit({n: 0.5 * n**0.7 for n in sizes})
    assert (found.value, found.half_width) == (pytest.approx(0.7), pytest.approx(0, abs=1e-9))
    assert found.sizes == sizes[-4:] and found.scale == pytest.approx(0.5)
    noise = np.random.default_rng(0).normal(0, 0.1, (200, 6))
    fits = [growth.fit({n: n**0.7 * np.exp(e) for n, e in zip(sizes, row, strict=True)}) for row in noise]
    inside = np.mean([f.low <= 0.7 <= f.high for f in fits])
    assert inside == pytest.approx(growth.LEVEL, abs=0.05)  # three standard deviations of 200 trials
    assert growth.fit({1: 1.0, 10: 2.0}).half_width == np.inf  # two points have no interval


@pytest.mark.parametrize(
    ("value", "half_width", "reading"),
    [
        (0.301, 0.1, "2 times as long: less than"),
        (1.3, 0.1, "more than in proportion"),
        (0.95, 0.1, "consistent with growth in proportion"),
        (-0.3, 0.6, "consistent with no growth"),
        (0.1, 0.2, "consistent with no growth"),
        (0.1, 1.5, "too uncertain"),
    ],
)
def test_readings_follow_the_interval(value, half_width, reading):
    assert reading in growth.Exponent(value, half_width, 1.0, (1, 10)).reading()


@pytest.mark.parametrize("what", growth.SERIES)
def test_series_grow_in_what_they_are_named_after(what):
    scene, (width, height), options = growth.SERIES[what](49)
    sizes = {
        "pixels": width * height,
        "samples a pixel": options["aa"] ** 2,
        "spheres": len(scene.spheres),
        "triangles": sum(len(m.faces) for m in scene.meshes),
        "lights": len(scene.lights),
        "bounces": options.get("integrator", {}).get("max_depth"),
    }
    assert sizes[what] == pytest.approx(49, abs=1)  # two triangles fill a square


def _run(monkeypatch, repeats: int = 1, **sizes) -> Study:
    monkeypatch.setattr(growth, "QUICK", growth.Extent(sizes, repeats))
    return findings(growth.run, quick=True)


def test_small_study_holds_and_draws(monkeypatch, variant):
    study = _run(monkeypatch, 2, lights=(1, 9, 12))
    assert study.passed, study.missed
    assert study.plots.keys() == {"growth"} and study.tables.keys() == {"exponents", "growth"}
    rows = study.tables["growth"].rows
    assert [row[1] for row in rows] == [1, 9, 12]
    assert rows[1][-1] == pytest.approx(rows[2][-1], rel=0.01) and rows[1][-1] > 0  # a loop over lights


def test_code_that_grows_is_noticed(monkeypatch, variant):
    """Planes are code of their own, each. One repeat says nothing of time."""

    def planes(count: int) -> growth.Job:
        scene = report_scene(0)
        return dataclasses.replace(scene, planes=scene.planes * count), (32, 24), {"aa": 1}

    monkeypatch.setitem(growth.SERIES, "planes", planes)
    study = _run(monkeypatch, planes=(1, 2, 6))
    assert [bound.holds for bound in study.bounds if "operations" in bound.name] == [False]
    assert not study.plots and study.tables.keys() == {"growth"}
