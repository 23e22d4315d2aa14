"""Signals meet everything as it was, once the block that guards against them is left."""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import interrupts, scene_dict
from mrt_mitsuba.interrupts import Terminated, ending_soon
from mrt_mitsuba.plugins.signals import left_to_other_threads


@pytest.fixture(autouse=True)
def heeded() -> Iterator[None]:
    """A shell that runs the tests in the background has Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_handlers_and_threads_are_as_before():
    handlers = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    threads = set(threading.enumerate())
    with ending_soon(lambda: None):
        added = set(threading.enumerate()) - threads
    assert len(added) == 1
    assert set(threading.enumerate()) == threads
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == handlers
    assert signal.set_wakeup_fd(-1) == -1


def test_orderly_end_is_left_alone():
    """A program that ends by itself in time is not ended by force: this very process goes on."""
    called = []
    with pytest.raises(Terminated), ending_soon(lambda: called.append("by force")):
        signal.raise_signal(signal.SIGTERM)
    assert called == []


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)]
)
def test_error_that_a_library_makes_of_it_is_undone(number, kind):
    """Dr.Jit raises ``RuntimeError`` where it is interrupted while it records a loop."""
    with pytest.raises(KeyboardInterrupt) as found, ending_soon(lambda: None):
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt as error:
            raise RuntimeError("encountered an exception") from error
    assert found.type is kind


def test_a_held_interrupt_comes_at_the_end_of_the_block():
    """Raised while Mitsuba is imported, it ended the process in nanobind's code."""
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts.held():
        signal.raise_signal(signal.SIGINT)
        done.append("all of the block")
    assert done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupts.held():
        signal.raise_signal(signal.SIGINT)  # ignored before, and still


def test_a_held_interrupt_is_heeded_at_safe_places_and_a_second_one_anywhere(monkeypatch):
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts.held():
        with interrupts.held():
            signal.raise_signal(signal.SIGINT)
        done.append("the end of an inner block is no safe place")
        interrupts.heed()
        done.append("never")
    assert len(done) == 1
    monkeypatch.setattr(interrupts, "PATIENCE", -1.0)
    with pytest.raises(KeyboardInterrupt), interrupts.held():
        signal.raise_signal(signal.SIGINT)
        done.append("waits")
        signal.raise_signal(signal.SIGINT)
        done.append("never")
    assert done[1:] == ["waits"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    interrupts.heed()  # nothing is left


def test_a_signal_that_comes_twice_while_held_is_acted_on_once():
    """A terminal sends it to a group of processes, whose leader may send it once more."""
    seen = []
    signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    with interrupts.held():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert seen == []
    assert seen == [signal.SIGINT]


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


DEAF = """
import os, signal, time
from mrt_mitsuba.interrupts import ending_soon
with ending_soon(lambda: print("tidied")):
    signals = [signal.SIGTERM]
    while True:
        try:
            os.kill(os.getpid(), signals.pop())
        except BaseException:
            time.sleep(0.01)
"""


def test_a_program_that_does_not_end_by_itself_is_ended(run_python):
    """With the code by which a shell knows the signal."""
    assert run_python(DEAF, code=128 + signal.SIGTERM).stdout == "tidied\n"


@pytest.mark.parametrize("blocked", [set(), {signal.SIGINT}])
def test_a_mask_of_signals_is_restored(blocked):
    before = signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    try:
        with left_to_other_threads():
            assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == {signal.SIGINT}
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == blocked
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
