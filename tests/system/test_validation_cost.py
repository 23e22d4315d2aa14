"""Where time goes: the rays and kernels that are recorded, and what the plan leaves out."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import cost, savings
from mrt_mitsuba.validation.tools import kernels
from mrt_mitsuba.validation.tools.costs import record, scene_cost
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.study import findings
from mrt_mitsuba.validation.tools.warm import measure, ratio

TINY = cost.Extent((40, 30), 2, (0,), 1, (32, 24))


@pytest.mark.parametrize("number", [0, 3])
def test_recorded_rays_are_those_of_the_render(number, variant):
    found = scene_cost(number, (48, 36), 2, repeats=1)
    assert found.recorded == {"camera": found.counted["primary"], "mirror": found.counted["mirror"],
                              "shadow": found.counted["shadow"]}  # fmt: skip
    assert found.share_off == 0 and found.counted["primary"] == 48 * 36 * 4
    missing = dataclasses.replace(found, recorded={**found.recorded, "mirror": 0})
    assert missing.share_off > 100 * cost.MOST_OFF
    scene = load(mrt.scene_dict(number, width=48, height=36))
    record(scene, aa=2, aamode="none").replay()


def test_kernels_are_those_of_the_render(variant):
    scene = load(mrt.scene_dict(3, width=48, height=36))
    render = partial(mrt.render, scene, aa=2, aamode="sobel")
    found = kernels.profile(render, repeats=1)
    result = render()
    own = [k for k in found if k.hash]
    assert sum(k.launches for k in own) == result.kernel_launches
    pixels = {k.stage for k in own if k.size > 1}  # a single thread reads the camera
    assert pixels == {"rendering", "edges", "anti-aliasing"}
    tracing = [k for k in found if k.kind == "traces rays"]
    assert [k.stage for k in tracing] == ["rendering", "anti-aliasing"]
    assert tracing[0].size == 48 * 36 and tracing[1].size == result.rays["primary"] - 48 * 36
    assert all(k.operations > 0 and k.seconds > 0 for k in tracing)
    # the mean over a pixel's rays, which Dr.Jit has a kernel of its own for
    assert [k.launches for k in found if k.kind == "BlockReduce"] == [3]


def test_small_study_holds(monkeypatch, variant):
    monkeypatch.setattr(cost, "QUICK", TINY)
    few = savings.forced()[:2]
    monkeypatch.setattr(savings, "forced", lambda: few)
    study = findings(cost.run, quick=True)
    assert study.passed, study.missed
    assert not study.goals  # so small a picture says nothing of speed
    tables = study.tables
    assert tables.keys() == {"passes", "kernels", "floor", "plan"}
    assert sum(row[-1] for row in tables["kernels"].rows) == pytest.approx(1)
    launches = [sum(row[i] for row in tables[name].rows) for name, i in (("passes", 5), ("kernels", 4))]
    assert launches[0] == launches[1] > 0  # no kernel is outside of the passes
    assert [row[0] for row in tables["plan"].rows] == [case.what for case in few]


def test_runs_are_timed_in_turn():
    order: list[str] = []
    runs = {name: (lambda name=name: order.append(name) or name) for name in "ab"}
    found = measure(runs, repeats=3)
    assert order == list("ab" * 4) and found["b"].result == "b" and found["a"].seconds >= 0
    order.clear()
    measure(runs, repeats=9, enough=0)  # a median needs three
    assert order == list("ab" * 4)
    order.clear()
    assert ratio(runs["a"], runs["b"], repeats=3).median > 0
    assert order == list("ab" + "ab" + "ba" + "ab")


@pytest.mark.parametrize("case", savings.forced(), ids=lambda case: case.what.split(" (")[0])
def test_what_is_forced_in_does_work_and_changes_nothing(case, variant):
    """More code, more kernels or more rays; a case that adds none would show a saving of nothing."""
    pair = [partial(render, count_rays=True) for render in savings.renders(case, (24, 18), 1)]
    images = [render().image for render in pair]
    assert np.abs(images[0] - images[1]).max() < savings.INVISIBLE
    work = []
    for render in pair:
        found = [k for k in kernels.profile(render, repeats=1) if k.hash]
        work.append((sum(k.operations for k in found), sum(render().rays.values())))
    assert work[1] > work[0] or work[1][1] > work[0][1]


def test_something_visible_forced_in_is_noticed(monkeypatch, variant):
    plain = report_scene(0)
    bright = dataclasses.replace(plain, lights=(*plain.lights, plain.lights[0]))
    monkeypatch.setattr(savings, "forced", lambda: [savings.Forced("a light", plain, bright)])
    assert not findings(savings.table, size=(32, 24), aa=1, repeats=1).passed
