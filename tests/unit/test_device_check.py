"""The check of a device, tried in LLVM against the scalar variant."""

from __future__ import annotations

import time

import pytest

from mrt_mitsuba import runtime
from mrt_mitsuba.validation import device

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
pytestmark = pytest.mark.filterwarnings("ignore:scalar_:mrt_mitsuba.MrtWarning")
needs_llvm = pytest.mark.skipif(runtime.obstacle("llvm_ad_rgb") is not None, reason="no LLVM to run kernels")


@needs_llvm
def test_pictures_that_agree_hold_and_others_name_a_layer(monkeypatch, capsys):
    """One variant is given another scene: its objects are at other distances."""
    monkeypatch.setattr(device, "SMALL", {"width": 12, "height": 9})
    assert list(device.compare_pictures(VARIANTS, ["0"], time.monotonic() + 200)) == [True]
    assert "scene 0: mean difference" in capsys.readouterr().out
    picture = device.picture
    monkeypatch.setattr(device, "picture", lambda name, variant, size: picture(name[variant], variant, size))
    names = {"llvm_ad_rgb": "0", "scalar_rgb": "1"}
    assert list(device.compare_pictures(VARIANTS, [names], time.monotonic() + 200)) == [False]
    shown = capsys.readouterr().out
    assert "DIFFERS" in shown and "worst pixel: row " in shown and "; depth.Z is " in shown


def test_a_crash_gets_the_name_of_its_test(tmp_path, capsys):
    file = tmp_path / "test_dies.py"
    file.write_text(
        "import os, signal, pytest\n"
        "pytestmark = pytest.mark.device\n"
        "def test_lives(): pass\n"
        "def test_dies(): os.kill(os.getpid(), signal.SIGSEGV)\n"
    )
    assert list(device.run_tests("llvm", [str(file)], time.monotonic() + 200)) == [False]
    assert "test_dies.py: CRASHED with SIGSEGV in test_dies" in capsys.readouterr().out
