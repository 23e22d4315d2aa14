"""The study of many renders: it passes, and it sees another picture and a process that grows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba.output.files import write_exr
from mrt_mitsuba.validation.studies import workers
from mrt_mitsuba.validation.tools.study import findings


def test_quick_study_holds(variant):
    study = findings(workers.run, quick=True)
    assert study.passed and not study.goals


@pytest.mark.parametrize("what", ["nothing", "a pixel", "a layer", "a missing layer"])
def test_another_picture_is_noticed(tmp_path: Path, what: str):
    image, depth = np.zeros((3, 4, 3), np.float32), np.full((3, 4), np.inf, np.float32)
    write_exr(tmp_path / "a.exr", image, {"depth": depth})
    if what == "a pixel":
        image[2, 3, 0] = 1e-7
    if what == "a layer":
        depth[0, 0] = 1
    write_exr(tmp_path / "b.exr", image, {} if what == "a missing layer" else {"depth": depth})
    assert workers.same(tmp_path / "a.exr", tmp_path / "b.exr") == (what == "nothing")


def test_growth_is_that_of_the_worst_process_once_warm():
    watch = workers.Watch(memory={1: [(1, 50), (20, 100), (40, 130), (60, 120)], 2: [(20, 100), (60, 105)]})
    assert watch.growth(20) == pytest.approx(1.3)
    assert watch.growth(50) == 1.0
