"""Figures of real runs: what they show is true, and their labels can be read."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from matplotlib.text import Text

import mrt_mitsuba as mrt
from mrt_mitsuba.validation import figures, plotting
from mrt_mitsuba.validation.compare import compare
from mrt_mitsuba.validation.studies import error_vs_time, needs
from mrt_mitsuba.validation.studies.stability import axes as curves
from mrt_mitsuba.validation.study import findings
from mrt_mitsuba.validation.work_precision import Findings, Point

pytestmark = pytest.mark.usefixtures("variant")
DATA = Path(__file__).parents[1] / "regression" / "data"


def point(name: str, seconds: float, rmse: float) -> Point:
    image = np.full((2, 2, 3), 0.5, np.float32)
    times = seconds * np.array([0.98, 1, 1.02])
    more = {"cold": 1.0, "compile": 0.5, "rays": {}, "image": image, "reference_error": 1e-3}
    return Point.of(name, times, rmse**2 * np.eye(3), difference=compare(image, image), **more)


@pytest.fixture
def found() -> Findings:
    """Three curves that end next to each other; "slow" is never the best."""
    points = [point(f"fast {n}", 0.1 * n, 0.1 / n) for n in (1, 4)]
    points += [point(f"sure aa={n}", 0.15 * n, 0.09 / n) for n in (1, 4)]
    points += [point(f"slow {n}", 0.5 * n, 0.1 / n) for n in (1, 4)]
    names = {p.name: p for p in points}
    return Findings("test", names, {}, np.zeros((2, 2, 3)), 1e-3, 3, (0.05, 0.0226, 1e-4))


def test_the_frontier_is_what_nothing_else_beats(found):
    best = [p.name for p in plotting.frontier(list(found.points.values()))]
    assert best == ["fast 1", "sure aa=1", "fast 4", "sure aa=4"]


def test_advice_names_the_soonest_and_the_next_curve(found):
    some, little, none = found.advice()
    assert some["use"] == "fast 4"
    assert some["next best"] == "sure aa=4"
    assert some["which takes"] == "1.5 times as long"
    assert little["use"] == "sure aa=4"
    assert little["next best"] is None
    assert none["use"] == "nothing comes so low"


def test_labels_stand_apart(found):
    drawn = plotting.work_precision("one", found)
    drawn.draw_without_rendering()
    axes = drawn.axes[0]
    labels = [text for text in axes.texts if text.get_text() in ("fast", "sure", "slow")]
    assert len(labels) == 3
    boxes = [Text.get_window_extent(text) for text in labels]  # without the lines that lead to them
    for one, other in combinations(boxes, 2):
        assert not one.overlaps(other)
    assert all(box.x0 > axes.get_window_extent().x1 for box in boxes)
    assert all(box.x1 < drawn.bbox.x1 for box in boxes)


def test_places_move_apart_no_more_than_they_must():
    places = plotting.apart([0.1, 0.5, 0.51, 0.52, 0.9], 0.1)
    np.testing.assert_allclose(places, [0.1, 0.41, 0.51, 0.61, 0.9])
    crowded = plotting.apart([0.97, 0.98, 0.99], 0.1)
    np.testing.assert_allclose(crowded, [0.8, 0.9, 1.0])


@pytest.mark.parametrize(
    ("axis", "hard"),
    [(curves.roughness, 1e-4), (curves.index, 1e-6), (curves.cylinder, 1e3)],
)
def test_the_first_formula_breaks_where_ours_does_not(axis, hard):
    found = axis(hard, 24)
    assert np.quantile(found[curves.OURS], curves.WORST) < 16
    assert np.quantile(found[curves.FIRST], curves.WORST) > 1000


@pytest.mark.parametrize("number", [0, 3])
def test_what_is_left_out_changes_no_picture(number):
    planned, whole = needs.scenes_of(number, (40, 30))
    one, other = (mrt.render(scene, aa=1, aamode="none", lattice="report") for scene in (planned, whole))
    assert one.plan.kernel != other.plan.kernel
    # the same formulas, in another order of their sums
    assert np.quantile(np.abs(one.image - other.image), 0.99) < 1e-4


def test_the_original_and_ours_are_alike_in_the_figure():
    (drawn,), rows = figures.beside_the_original(DATA)
    assert [row["scene"] for row in rows] == [0, 1, 2, 3, 4]
    assert max(row["mean difference"] for row in rows) < 3e-4  # scene 4: speckles of its borders of shadows
    assert len(drawn.axes) == 15


def test_stated_errors_are_true_in_the_figure():
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 24, "height": 24}
    stated, true = figures.tenths(mi.load_dict(scene), seeds=3, truth_spp=512, spp=32)
    ratio = true / stated
    assert len(ratio) == 10
    assert ratio[2:].min() > 1 / 3 and ratio.max() < 3  # the darkest pixels see no noise to speak of
    result = mrt.render(scene, integrator="path", aamode="noise", spp=32)
    assert [len(drawn.axes) for drawn in figures.maps(result)] == [2, 2]  # each with its bar of colours


@pytest.mark.slow
def test_a_study_draws_what_pages_show():
    cost = error_vs_time.Cost(
        size=(24, 18),
        path_size=(24, 18),
        amounts=(1, 2),
        most=4,
        counts=(),
        path_spp=64,
        repeats=1,
        rounds=(16,),
        targets=("20%",),
        samplers=("independent", "multijitter"),
        sampler_counts=(4,),
        lattices=("centered",),
        cold=False,
    )
    panels = error_vs_time.choices(0, cost)
    assert [bool(found.failed) for found in panels.values()] == [False, False]
    assert len(error_vs_time.advice(panels)) >= 4
    study = findings(curves.show, quick=True, places=2)
    assert study.images and study.tables["roundings"]["first"]
