"""Sweeps: the same pictures as one render at a time, whatever happens to workers, scheduler and terminal."""

from __future__ import annotations

import contextlib
import csv
import itertools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from multiprocessing.pool import ThreadPool
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil
import pytest
from cases import Cases
from clusters import PATIENCE, Cluster, wait_for

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.errors import MrtError, OutputError, UsageError
from mrt_mitsuba.files.images import read_exr
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.sweeps import worker
from mrt_mitsuba.sweeps.jobs import encode

distributed = pytest.importorskip("distributed")
Client = distributed.Client
pytestmark = pytest.mark.attack

SMALL = {"width": 64, "height": 48, "aa": 1}
ROUNDS = int(os.environ.get("MRT_ATTACK_ROUNDS", "1"))
NOWHERE = "tcp://127.0.0.1:9"  # no scheduler is there


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a cluster for tests that leave it whole."""
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield cluster.address
    cluster.stop()


@pytest.fixture
def mortal(tmp_path: Path) -> Iterator[Callable[..., Cluster]]:
    """Starts clusters for tests that break them."""
    started: list[Cluster] = []

    def start(*words: str, count: int = 2) -> Cluster:
        folder = tmp_path / f"cluster{len(started)}"
        folder.mkdir()
        started.append(Cluster(folder, *words, count=count))
        return started[-1]

    yield start
    for cluster in started:
        cluster.stop()


def made(folder: Path) -> dict[str, int]:
    """Pictures, and when each was written."""
    found = (path for path in folder.glob("*.*") if path.suffix in (".exr", ".png"))
    return {path.name: path.stat().st_mtime_ns for path in found}


def left_over(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def written(folder: Path) -> list[dict[str, str]]:
    with open(folder / "table.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_pictures_are_those_of_render_alone(address, tmp_path):
    """All combinations of options, seeds and scenes: a number, a dict with Mitsuba's types, a file; of two
    workers each takes half of the machine's cores."""
    mrt.register()
    nodes = mrt.scene_dict(3)  # seen by three cameras, so that kernels are the same and pictures are not
    nodes["sensor"]["fov"] = 50.0
    file = tmp_path / "mine.xml"
    scenes = [3, nodes, str(file)]
    assert cli.main(["export", "3", "--xml", scenes[2]]) == 0
    file.write_text(file.read_text().replace('"fov" value="60"', '"fov" value="40"'))
    small = {"width": 64, "height": 48, "layers": ["depth"]}
    grid = {"scene": scenes, "aa": [1, 2], "seed": np.arange(2)}
    with Client(address, set_as_default=False) as client:
        table = mrt.sweep(None, tmp_path / "out", grid=grid, cluster=client, **small)
        threads = client.run(lambda: dr.thread_count())
    half = max(2, usable_cores() // 2)
    assert {threads[row["worker"]] for row in table.rows} == {half}
    assert len(table.rows) == 12
    assert len({read_exr(tmp_path / "out" / row["file"]).image.tobytes() for row in table.rows}) >= 6
    assert not table.failed
    for row in table.rows:
        alone = mrt.render(row["scene"], aa=row["aa"], seed=row["seed"], **small)
        found = read_exr(tmp_path / "out" / row["file"])
        assert found.image.tobytes() == alone.image.tobytes()
        assert found.layers.keys() == alone.layers.keys()
        assert row["attempts"] == 1
        assert row["seconds"] > 0
        assert row["rays"] == sum(alone.rays.values())
    files = [row["file"] for row in table.rows]
    assert files[:2] == ["scene=3,aa=1,seed=0.exr", "scene=3,aa=1,seed=1.exr"]
    assert [row["file"] for row in written(tmp_path / "out")] == files


@pytest.mark.parametrize("variant", ["scalar_rgb"], indirect=True)
def test_workers_use_the_callers_variant(variant, address, tmp_path):
    mrt.sweep(3, tmp_path, cluster=address, width=8, height=6)
    assert read_exr(tmp_path / "picture.exr").header["mrt:variant"] == variant


def test_parameters_of_a_file(address, tmp_path):
    """Those of ``mi.traverse`` and those that it declares."""
    mine = tmp_path / "mine.xml"
    out = tmp_path / "out"
    assert cli.main(["export", "3", "--xml", str(mine)]) == 0
    grid = {"params": [{"resx": 40}, {"resx": 50}], "material_0.alpha": [0.1]}
    table = mrt.sweep(mine, out, grid=grid, cluster=address, aa=1)
    names = [f"params=resx-{n},material_0.alpha=0.1" for n in (40, 50)]
    assert [row["file"] for row in table.rows] == [f"{name}.exr" for name in names]
    for row in table.rows:
        alone = mrt.render(mine, params=row["params"] | {"material_0.alpha": 0.1}, aa=1)
        assert read_exr(out / row["file"]).image.tobytes() == alone.image.tobytes()


def test_a_second_run_renders_only_what_is_missing_or_was_made_otherwise(address, tmp_path):
    def run(**options: Any) -> dict[str, int]:
        table = mrt.sweep(3, tmp_path, grid={"seed": [1, 2]}, cluster=address, **SMALL | options)
        assert len(table.rows) == 2
        assert not table.failed
        assert all(row["seconds"] > 0 and row["attempts"] == 1 for row in table.rows)
        return made(tmp_path)

    first = run()
    assert run(memory="1G") == first  # memory does not decide about pixels
    (tmp_path / "seed=1.exr").unlink()
    second = run()
    made_again = {name for name in first if first[name] != second[name]}
    assert made_again == {"seed=1.exr"}
    others: dict[str, Any] = {}
    for name, value in (("fresnel", "dielectric"), ("aa", 2), ("resume", False)):
        others[name] = value
        before = made(tmp_path)
        assert not set(before.values()) & set(run(**others).values())


def test_pictures_of_another_version_are_made_again(address, tmp_path, monkeypatch):
    """The sweep comes so far as to look for workers."""
    mrt.sweep(3, tmp_path, cluster=address, **SMALL)
    monkeypatch.setattr("mrt_mitsuba.sweeps.cluster.CONNECTING", 0.2)
    assert not mrt.sweep(3, tmp_path, cluster=NOWHERE, **SMALL).failed
    monkeypatch.setattr(mrt, "__version__", "0.0.1")
    runtime.versions.cache_clear()
    try:
        with pytest.raises(MrtError, match="no scheduler with workers answers"):
            mrt.sweep(3, tmp_path, cluster=NOWHERE, **SMALL)
    finally:
        runtime.versions.cache_clear()


@pytest.mark.parametrize("name", ["table.csv", "seed=1.exr", "link"])
def test_a_file_of_the_users_own_is_refused_by_name(address, tmp_path, name):
    options: dict[str, Any] = {"grid": {"seed": [1]}, **SMALL}
    mine = tmp_path / name
    mine.write_text("file,error\nmine,\n")
    if name.startswith("seed"):
        mrt.render(0, width=8, height=8, aa=1).save(mine)
    if name == "link":
        (tmp_path / "seed=1.exr").symlink_to(mine)
    before = mine.read_bytes()
    with pytest.raises(OutputError, match=r"(not made by|not the table of) a sweep.*another folder"):
        mrt.sweep(3, tmp_path, resume=False, **options)
    assert mine.read_bytes() == before


def test_a_picture_that_the_scene_reads_is_not_replaced(address, tmp_path):
    mrt.sweep(3, tmp_path, cluster=address, focaldist=0, **SMALL)
    before = made(tmp_path)
    nodes = mrt.scene_dict(3)
    texture = {"type": "bitmap", "filename": str(tmp_path / "picture.exr")}
    nodes["painted"] = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}
    (row,) = mrt.sweep(nodes, tmp_path, cluster=address, **SMALL).failed
    assert "is made from this file" in row["error"]
    assert made(tmp_path) == before


