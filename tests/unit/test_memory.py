"""What a machine grants: memory and cores, by affinity and control groups."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from cases import Cases

from mrt_mitsuba import machine, runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.machine import Budget, Workspace, usable_cores

GIB = 2**30


@pytest.mark.parametrize(
    ("more", "needed"),
    [
        # 2^28 pixels of three floats, four bytes to write them, 24 rows under a filter, kernels: 4.1 GiB
        ({}, "4.1 GiB"),
        # twice the floats
        ({"pictures": 2}, "7.1 GiB"),
        # 2^26 rays of three floats each, three times
        ({"rays_per_pixel": 2**26}, "6.3 GiB"),
    ],
)
def test_a_picture_that_does_not_fit_is_refused_with_both_sizes(more, needed):
    with pytest.raises(UsageError, match=f"16384x16384 pixels needs {needed} of memory, and 4.0 GiB may be"):
        Workspace.from_budget(16384, 16384, 3, budget=Budget(4 * GIB), **more)


def test_more_than_the_machine_has_is_never_used(monkeypatch):
    monkeypatch.setattr(machine, "memory", lambda: (8 * GIB, 8 * GIB))
    with pytest.raises(UsageError, match=r"and 8\.0 GiB may be used"):
        Workspace.from_budget(65536, 65536, 3, budget=Budget.of(10**6 * GIB))


def show(root: Path, groups: str, files: dict[str, str]) -> None:
    """Write control groups, and their limits, as the system shows them."""
    for name, text in ({"proc/self/cgroup": groups} | files).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


@pytest.mark.parametrize("limited", ["", "a", "a/b"])
def test_limits_of_control_groups_count(tmp_path, limited):
    """In the group itself, in one above, or in a container's only one."""
    files = {}
    for group in ("", "a", "a/b"):
        files[f"sys/fs/cgroup/{group}/memory.max"] = f"{GIB if group == limited else 'max'}\n"
        files[f"sys/fs/cgroup/{group}/memory.current"] = f"{GIB // 2}\n"
    show(tmp_path, "9:pids:/x\n0::/a/b\n", files)
    assert machine.memory(tmp_path) == (GIB // 2, GIB)


ALL = len(os.sched_getaffinity(0))


quotas = Cases()
quotas("0::/", {}, ALL)
quotas("0::/", {"cpu.max": "max 100000"}, ALL)
quotas("0::/", {"cpu.max": "50000 100000"}, 1)
quotas("0::/", {"cpu.max": "150000 100000"}, min(2, ALL))
# the group above this one grants less
quotas("0::/a/b", {"a/b/cpu.max": "400000 100000", "a/cpu.max": "100000 100000"}, 1)
quotas("0::/", {"cpu.max": "nonsense"}, ALL)


@pytest.mark.parametrize(("membership", "files", "cores"), quotas)
def test_quotas_of_control_groups(tmp_path, membership, files, cores):
    show(tmp_path, membership, {f"sys/fs/cgroup/{name}": text for name, text in files.items()})
    assert usable_cores(tmp_path) == cores


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
    assert Budget.of(None).size == 2**32
    assert Budget.of(2**34).size == 2**34
    assert Budget.of(2**36).size == 2**35
