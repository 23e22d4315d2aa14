"""Every door to a render leads through one plan: what is refused, shown on the way, and stated."""

import io
import sys
from contextlib import nullcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from numpy.testing import assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rendering import exposing
from mrt_mitsuba.rendering.plan import Rounds
from mrt_mitsuba.rendering.progress import Progress, default_progress

SIZE = 16


@pytest.fixture(autouse=True)
def _plugins():
    mrt.register()


def box():
    """Mitsuba's Cornell box, small."""
    scene = mi.cornell_box()
    film = scene["sensor"]["film"]
    film["width"] = SIZE
    film["height"] = SIZE
    return scene


def adaptive(**parameters):
    return {"type": "mrt_adaptive", "nested": {"type": "path"}, **parameters}


def goal_of(result):
    step = next(step for step in result.plan.passes if isinstance(step, Rounds))
    return step.goal


def test_a_render_inside_freeze_is_refused_with_the_way_out():
    scene = mi.load_dict(box())
    integrator = mi.load_dict(adaptive(spp=16))

    @dr.freeze
    def by_mitsuba(factor):
        return mi.render(scene, integrator=integrator) * factor

    @dr.freeze
    def by_us(factor):
        return mi.TensorXf(mrt.render(scene, integrator="path", spp=2).image) * factor

    report_scene = mi.load_dict(mrt.scene_dict(3))
    again = mrt.prepare(report_scene, width=8, height=6, aa=1, aamode="none")

    @dr.freeze
    def by_recorded(factor):
        return mi.TensorXf(again().image) * factor

    for frozen in (by_mitsuba, by_us, by_recorded):
        with pytest.raises(RuntimeError) as caught:
            frozen(mi.Float(1))
        first = caught.value
        while first.__cause__ is not None:
            first = first.__cause__
        assert isinstance(first, UsageError)
        assert "mrt.prepare" in str(first)
    assert np.isfinite(mrt.render(scene, integrator="path", spp=2).image).all()  # nothing is left behind


goals = Cases()
goals({"spp": 20}, {}, 20, None, name="its own rays")
goals({"target": 9.0}, {}, 4096, 9.0, name="its own target")
goals({"target": "900%"}, {}, 4096, "900%", name="relative")
goals({"target": 9.0, "max_spp": 50}, {"maxspp": 40}, 40, 9.0, name="a bound of the caller's")
goals({"target": 9.0}, {"target": 8.0}, 4096, 8.0, name="a target of the caller's")


@pytest.mark.parametrize(("stated", "options", "most", "target"), goals)
def test_a_plan_holds_what_the_integrator_states_and_the_caller_asks(stated, options, most, target):
    result = mrt.render(box(), integrator=mi.load_dict(adaptive(**stated)), **options)
    goal = goal_of(result)
    assert goal.max_spp == most
    assert (goal.target and goal.target.plain) == target
    assert result.options.get("target") == target


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_script_on_a_terminal_shows_a_bar_that_moves(monkeypatch, capsys):
    """Long passes are cut, to the same bits; nothing else is printed."""
    assert type(default_progress()) is Progress
    whole = mrt.render(3, width=64, height=48, aa=2, aamode="none", focaldist=0).image
    monkeypatch.setattr(exposing, "WAVEFRONT", 2048)
    monkeypatch.setattr(exposing, "WAVEFRONT_SECONDS", 0)
    monkeypatch.setattr(sys, "stderr", Terminal())
    progress = default_progress()
    progress.delay = 0
    result = mrt.render(3, width=64, height=48, aa=2, aamode="none", focaldist=0, progress=progress)
    assert_array_equal(result.image, whole)
    assert "Rendering" in sys.stderr.getvalue()
    assert not capsys.readouterr().out
    steps: list[int] = []
    progress.stage = lambda *_: nullcontext(steps.append)
    mrt.render(3, width=64, height=48, aa=2, aamode="none", focaldist=0, progress=progress)
    assert steps == [512] * 6


@pytest.mark.parametrize("mode", ["noise", "none"])
def test_time_cuts_wavefronts_unless_random_numbers_depend_on_it(monkeypatch, mode):
    """Those of rounds do not; those of Mitsuba's samplers do."""
    monkeypatch.setattr(exposing, "WAVEFRONT", 512)
    monkeypatch.setattr(exposing, "WAVEFRONT_SECONDS", 1e9)  # so that any speed asks for the largest
    steps: list[int] = []
    progress = Progress()
    progress.stage = lambda *_: nullcontext(steps.append)
    scene = box()
    scene["sensor"]["sampler"] = {"type": "multijitter"}
    mrt.render(scene, integrator="path", progress=progress, aamode=mode, spp=64)
    assert (max(steps) > 512) is (mode == "noise")