# What each worker runs first: it changes a scene file that it has rendered
CHANGES = """
from mrt_mitsuba.rendering import api
def render(scene, alone=api.render, **options):
    result = alone(scene, **options)
    with open(scene, "a") as file:
        file.write("<!-- changed -->")
    return result
api.render = render
"""


def test_a_scene_file_counts_by_its_contents(address, mortal, tmp_path):
    """Two versions in one folder after each other, two at a time, and a change while it is rendered."""
    scene = tmp_path / "mine.xml"
    out = tmp_path / "out"
    assert cli.main(["export", "0", "--xml", str(scene)]) == 0
    options: dict[str, Any] = {"cluster": address, **SMALL}
    mrt.sweep(scene, out, **options)
    scene.write_text(scene.read_text().replace('value="60"', 'value="50"'))
    mrt.sweep(scene, out, **options)
    assert read_exr(out / "picture.exr").image.tobytes() == mrt.render(scene, **SMALL).image.tobytes()
    namesake = tmp_path / "other" / "mine.xml"
    with pytest.raises(UsageError, match="2 jobs would write the same file scene=mine"):
        mrt.sweep(None, out, grid={"scene": [str(scene), str(namesake)]}, **options)
    changing = mortal(CHANGES, count=1)
    (row,) = mrt.sweep(scene, tmp_path / "late", cluster=changing.address, **SMALL).failed
    assert "mine.xml has changed since the sweep began" in row["error"]


