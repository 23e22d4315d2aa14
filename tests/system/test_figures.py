"""Figures of real runs: what they show is true."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.studies import error_vs_time, honest
from mrt_mitsuba.validation.studies.stability import axes
from mrt_mitsuba.validation.work_precision import Findings, Point, diagram, frontier

pytestmark = pytest.mark.usefixtures("variant")


def point(name: str, seconds: float, rmse: float) -> Point:
    image = np.full((2, 2, 3), 0.5, np.float32)
    times = seconds * np.array([0.999, 1, 1.001])
    return Point.of(name, times, rmse**2 * np.eye(3), cold=1.0, image=image, reference_error=1e-3)


@pytest.fixture
def found() -> Findings:
    """Three curves; "slow" is never the best."""
    points = [point(f"fast {n}", 0.1 * n, 0.1 / n) for n in (1, 4)]
    points += [point(f"sure, aa={n}", 0.15 * n, 0.09 / n) for n in (1, 4)]
    points += [point(f"slow {n}", 0.5 * n, 0.1 / n) for n in (1, 4)]
    names = {p.name: p for p in points}
    return Findings("test", names, {}, np.zeros((2, 2, 3)), 1e-3, 3)


def test_the_frontier_is_what_nothing_else_beats(found):
    best = [p.name for p in frontier(list(found.points.values()))]
    assert best == ["fast 1", "sure, aa=1", "fast 4", "sure, aa=4"]


def test_a_diagram_names_its_lines(found):
    drawn = diagram("one", found)
    drawn.draw_without_rendering()
    (legend,) = drawn.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["within the reference's own error", "fast", "sure, aa", "slow"]
    box = legend.get_window_extent()
    assert box.y1 < drawn.axes[0].get_window_extent().y0  # below the plot


@pytest.mark.parametrize(("axis", "hard"), [(axes.roughness, 1e-4), (axes.ball, 1e4)])
def test_an_axis_measures_both_sides(axis, hard):
    found = axis(hard, 24)
    assert np.quantile(found[axes.OURS], axes.WORST) < 16
    assert np.quantile(found[axes.THEIRS], axes.WORST) > 0.5


def test_stated_errors_are_true_in_the_figure():
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 24, "height": 24}
    stated, true = honest.tenths(mi.load_dict(scene), seeds=3, truth_spp=512, spp=32)
    ratio = true / stated
    assert len(ratio) == 10
    assert ratio[2:].min() > 1 / 3 and ratio.max() < 3  # the darkest pixels see no noise to speak of
    result = mrt.render(scene, integrator="path", aamode="noise", spp=32)
    assert [len(drawn.axes) for drawn in plotting.maps(result)] == [2, 2]  # each with its bar of colours


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The reference is too coarse")
def test_a_study_answers_what_pages_show():
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
    )
    panels = error_vs_time.choices(0, cost)
    assert [bool(found.failed) for found in panels.values()] == [False, False]
    assert [row["in"] for row in error_vs_time.advice(panels)] == list(panels)
