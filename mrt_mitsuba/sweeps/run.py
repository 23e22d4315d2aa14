"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from tempfile import TemporaryDirectory
from typing import Any

from mrt_mitsuba.errors import OutputError, UsageError
from mrt_mitsuba.output.replacing import check_target
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.runtime import versions
from mrt_mitsuba.sweeps import cluster as clusters
from mrt_mitsuba.sweeps.grid import Job, jobs
from mrt_mitsuba.sweeps.scenes import check_parameters, fingerprint, send
from mrt_mitsuba.sweeps.table import FILE as TABLE
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.tiles import Mosaic
from mrt_mitsuba.sweeps.work import Work
from mrt_mitsuba.sweeps.worker import Task, is_fresh, named

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

    Each picture is an EXR in ``out``, named by its values; next to them are ``table.csv``, written as jobs
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
    engine = clusters.Engine(cluster, workers, retries, renew, dashboard, options.get("variant") or "")
    planned = jobs(scene, grid or {}, zipped, options)
    if tiles is not None:
        _check_tiles(tiles, png, planned)
    folder = _folder(out)
    table = Table(folder, tuple(grid or {}), {job.name: job.parameters for job in planned})
    shown = TerminalProgress(unit=" pictures") if progress is None else progress
    with TemporaryDirectory(prefix=".mrt-", dir=folder, ignore_cleanup_errors=True) as scratch:
        tasks = [_task(job, folder, scratch, png) for job in planned]
        fresh = {task.name for task in tasks if resume and is_fresh(task)}
        rest = [task for task in tasks if task.name not in fresh]
        mosaics = [Mosaic.of(task, tiles) for task in rest] if tiles else []
        steps = len(rest) + sum(len(mosaic.tiles) for mosaic in mosaics)
        if not rest:
            table.keep(fresh, named(versions()))
            return table
        with engine.connected(scratch, steps) as (client, ready):
            check_parameters(planned)  # while workers start
            work = Work(client, ready(), retries)
            table.keep(fresh, named(versions()))
            with table.writing(), shown.stage("Sweep", steps) as advance:
                pending = work.submit_tiles(mosaics, resume) if tiles else work.submit(rest)
                work.finish(pending, table, advance)
            if not tiles:
                work.write_sheet(os.path.join(folder, SHEET), tasks)
    return table


def _check_tiles(tiles: Any, png: bool, planned: Sequence[Job]) -> None:
    pair = isinstance(tiles, list | tuple) and [type(number) for number in tiles] == [int, int]
    if not (pair and min(tiles) > 0):
        raise UsageError(f"tiles={tiles!r}: give rows and columns, such as (4, 4)")
    if png:
        raise UsageError("tiles: pictures in tiles are written as EXR only; leave out png")
    if any(job.arguments.get("target") or job.arguments.get("aamode") == "noise" for job in planned):
        raise UsageError("tiles: target and aamode=noise share the rays out over the whole picture")


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
