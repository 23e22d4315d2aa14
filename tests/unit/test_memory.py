"""What a machine grants: memory and cores, by affinity and control groups."""

from __future__ import annotations

import os
from pathlib import Path

import psutil
import pytest
from cases import Cases

from mrt_mitsuba import machine, runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.machine import budget, usable_cores, workspace

GIB = 2**30


@pytest.mark.parametrize(
    ("more", "needed"),
    [
        # 2^28 pixels of three floats, seven bytes to write them, 24 rows under a filter, kernels: 4.9 GiB
        ({}, "4.9 GiB"),
        # twice the floats
        ({"pictures": 2}, "7.9 GiB"),
        # 2^26 rays of three floats each, three times
        ({"rays_per_pixel": 2**26}, "7.0 GiB"),
    ],
)
def test_a_picture_that_does_not_fit_is_refused_with_both_sizes(more, needed):
    with pytest.raises(UsageError, match=f"16384x16384 pixels needs {needed} of memory, and 4.0 GiB may be"):
        workspace(4 * GIB, 16384, 16384, 3, **more)


def show(group: Path, files: dict[str, str]) -> Path:
    """Write the limits of a control group, as a container shows its own."""
    for name, text in files.items():
        (group / name).write_text(text)
    return group


@pytest.mark.parametrize(("limit", "found"), [(str(GIB), (GIB // 2, GIB)), ("max", None)])
def test_the_limit_of_a_control_group_counts(tmp_path, monkeypatch, limit, found):
    files = {"memory.max": f"{limit}\n", "memory.current": f"{GIB // 2}\n"}
    monkeypatch.setattr(machine, "GROUP", show(tmp_path, files))
    free, total = machine.memory()
    assert found == (free, total) or (found is None and total == psutil.virtual_memory().total)


ALL = len(os.sched_getaffinity(0))


quotas = Cases()
quotas({}, ALL)
quotas({"cpu.max": "max 100000"}, ALL)
quotas({"cpu.max": "50000 100000"}, 1)
quotas({"cpu.max": "150000 100000"}, min(2, ALL))
quotas({"cpu.max": "nonsense"}, ALL)


@pytest.mark.parametrize(("files", "cores"), quotas)
def test_quotas_of_control_groups(tmp_path, monkeypatch, files, cores):
    monkeypatch.setattr(machine, "GROUP", show(tmp_path, files))
    assert usable_cores() == cores


@pytest.mark.skipif(ALL < 2, reason="needs two cores")
def test_affinity():
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        assert usable_cores() == 1
    finally:
        os.sched_setaffinity(0, before)


def test_drjit_has_as_many_threads_as_cores_but_two(monkeypatch, variant):
    import drjit as dr

    before = dr.thread_count()
    monkeypatch.setattr(runtime, "usable_cores", lambda: 1)
    try:
        runtime.use("scalar_rgb")
        assert runtime.use(variant)
        assert dr.thread_count() == min(before, 2)
    finally:
        monkeypatch.undo()  # before the variant is set back
        dr.set_thread_count(before)


def test_half_of_what_is_free_is_used_unless_asked_for(monkeypatch):
    monkeypatch.setattr(machine, "memory", lambda: (2**33, 2**35))
    assert budget(None) == 2**32
    assert budget(2**34) == 2**34
    assert budget(2**36) == 2**35
