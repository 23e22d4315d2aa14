"""Figures of real runs: what they show is true."""

from __future__ import annotations

import numpy as np
import pytest

from mrt_mitsuba.validation.studies import error_vs_time
from mrt_mitsuba.validation.studies.stability import axes

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize(("axis", "hard"), [(axes.roughness, 1e-4), (axes.floor, 1e4)])
def test_an_axis_measures_both_sides(axis, hard):
    found = axis(hard, 24)
    assert np.quantile(found[axes.OURS], axes.WORST) < 16
    assert np.quantile(found[axes.THEIRS], axes.WORST) > 0.5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The reference is too coarse")
def test_a_study_answers_what_pages_show():
    cost = error_vs_time.Cost(
        size=(24, 18),
        path_size=(24, 18),
        amounts=(1, 2),
        most=4,
        counts=(4,),
        path_spp=64,
        repeats=1,
        rounds=(16,),
        targets=("20%",),
        samplers=("independent", "multijitter"),
    )
    panels = error_vs_time.scene_findings(0, cost)
    assert [bool(found.failed) for found in panels.values()] == [False, False]
    assert all(found.errors for found in panels.values())
