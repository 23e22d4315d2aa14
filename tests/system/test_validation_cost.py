"""Where time goes: the rays and kernels that are recorded, and what the plan leaves out."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import cost, savings
from mrt_mitsuba.validation.tools import kernels, knobs
from mrt_mitsuba.validation.tools.floor import record
from mrt_mitsuba.validation.tools.study import Study, Table

TINY = cost.Extent((40, 30), 2, (0,), 1, (32, 24))


@pytest.mark.parametrize("number", [0, 3])
def test_recorded_rays_are_those_of_the_render(number, variant):
    scene = knobs.load(mrt.scene_dict(number, width=48, height=36))
    options = {"aa": 2, "aamode": "none"}
    before = mrt.render(scene, **options, count_rays=True)
    recorder = record(scene, **options)
    counts = recorder.counts()
    assert (counts["camera"], counts["mirror"]) == (before.rays["primary"], before.rays["mirror"])
    assert counts["shadow"] == before.rays["shadow"]
    recorder.replay()
    # the scene renders as before
    np.testing.assert_array_equal(mrt.render(scene, **options).image, before.image)


def test_kernels_are_those_of_the_render(variant):
    scene = knobs.load(mrt.scene_dict(3, width=48, height=36))
    render = partial(mrt.render, scene, aa=2, aamode="sobel")
    found = kernels.profile(render, repeats=1)
    result = render()
    own = [k for k in found if k.hash]
    assert sum(k.launches for k in own) == result.kernel_launches
    assert {k.stage for k in own} == {"rendering", "edges", "anti-aliasing"}
    tracing = [k for k in found if k.kind == "traces rays"]
    assert [k.stage for k in tracing] == ["rendering", "anti-aliasing"]
    assert tracing[0].size == 48 * 36 and tracing[1].size == result.rays["primary"] - 48 * 36
    assert all(k.operations > 0 and k.seconds > 0 for k in tracing)
    # the mean over a pixel's rays, which Dr.Jit has a kernel of its own for
    assert [k.launches for k in found if k.kind == "BlockReduce"] == [3]


def test_quick_study_holds(monkeypatch, variant):
    monkeypatch.setattr(cost, "QUICK", TINY)
    few = savings.forced()[:2]
    monkeypatch.setattr(savings, "forced", lambda: few)
    study = Study("cost", cost.TITLE)
    cost.run(study, quick=True)
    assert study.passed, [str(bound) for bound in study.bounds if not bound.holds]
    tables = {part.name: part for part in study.parts if isinstance(part, Table)}
    assert tables.keys() == {"passes", "kernels", "floor", "plan"}
    assert sum(row[-1] for row in tables["kernels"].rows) == pytest.approx(1)
    assert sum(row[3] for row in tables["passes"].rows) == pytest.approx(1, abs=0.2)
    assert [row[0] for row in tables["plan"].rows] == [case.what for case in few]


def test_what_is_forced_in_does_work_and_changes_nothing(variant):
    """A case whose second render does nothing more would show a saving of nothing."""
    cases = {case.what.split(" (")[0]: case for case in savings.forced()}
    assert len(cases) == len(savings.forced())
    names = (
        "cone code",
        "texture code",
        "bounce loop",
        "shadow rays",
        "depth of field",
        "layers",
        "edge pass",
    )
    assert set(names) <= cases.keys()
    case = cases["shadow rays"]
    options = {"aa": 1, "aamode": "none", "width": 24, "height": 18, "count_rays": True, **case.shared}
    without, forced = (mrt.render(scene, **options) for scene in (case.scene, case.holding))
    assert (without.rays["shadow"], forced.rays["shadow"] > 0) == (0, True)
    assert np.abs(without.image - forced.image).max() < savings.INVISIBLE


def test_something_visible_forced_in_is_noticed(monkeypatch, variant):
    plain = report_scene(0)
    bright = dataclasses.replace(plain, lights=(*plain.lights, plain.lights[0]))
    monkeypatch.setattr(savings, "forced", lambda: [savings.Forced("a light", plain, bright)])
    study = Study("cost", cost.TITLE)
    savings.table(study, size=(32, 24), aa=1, repeats=1)
    assert not study.passed