wrong = Cases()


def wrong_grid(says: str, grid: Any, **options: Any) -> None:
    """Add a grid that must be refused, and what the error says, as a regular expression."""
    wrong(grid, options, says, name=says)


def wrong_options(says: str, **options: Any) -> None:
    wrong_grid(says, {}, **options)


wrong_grid("'aaa' is not an option of render: did you mean aa", {"aaa": [1]})
wrong_grid("aa is an empty list", {"aa": []})
wrong_grid(r'grid=\[1\]: give a dict of lists, such as {"aa": \[1, 2\]}', [1])
wrong_grid("more than 100000 jobs", {"seed": itertools.count()})
wrong_grid(r"aa is 3; give a list of values, such as \[3\]", {"aa": 3})
wrong_grid("2 jobs would write the same file aa=1", {"aa": [1, 2, 1]})
wrong_grid("aa is given twice", {"aa": [1]}, aa=2)
mistyped = "no parameter material_0.alpa: did you mean material_0.alpha?"
wrong_grid(mistyped, {"material_0.alpa": [0.1]})
wrong_grid("zipped axes must be of one length", {"aa": [1, 2], "seed": [1]}, zipped=True)

wrong_options("cannot make the folder", out=__file__ + "/out")
wrong_options("give the scene as a number, a dict or a path", scene={"type": threading.Lock()})
wrong_options("plugins=none.py: no such Python file", plugins="none.py")
wrong_options("workers=0: must be a whole number", workers=0)
wrong_options("give one of them", workers=2, cluster=NOWHERE)
wrong_options("no scheduler with workers answers at nonsense://x", cluster="nonsense://x")


def test_workers_that_share_cores_divide_them(tmp_path, monkeypatch):
    """Sixteen of them among four."""
    here = worker.describe(str(tmp_path))
    known = SimpleNamespace(address="here", memory_manager=SimpleNamespace(memory_limit=0))
    monkeypatch.setattr("distributed.get_worker", lambda: known)
    monkeypatch.setattr(worker, "usable_cores", lambda: 16)
    monkeypatch.setattr(worker, "_render", lambda *_: {})
    threads: list[int] = []
    monkeypatch.setattr(dr, "set_thread_count", threads.append)
    worker.render_job(encode(None), "", here["versions"], {here["cores"]: 4}, (), None)
    assert threads == [4]


@pytest.mark.parametrize(("grid", "options", "message"), wrong)
def test_a_broken_grid_is_refused_before_anything_is_rendered(tmp_path, monkeypatch, grid, options, message):
    monkeypatch.setattr("mrt_mitsuba.sweeps.cluster.CONNECTING", 0.5)
    with pytest.raises(MrtError, match=message):
        mrt.sweep(**{"scene": 3, "out": tmp_path / "out", "grid": grid} | options)
    assert not list(tmp_path.rglob("*.*"))


# What each worker runs first: seed 1 fails, 2 costs the first worker that takes it, 3 every worker, and 4
# takes more memory than there is
SPOILED = """
import os, pathlib, time
from mrt_mitsuba.rendering import api
def render(*scene, seed=0, alone=api.render, **options):
    if seed == 1:
        raise RuntimeError("out of luck")
    first = pathlib.Path("died")
    if seed == 3 or seed == 2 and not first.exists():
        first.touch() if seed == 2 else None
        os._exit(1)
    if seed == 4:
        kept = [b"x" * 10**8 for _ in range(13)]
        time.sleep(60)
    return alone(*scene, seed=seed, **options)
api.render = render
"""


