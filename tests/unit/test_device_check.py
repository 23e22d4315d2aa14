"""The check of a device, tried in LLVM against the scalar variant."""

from __future__ import annotations

import time

import pytest

from mrt_mitsuba import runtime
from mrt_mitsuba.validation import device

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
needs_llvm = pytest.mark.skipif(runtime.obstacle("llvm_ad_rgb") is not None, reason="no LLVM to run kernels")


@needs_llvm
def test_pictures_that_agree_hold_and_others_are_followed_to_a_ray(monkeypatch, capsys):
    """One variant is given a larger ball: its hits are nearer, from the same camera rays."""
    size = {"width": 12, "height": 9}
    monkeypatch.setattr(device, "SMALL", size)
    monkeypatch.setattr(device, "AA", 1)
    assert list(device.compare_pictures(VARIANTS, ["0"])) == [True]
    assert "scene 0: mean difference" in capsys.readouterr().out
    whole = device.scene_dict

    def changed(name, size):
        nodes = whole(name, size)
        if device.mi.variant().startswith("scalar"):
            sphere = next(n for n in nodes.values() if isinstance(n, dict) and n["type"] == "sphere")
            sphere["radius"] = 1.1 * sphere.get("radius", 1.0)
        return nodes

    monkeypatch.setattr(device, "scene_dict", changed)
    same, ball = (device.first_difference("0", pixel, VARIANTS, size) for pixel in ((2, 2), (5, 5)))
    assert same.startswith("no value of a single ray differs")
    assert ball.startswith("sample 0, bounce 0, ray") and ": hit distance [" in ball


def test_a_crash_gets_the_name_of_its_test(tmp_path, capsys):
    """A test whose process ends by a signal is named, and those after it run."""
    file = tmp_path / "test_dies.py"
    file.write_text(
        "import os, signal, pytest\n"
        "pytestmark = pytest.mark.device\n"
        "def test_dies(): os.kill(os.getpid(), signal.SIGSEGV)\n"
        "def test_lives(): pass\n"
    )
    assert list(device.run_tests("llvm", [str(file)], time.monotonic() + 200)) == [False]
    said = capsys.readouterr().out
    assert "1 failed, 1 passed" in said
    assert "test_dies.py::test_dies" in said
