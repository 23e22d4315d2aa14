"""Signals meet everything as it was, once the block that guards against them is left."""

from __future__ import annotations

import ctypes
import signal
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import interrupts, scene_dict
from mrt_mitsuba.plugins.signals import left_to_other_threads


@pytest.fixture(autouse=True)
def heeded() -> Iterator[None]:
    """A shell that runs the tests in the background has Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_deferred_interrupt_comes_at_the_end_of_the_block():
    """Raised while Mitsuba is imported, it ended the process in nanobind's code."""
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts.defer_signals():
        with interrupts.defer_signals():
            signal.raise_signal(signal.SIGINT)
        done.append("the end of an inner block is no safe place")
    assert done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    interrupts.deliver_pending()  # nothing is left
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupts.defer_signals():
        signal.raise_signal(signal.SIGINT)  # ignored before, and still


def test_a_deferred_interrupt_is_delivered_once_at_a_safe_place():
    """A terminal sends it to a group of processes, whose leader may send it once more."""
    seen = []
    signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    with interrupts.defer_signals():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert seen == []
        interrupts.deliver_pending()
        assert seen == [signal.SIGINT]
    assert seen == [signal.SIGINT]


LOADING = """
import os, signal
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
from mrt_mitsuba.user_plugins import load
with open("mine.py", "w") as file:
    file.write('''
import os, signal
import mitsuba as mi
class Mine(mi.BSDF):
    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass
mi.register_bsdf("mine", Mine)
''')
load("mine.py")
scene = {"type": "scene", "a": {"type": "mrt_light"}, "b": {"type": "sphere", "bsdf": {"type": "mine"}}}
text = "<scene version='3.0.0'><bsdf type='mine'/><emitter type='mrt_light'/></scene>"
with open("a.xml", "w") as file:
    file.write(text)
for load, what in ((mi.load_dict, scene), (mi.load_string, text), (mi.load_file, "a.xml")):
    try:
        load(what)
    except BaseException as error:
        print(type(error).__name__, signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


def test_ctrl_c_while_mitsuba_loads_our_plugins_is_a_keyboard_interrupt(run_python):
    """Mitsuba made a RuntimeError of one that came in a constructor in Python."""
    assert run_python(LOADING).stdout.splitlines() == ["KeyboardInterrupt True"] * 3


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
def test_mi_render_leaves_no_handler(variant):
    """Mitsuba's, left behind, called itself for ever at the next Ctrl-C, or an integrator that was gone."""
    handler = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_int)(("PyOS_getsig", ctypes.pythonapi))
    before = handler(signal.SIGINT)
    nodes = scene_dict(0, width=8, height=6)
    nodes["integrator"] = {"type": "mrt_whitted", "max_depth": 1}
    params = mi.traverse(scene := mi.load_dict(nodes))
    assert np.array(mi.render(scene, params, spp=1)).any()
    assert handler(signal.SIGINT) == before
    if variant != "scalar_rgb":
        key = next(key for key, _ in params if "reflectance" in key)
        dr.enable_grad(params[key])
        dr.backward(dr.mean(mi.render(scene, params, spp=1)))
        assert np.isfinite(dr.grad(params[key])).all()
        assert handler(signal.SIGINT) == before


@pytest.mark.parametrize(
    ("owner", "integrator", "render"),
    [("AdjointIntegrator", "ptracer", mrt.render), ("SamplingIntegrator", "mrt_whitted", mi.render)],
)
def test_ctrl_c_is_left_to_other_threads_while_mitsuba_renders(
    owner, integrator, render, monkeypatch, variant
):
    """Its own handler allocates memory; in the middle of an allocation of this thread, it waited for ever."""
    masks = []
    owner = getattr(mi, owner)
    theirs = owner.render

    def noted(*args, **given):
        masks.append(signal.pthread_sigmask(signal.SIG_BLOCK, []))
        return theirs(*args, **given)

    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    nodes = {"type": "scene", "sensor": {"type": "perspective", "film": film}, "ball": {"type": "sphere"}}
    nodes["light"] = {"type": "point", "position": [0, 0, 5]}
    scene = mi.load_dict(nodes)
    integrator = mi.load_dict({"type": integrator})
    monkeypatch.setattr(owner, "render", noted)
    render(scene, integrator=integrator, spp=4)
    assert masks
    assert all(mask == {signal.SIGINT} for mask in masks)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before == set()
    with left_to_other_threads():  # a caller's own mask
        render(scene, integrator=integrator, spp=4)
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == {signal.SIGINT}