def test_jobs_that_fail_or_cost_their_worker_spoil_no_other(mortal, tmp_path):
    out = tmp_path / "out"
    cluster = mortal(SPOILED, "--memory-limit", "1200MB")
    table = mrt.sweep(3, out, grid={"seed": range(8)}, cluster=cluster.address, **SMALL)
    errors = {row["seed"]: row["error"] for row in table.failed}
    assert errors.keys() == {1, 3, 4}
    assert errors[1] == "RuntimeError: out of luck"
    assert errors[3] == errors[4]
    assert "every worker that rendered it died, perhaps for lack of" in errors[3]
    attempts = [row["attempts"] for row in table.rows]
    assert attempts[1] == attempts[3] == attempts[4] == 3
    assert attempts[2] > 1
    assert len(made(out)) == 5
    assert not left_over(out)
    assert str(table).startswith("5 of 8 pictures")
    assert all(row["file"] == "" for row in table.failed)
    with pytest.raises(UsageError, match="5 of 8 pictures are there: run the sweep again"):
        table.mean()


@pytest.mark.parametrize(
    ("preload", "message"),
    [
        ("import mrt_mitsuba; mrt_mitsuba.__version__ = '0.0.1'", "mrt-mitsuba 0.0.1,"),
        ("import sys; sys.modules['mrt_mitsuba.sweeps.worker'] = None", "cannot run this mrt-mitsuba"),
    ],
    ids=["another version", "none"],
)
def test_workers_with_other_software_are_refused(mortal, tmp_path, preload, message):
    with pytest.raises(MrtError, match=f"(?s){message}.*install") as caught:
        mrt.sweep(3, tmp_path / "out", cluster=mortal(preload, count=1).address, **SMALL)
    assert "\n" not in str(caught.value)
    assert not made(tmp_path / "out")


# What each worker runs first: seed 1 costs the first worker that takes it, and from 2 on jobs wait
WAITING = """
import os, pathlib, time
from mrt_mitsuba.rendering import api
def render(*scene, seed=0, alone=api.render, **options):
    if seed == 1 and not pathlib.Path("died").exists():
        pathlib.Path("died").touch()
        os._exit(1)
    while seed > 1 and not pathlib.Path("go").exists():
        time.sleep(0.05)
    return alone(*scene, seed=seed, **options)
api.render = render
"""


