"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.errors import OutputError, UsageError
from mrt_mitsuba.output.replacing import check_target
from mrt_mitsuba.rendering.progress import Advance, Progress, TerminalProgress
from mrt_mitsuba.runtime import versions
from mrt_mitsuba.sweeps import cluster as clusters
from mrt_mitsuba.sweeps.cluster import ClusterError
from mrt_mitsuba.sweeps.grid import Job, jobs
from mrt_mitsuba.sweeps.scenes import check_parameters, fingerprint, send
from mrt_mitsuba.sweeps.sheet import MOST, write_sheet
from mrt_mitsuba.sweeps.table import FILE as TABLE
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.tiles import Mosaic, assemble_task
from mrt_mitsuba.sweeps.worker import TOPIC, House, Task, is_fresh, named, render_task, thumbnail

if TYPE_CHECKING:
    from distributed import Client, Future

RENEW = 1000  # jobs after which a worker gets a new process: ours are not known to grow, other plugins are
SHEET = "contact.png"


def sweep(
    scene: Any,
    out: str | os.PathLike[str],
    *,
    grid: Mapping[str, Any] | None = None,
    zipped: bool = False,
    workers: int | None = None,
    cluster: Any = None,
    tiles: tuple[int, int] | None = None,
    retries: int = 2,
    resume: bool = True,
    png: bool = False,
    renew: int = RENEW,
    dashboard: int | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Table:
    """Render every combination of a grid's values on several processes or machines.

    Each picture is an EXR in ``out``, named by its values; beside them are ``table.csv``, written as jobs
    end, and ``contact.png``. A job that fails leaves a row with the reason, and the others go on.

    Args:
        scene: as ``render`` takes it, but no loaded Mitsuba scene; None where it is an axis of the grid.
        out: a folder that all workers see; made if it is not there.
        grid: a list of values for each key. Keys with a dot are those of ``mi.traverse``; "scene" stands for
            scenes, any other for an argument of ``render``.
        zipped: take the first values of all axes, then the second: frames, whose files are numbered.
        workers: processes on this machine; by default one for each core, or GPU in a ``cuda`` variant.
        cluster: address of a Dask scheduler, or a ``dask.distributed.Client``; None for this machine.
        tiles: rows and columns of tiles into which each picture is cut, to be rendered by several workers;
            the picture is the same bit for bit.
        retries: how often a job may lose its worker or fail by accident.
        resume: keep the pictures that were made with the same settings and versions.
        png: write a PNG of each picture, too.
        renew: jobs after which a worker process is replaced.
        dashboard: port of Dask's pages about the workers of this machine, which need Bokeh.
        progress: receives how far it is; by default shown on a terminal and in notebooks.
        options: arguments of ``render`` that all jobs share.

    Raises:
        UsageError, SceneError, OutputError: for a sweep that cannot be, before anything is rendered.
        ClusterError: where workers cannot be reached or the scheduler is gone; a second run goes on from
            there.
    """
    clusters.require()
    for name, number, least in (("workers", workers, 1), ("retries", retries, 0), ("renew", renew, 1)):
        if number is not None and (isinstance(number, bool) or not isinstance(number, int) or number < least):
            raise UsageError(f"{name}={number!r}: must be a whole number, {least} or more")
    if workers is not None and cluster is not None:
        raise UsageError("workers are for this machine, and a cluster brings its own: give one of them")
    if tiles is not None and (png or not _are_tiles(tiles)):
        raise UsageError(f"tiles={tiles!r}: give rows and columns, such as (4, 4), and no png")
    planned = jobs(scene, grid or {}, zipped, options)
    check_parameters(planned)
    folder = _folder(out)
    table = Table(folder, tuple(grid or {}), {job.name: job.parameters for job in planned})
    shown = TerminalProgress(unit=" pictures") if progress is None else progress
    with TemporaryDirectory(prefix=".mrt-", dir=folder, ignore_cleanup_errors=True) as scratch:
        tasks = [_task(job, folder, scratch, png) for job in planned]
        table.keep([task.name for task in tasks if resume and is_fresh(task)], named(versions()))
        rest = [task for task in tasks if task.name not in table]
        if not rest:
            return table
        mosaics = [Mosaic.of(task, tiles) for task in rest] if tiles else []
        variant = options.get("variant") or ""
        most = sum(len(mosaic.tiles) for mosaic in mosaics) or len(rest)
        count = workers or min(clusters.default_workers(variant), most)
        local = clusters.Local(count, retries, variant.startswith("cuda"), dashboard)
        with clusters.connected(cluster, local) as client:
            sharing = clusters.inspect(client, scratch, count if cluster is None else 1)
            house = House(sharing, renew, cluster is None, versions())
            work = _Work(client, house, retries, resume)
            with table.writing(), shown.stage("Sweep", len(rest) + most * bool(tiles)) as advance:
                work.finish(work.submit(rest, mosaics), table, advance)
            if not tiles:
                _write_sheet(client, tasks)
    return table


def _are_tiles(tiles: Any) -> bool:
    return (
        isinstance(tiles, list | tuple)
        and len(tiles) == 2
        and all(isinstance(number, int) and number > 0 for number in tiles)
    )


def _folder(out: str | os.PathLike[str]) -> str:
    """Make a folder where there is none, and see whether files can be written there."""
    folder = os.path.abspath(out)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error
    check_target(os.path.join(folder, TABLE))
    return folder


def _task(job: Job, folder: str, scratch: str, png: bool) -> Task:
    scene, identity = send(job.scene, scratch)
    pixels = sorted((key, value) for key, value in job.arguments.items() if key != "memory")
    return Task(
        job.name, folder, scratch, scene, job.arguments, fingerprint(identity, pixels, versions()), png
    )


class _Work:
    """The jobs as the engine has them."""

    def __init__(self, client: Client, house: House, retries: int, resume: bool) -> None:
        self._client, self._house, self._resume = client, house, resume
        self._options: dict[str, Any] = {"house": house, "retries": retries, "pure": False}
        self._attempts: Counter[str] = Counter()

    def submit(self, tasks: Sequence[Task], mosaics: Sequence[Mosaic]) -> dict[Future, Sequence[Task]]:
        """Hand the jobs over; return for each its task, that of its picture first, or nothing for a tile."""
        self._client.subscribe_topic(TOPIC, lambda event: self._attempts.update([event[1]]))
        if not mosaics:
            return {future: [task] for future, task in zip(self._map(tasks), tasks, strict=True)}
        pending: dict[Future, Sequence[Task]] = {}
        for mosaic in mosaics:
            tiles = mosaic.tiles
            there = [self._resume and is_fresh(tile) for tile in tiles]
            futures = iter(self._map([tile for tile, fresh in zip(tiles, there, strict=True) if not fresh]))
            found = [{} if fresh else next(futures) for fresh in there]
            pending |= {tile: () for tile in found if tile}
            picture = self._client.submit(
                assemble_task, mosaic, found, key=mosaic.picture.key, **self._options
            )
            pending[picture] = [mosaic.picture, *tiles]
        return pending

    def _map(self, tasks: Sequence[Task]) -> list[Future]:
        keys = [task.key for task in tasks]
        return list(self._client.map(render_task, tasks, key=keys, **self._options))

    def finish(self, pending: dict[Future, Sequence[Task]], table: Table, advance: Advance) -> None:
        """Wait for the jobs; each picture's row goes into the table as it comes."""
        from distributed import as_completed

        try:
            for future in as_completed(list(pending), self._client.loop):
                tasks = pending.pop(future)
                if tasks:
                    attempts = max(1, *(self._attempts[task.key] for task in tasks))
                    facts = {"versions": named(self._house.versions), "attempts": attempts}
                    table.add(tasks[0].name, _facts(future) | facts)
                elif future.cancelled():
                    raise _gone()
                future.release()  # what no one needs is not computed again when its worker goes
                advance(1)
        finally:
            if self._client.status == "running":
                self._client.cancel(list(pending))
                self._client.unsubscribe_topic(TOPIC)


def _gone() -> ClusterError:
    return ClusterError(
        "the scheduler is gone: start it and its workers, and then the same sweep again, which goes on"
    )


def _facts(future: Future) -> dict[str, Any]:
    """Return the facts of a job that ended, by its own account or the engine's."""
    from concurrent.futures import CancelledError

    try:
        if future.status == "error":
            error = future.exception()
            return {"error": " ".join(f"{type(error).__name__}: {error}".split())}
        return dict(future.result())
    except (CancelledError, OSError) as error:
        raise _gone() from error


def _write_sheet(client: Client, tasks: Sequence[Task]) -> None:
    paths = [os.path.join(task.folder, task.files[-1]) for task in tasks[:MOST]]
    pictures = client.gather(client.map(thumbnail, paths, pure=False))
    write_sheet(os.path.join(tasks[0].folder, SHEET), [task.name for task in tasks[:MOST]], pictures)
