"""What a machine grants: memory and cores, by affinity and control groups."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from cases import Cases

from mrt_mitsuba import machine, runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.machine import MOST_PIXELS, MOST_RAYS, Budget, Workspace, usable_cores

GIB = 2**30


def test_plenty_of_memory_gives_the_largest_parts():
    space = Workspace.next_to(800, 600, 4, budget=Budget(64 * GIB))
    assert space.rays_at_once(4) == MOST_RAYS
    assert space.rows_at_once(1024) == MOST_PIXELS // 1024


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
        Workspace.next_to(16384, 16384, 3, budget=Budget(4 * GIB), **more)


@pytest.mark.parametrize(("used", "flushed"), [(GIB // 4, False), (GIB // 4 + 1, True)])
def test_what_a_large_pass_used_is_given_back(monkeypatch, used, flushed):
    import drjit as dr

    called = []
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: called.append(True))
    Workspace(GIB).give_back(used)
    assert bool(called) is flushed


def test_more_than_the_machine_has_is_never_used(monkeypatch):
    monkeypatch.setattr(machine, "memory", lambda: (8 * GIB, 8 * GIB))
    with pytest.raises(UsageError, match=r"and 8\.0 GiB may be used"):
        Workspace.next_to(65536, 65536, 3, budget=Budget.of(10**6 * GIB))


def show(root: Path, groups: str, files: dict[str, str]) -> None:
    """Write control groups, and their limits, as the system shows them."""
    for name, text in ({"proc/self/cgroup": groups} | files).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


V1 = ("memory.limit_in_bytes", "memory.usage_in_bytes")
V2 = ("memory.max", "memory.current")


limits = Cases()
limits("0::/a/b", "", V2, "a/b")
limits("0::/a/b", "", V2, "a")
limits("4:memory:/a/b", "memory", V1, "a")
limits("7:cpu,memory:/elsewhere", "memory", V1, "")


@pytest.mark.parametrize(("group", "base", "names", "place"), limits)
def test_limits_of_control_groups_count(tmp_path, group, base, names, place):
    """Limits as the system shows them: in the group itself, in one above, or in a container's only one."""
    files = {"memory.stat": f"anon 5\ninactive_file {GIB // 4}\n", names[1]: f"{GIB // 2}\n"}
    for above in ("", "a", "a/b"):
        limit = {names[0]: f"{GIB if above == place else 'max'}\n"}
        group_files = {f"sys/fs/cgroup/{base}/{above}/{name}": text for name, text in (files | limit).items()}
        show(tmp_path, f"9:pids:/x\n{group}\n", group_files)
    assert machine.memory(tmp_path) == (GIB * 3 // 4, GIB)


def test_textures_are_taken_from_the_budget():
    budget = Budget(GIB)
    budget.take_texture("a.png", 4000, 4000)
    assert 300e6 < budget.taken < 400e6
    room = Workspace.next_to(100, 100, 3, budget=Budget(GIB)).size
    assert Workspace.next_to(100, 100, 3, budget=budget).size == room - budget.taken
    with pytest.raises(UsageError, match=r"b\.png of 6000x6000 texels, the scene needs .*memory="):
        budget.take_texture("b.png", 6000, 6000)


ALL = len(os.sched_getaffinity(0))


quotas = Cases()
quotas("0::/", {}, ALL)
quotas("0::/", {"cpu.max": "max 100000"}, ALL)
quotas("0::/", {"cpu.max": "100000 100000"}, 1)
quotas("0::/", {"cpu.max": "50000 100000"}, 1)
quotas("0::/", {"cpu.max": "150000 100000"}, min(2, ALL))
quotas("0::/", {"cpu.max": "99900000 100000"}, ALL)
# the group above this one grants less
quotas("0::/a/b", {"a/b/cpu.max": "400000 100000", "a/cpu.max": "100000 100000"}, 1)
# version 1 of the interface; and a path of the host's, which a container does not see
quotas("4:cpu,cpuacct:/x\n5:memory:/", {"cpu,cpuacct/x/cpu.cfs_quota_us": "100000"}, 1)
quotas("4:cpu,cpuacct:/docker/f00", {"cpu,cpuacct/cpu.cfs_quota_us": "100000"}, 1)
quotas("4:cpu,cpuacct:/x", {"cpu,cpuacct/x/cpu.cfs_quota_us": "-1"}, ALL)
quotas("5:memory:/x", {"memory/x/cpu.max": "100000 100000"}, ALL)
quotas("0::/", {"cpu.max": "nonsense"}, ALL)


@pytest.mark.parametrize(("membership", "files", "cores"), quotas)
def test_quotas_of_control_groups(tmp_path, membership, files, cores):
    periods = {name.replace("quota", "period"): "100000" for name in files if "quota" in name}
    show(tmp_path, membership, {f"sys/fs/cgroup/{name}": text for name, text in (periods | files).items()})
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


EXR = """
import mrt_mitsuba as mrt
mrt.register()
import drjit as dr, mitsuba as mi, numpy as np
lamp = {"type": "envmap", "filename": "a.exr"}
film = {"type": "hdrfilm", "width": 4, "height": 3}
mi.Bitmap(np.ones((4, 8, 3), np.float32)).write("a.exr")
dr.set_thread_count(1)
mi.load_dict(lamp)
camera = {"type": "perspective", "film": film}
print(mrt.render({"type": "scene", "lamp": lamp, "camera": camera}).image.mean(), dr.thread_count())
"""


def test_one_thread_is_enough_for_exr_files(run_python):
    """Mitsuba waited for another one for ever, in each worker of a sweep with as many workers as cores."""
    assert run_python(EXR).stdout.split() == ["1.0", "1"]


def test_half_of_what_is_free_is_used_unless_asked_for(monkeypatch):
    monkeypatch.setattr(machine, "memory", lambda: (2**33, 2**35))
    assert Budget.of(None).size == 2**32
    assert Budget.of(2**34).size == 2**34
    assert Budget.of(2**36).size == 2**35


@pytest.mark.parametrize(("kind", "bytes_of_texel"), [("bitmap", 24), ("envmap", 40)])
def test_pictures_of_a_scene_take_their_memory(variant, tmp_path, kind, bytes_of_texel):
    import mitsuba as mi

    from mrt_mitsuba.scene.loading import load_dict

    file = str(tmp_path / "a.exr")
    mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(file)
    budget = Budget(2**20)
    load_dict({"type": kind, "filename": file}, budget=budget)
    assert budget.taken == 8 * 16 * bytes_of_texel