@pytest.fixture
def waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the workers of this machine run ``WAITING`` first, in a folder of their own."""
    (tmp_path / "waiting.py").write_text(WAITING)
    monkeypatch.setenv("DASK_DISTRIBUTED__WORKER__PRELOAD", repr([str(tmp_path / "waiting.py")]))
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_the_only_worker_of_this_machine_is_replaced_when_it_dies(waiting, tmp_path):
    def children() -> list[psutil.Process]:
        return psutil.Process().children(recursive=True)

    before = children()
    (tmp_path / "go").touch()
    table = mrt.sweep(3, tmp_path / "out", workers=1, grid={"seed": range(3)}, **SMALL)
    assert [row["error"] for row in table.rows] == [""] * 3
    assert table.rows[1]["attempts"] == 2
    assert set(children()) <= set(before)


@pytest.mark.slow
@pytest.mark.parametrize("back", [True, False][:ROUNDS])
def test_a_scheduler_killed_ends_the_sweep_and_a_second_run_finishes_it(mortal, tmp_path, back):
    """Also where one comes back at once under its address, without its workers."""
    cluster = mortal(WAITING)
    out = tmp_path / "out"
    (cluster.folder / "died").touch()
    options: dict[str, Any] = {"grid": {"seed": range(6)}, **SMALL}
    with ThreadPool(1) as pool:
        sweep = pool.apply_async(mrt.sweep, (3, out), {"cluster": cluster.address, **options})
        wait_for(lambda: len(made(out)) == 2, "two pictures")
        cluster.scheduler.kill()
        cluster.scheduler.wait()
        if back:
            cluster.start_scheduler(cluster.address.rpartition(":")[2])
        with pytest.raises(MrtError, match="the scheduler is gone"):
            sweep.get(PATIENCE)
    first = made(out)
    assert len(first) == 2
    # of a picture whose worker could no longer say so, there is no checksum: it is made anew
    known = {row["file"] for row in written(out)}
    assert known <= first.keys()
    (cluster.folder / "go").touch()
    if back:
        cluster.start_workers()
    running = cluster if back else mortal()
    table = mrt.sweep(3, out, cluster=running.address, **options)
    assert len(table.rows) == 6
    assert not table.failed
    assert not left_over(out)
    assert {name: first[name] for name in known}.items() <= made(out).items()


SWEEP = "scene = 3\nwidth = 64\nheight = 48\naa = 1\n[grid]\nseed = [0, 1, 2, 3, 4, 5]\n"


def test_the_command_interrupted_from_the_keyboard_and_again(start, waiting, tmp_path, capsys):
    """The whole group of processes gets the signal, as from a terminal."""
    (tmp_path / "sweep.toml").write_text(SWEEP)
    (tmp_path / "died").touch()
    words = ["sweep", "out", "sweep.toml"]
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mrt_mitsuba.command.main", *words, "workers=2"]
    with start(*command, start_new_session=True) as process:
        wait_for(lambda: (out / "table.csv").exists(), "a row of the table")
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE)  # also the workers have ended
    assert process.returncode == 130
    assert errors == "mrt: interrupted\n"
    done = made(out)
    assert 0 < len(done) < 6
    assert {row["file"] for row in written(out)} <= done.keys()
    assert not left_over(out)
    for name in done:
        assert read_exr(out / name).image.shape == (48, 64, 3)
    (tmp_path / "go").touch()
    assert cli.main([*words, "workers=1"]) == 0
    assert capsys.readouterr().out.endswith(f"6 of 6 pictures in {out}\n")
    assert [row["error"] for row in written(out)] == [""] * 6


def test_the_command_says_that_a_job_failed(address, tmp_path, capsys):
    lines = ["scene = 3", "width = 4096", "height = 4096", "aa = 1", 'memory = "64M"']
    lines += ['cluster = "tcp://127.0.0.1:1"']  # which is given in the command as well
    (tmp_path / "sweep.toml").write_text("\n".join(lines))
    assert cli.main(["sweep", str(tmp_path / "out"), str(tmp_path / "sweep.toml"), f"cluster={address}"]) == 1
    assert "failed: " in capsys.readouterr().out


PLUGIN = """
import mitsuba as mi
class Grey(mi.BSDF):
    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        self.m_components, self.m_flags = [mi.BSDFFlags.DiffuseReflection], mi.BSDFFlags.DiffuseReflection
    def sample(self, ctx, si, sample1, sample2, active=True):
        return mi.BSDFSample3f(), mi.Spectrum(0.0)
    def eval(self, ctx, si, wo, active=True):
        return mi.Spectrum(0.25)
    def pdf(self, ctx, si, wo, active=True):
        return mi.Float(0.0)
    def eval_pdf(self, ctx, si, wo, active=True):
        return mi.Spectrum(0.25), mi.Float(0.0)
mi.register_bsdf("grey", Grey)
"""


class Knocking(Progress):
    """Notes the addresses at which this process and its descendants listen while a sweep runs, and did not
    before it, as clusters of other tests do; and knocks without the sweep's key."""

    def __init__(self) -> None:
        self.before = self.listeners()
        self.addresses: set[str] = set()

    @contextlib.contextmanager
    def stage(self, *words: Any) -> Iterator[Callable[[int], None]]:
        yield self.note

    def note(self, steps: int) -> None:
        self.addresses |= {ip for ip, _ in self.listeners() - self.before}
        (cluster,) = (each for each in distributed.SpecCluster._instances if each.status.name == "running")
        address = cluster.scheduler_address.replace("tls://", "tcp://")
        with pytest.raises(OSError):
            Client(address, timeout=1, set_as_default=False)

    def listeners(self) -> set[tuple[str, int]]:
        """Addresses and ports."""
        own = psutil.Process()
        every = [each for one in [own, *own.children(recursive=True)] for each in one.net_connections("tcp")]
        return {tuple(each.laddr) for each in every if each.status == psutil.CONN_LISTEN}


