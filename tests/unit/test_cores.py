"""How many cores the program counts on: never more than affinity and control groups grant."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mrt_mitsuba import runtime
from mrt_mitsuba.cores import affinity, usable_cores

ALL = len(affinity())


@pytest.mark.parametrize(
    ("membership", "files", "cores"),
    [
        ("0::/", {}, ALL),
        ("0::/", {"cpu.max": "max 100000"}, ALL),
        ("0::/", {"cpu.max": "100000 100000"}, 1),
        ("0::/", {"cpu.max": "50000 100000"}, 1),
        ("0::/", {"cpu.max": "150000 100000"}, min(2, ALL)),
        ("0::/", {"cpu.max": "99900000 100000"}, ALL),
        # the group above this one grants less
        ("0::/a/b", {"a/b/cpu.max": "400000 100000", "a/cpu.max": "100000 100000"}, 1),
        # version 1 of the interface; and a path of the host's, which a container does not see
        ("4:cpu,cpuacct:/x\n5:memory:/", {"cpu,cpuacct/x/cpu.cfs_quota_us": "100000"}, 1),
        ("4:cpu,cpuacct:/docker/f00", {"cpu,cpuacct/cpu.cfs_quota_us": "100000"}, 1),
        ("4:cpu,cpuacct:/x", {"cpu,cpuacct/x/cpu.cfs_quota_us": "-1"}, ALL),
        ("5:memory:/x", {"memory/x/cpu.max": "100000 100000"}, ALL),
        ("0::/", {"cpu.max": "nonsense"}, ALL),
    ],
)
def test_quotas_of_control_groups(tmp_path: Path, membership: str, files: dict[str, str], cores: int) -> None:
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text(membership)
    for name, text in files.items():
        file = tmp_path / "sys/fs/cgroup" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        if name.endswith("quota_us"):
            file.with_name("cpu.cfs_period_us").write_text("100000")
    assert usable_cores(tmp_path) == cores


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity") or ALL < 2, reason="needs two cores and affinity")
def test_affinity() -> None:
    os.sched_setaffinity(0, affinity()[:1])
    try:
        assert usable_cores() == 1
    finally:
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def test_drjit_has_no_more_threads_than_cores(monkeypatch: pytest.MonkeyPatch, variant: str) -> None:
    import drjit as dr

    before = dr.thread_count()
    monkeypatch.setattr(runtime, "usable_cores", lambda: 1)
    try:
        runtime.use("scalar_rgb")
        assert runtime.use(variant) and dr.thread_count() == 1
    finally:
        dr.set_thread_count(before)