def test_a_sweep_of_this_machine_is_closed_to_others(tmp_path, monkeypatch):
    """It listens on the loopback only, turns away who has not its key, and imports nothing that lies in the
    working folder but the plugin that is named; relative names in scenes still count from there."""
    for name in ("mitsuba", "numpy", "dask", "distributed", "multiprocessing", "mrt_mitsuba", "PIL"):
        (tmp_path / f"{name}.py").write_text("open('was-run', 'w').close()\nraise SystemExit(3)\n")
    (tmp_path / "mine.py").write_text(PLUGIN)
    mrt.render(0, width=8, height=8, aa=1).save(tmp_path / "texture.png")
    monkeypatch.chdir(tmp_path)
    scene = mrt.scene_dict(3)
    scene["ball"] = {"type": "sphere", "bsdf": {"type": "grey"}}
    scene["far"] = {
        "type": "sphere",
        "center": [9, 9, 9],
        "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": "texture.png"}},
    }

    listening = Knocking()
    table = mrt.sweep(scene, "out", plugins="mine.py", workers=1, progress=listening, **SMALL)
    assert not table.failed
    assert listening.addresses == {"127.0.0.1"}
    assert not (tmp_path / "was-run").exists()
    alone = mrt.render(scene, **SMALL)
    assert read_exr(tmp_path / "out" / "picture.exr").image.tobytes() == alone.image.tobytes()
    before = made(tmp_path / "out")
    (tmp_path / "mine.py").write_text(PLUGIN + "# another version\n")
    mrt.sweep(scene, "out", plugins="mine.py", workers=1, **SMALL)
    assert not set(before.values()) & set(made(tmp_path / "out").values())


def test_what_a_file_holds_is_never_unpickled(tmp_path):
    evil = tmp_path / "evil.scene"
    evil.write_bytes(b"cposix\nsystem\n(S'touch " + bytes(tmp_path / "was-run") + b"'\ntR.")
    for scene in (evil, str(evil), evil.read_bytes()):
        with contextlib.suppress(MrtError):
            mrt.sweep(scene, tmp_path / "out", workers=1, **SMALL)
    assert not (tmp_path / "was-run").exists()


def test_mean_of_seeds(address, tmp_path):
    """The picture, its stated error against a converged one, and what cannot be averaged."""
    options: dict[str, Any] = {"width": 48, "height": 32, "integrator": "path"}
    mrt.register()
    scene = mi.cornell_box()
    more = {"spp": 16, "aamode": "noise", "cluster": address}
    table = mrt.sweep(scene, tmp_path, grid={"seed": range(8)}, **more, **options)
    mean = table.mean()
    every = [read_exr(tmp_path / row["file"]) for row in table.rows]
    pictures = np.stack([each.image for each in every])
    assert np.allclose(mean.image, pictures.mean(0), rtol=1e-6)  # sums in float32
    assert np.array_equal(mean.layers["samples.Y"], sum(each.layers["samples.Y"] for each in every))
    variance = pictures.astype(np.float64).var(0, ddof=1) / 8
    assert np.allclose(mean.layers["variance.G"], variance[..., 1], rtol=1e-4, atol=1e-6)
    deviation = np.sqrt(variance.mean(-1))
    assert np.allclose(mean.layers["error.Y"], deviation, rtol=1e-4, atol=1e-6)
    converged = mrt.render(scene, spp=2048, seed=99, **options).image
    error = np.sqrt(np.square(mean.image - converged).mean())
    assert mean.error.low <= error <= mean.error.high
    assert np.isclose(mean.error.rmse, np.sqrt(np.square(deviation).mean()), rtol=1e-4)
    mean.save(tmp_path / "mean.exr")
    assert read_exr(tmp_path / "mean.exr").header["mrt:error"]
    for grid in ({"seed": [1]}, {"seed": [1, 2], "aa": [1, 2]}, {}):
        with pytest.raises(UsageError, match=r"^mean: "):
            mrt.sweep(3, tmp_path / "others", grid=grid, cluster=address, width=8, height=6).mean()


def test_values_of_mitsuba_and_of_numpy_in_a_grid(address, tmp_path):
    """Frames are numbered, for films."""
    mrt.register()
    moved = mi.ScalarTransform4f().translate([0, 0, -1])
    grid = {
        "sphere_0.to_world": [moved, mi.Transform4f(moved.matrix)],
        "light_0.position": [mi.Point3f(1, 2, 3), np.array([1, 2, 3], np.float32)],
        "material_0.alpha": [mi.Float(0.1), np.float32(0.1)],
    }
    table = mrt.sweep(3, tmp_path, grid=grid, zipped=True, cluster=address, **SMALL)
    assert [row["material_0.alpha"] for row in table.rows] == [0.1, 0.1]
    assert [row["file"] for row in table.rows] == ["frame_0000.exr", "frame_0001.exr"]
    params = {key: table.rows[0][key] for key in grid}
    alone = mrt.render(3, params=params, **SMALL).image.tobytes()
    assert {read_exr(tmp_path / row["file"]).image.tobytes() for row in table.rows} == {alone}
