"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.runtime import versions
from mrt_mitsuba.sweeps.cluster import ClusterError, check_engine, connected, inspect
from mrt_mitsuba.sweeps.jobs import Job, jobs
from mrt_mitsuba.sweeps.scenes import check_parameters, sent
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.tiles import assemble, check_tiles, cut
from mrt_mitsuba.sweeps.worker import (
    Setting,
    attempts,
    endings,
    is_fresh,
    made_with,
    named,
    render_job,
    software,
)

if TYPE_CHECKING:
    from distributed import Client, Future

MOST_DEATHS = 10  # of workers that had been given a job which they did not begin


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
    dashboard: int | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Table:
    """Render every combination of a grid's values on several processes or machines.

    Each picture is an EXR in ``out``, named by its values, next to ``table.csv``, which is written as jobs
    end. A job that fails leaves a row with the reason, and the others go on.

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
        resume: keep the pictures that are whole and were made with the same settings and versions.
        png: write a PNG of each picture, too.
        dashboard: port of Dask's pages about the workers of this machine, which need Bokeh.
        progress: receives how far it is; by default shown on a terminal and in notebooks.
        options: arguments of ``render`` that all jobs share.

    Raises:
        UsageError, SceneError, OutputError: for a sweep that cannot be, before anything is rendered; also for
            files in ``out`` that no sweep made and this one would replace.
        ClusterError: where workers cannot be reached or the scheduler is gone; a second run goes on from
            there.
    """
    check_engine(cluster, workers=workers, retries=retries, dashboard=dashboard)
    planned = jobs(scene, {} if grid is None else grid, zipped, options)
    if tiles is not None:
        check_tiles(tiles, png, planned)
    folder = os.path.abspath(out)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error
    table = Table(folder, tuple(grid or {}), planned)
    shown = TerminalProgress(unit=" pictures") if progress is None else progress
    with TemporaryDirectory(prefix=".mrt-", dir=folder, ignore_cleanup_errors=True) as scratch:
        pictures = sent(planned, scratch)
        for job in pictures:
            _refuse_to_replace(folder, job.name, job.file in table.earlier, png)
        fresh = {job.name for job in pictures if resume and is_fresh(job, folder, png)}
        rest = [job for job in pictures if job.name not in fresh]
        parts = {job.name: cut(job, tiles) if tiles else [job] for job in rest}
        new = list(itertools.chain(*parts.values()))
        if tiles:
            for tile in new:
                _refuse_to_replace(folder, tile.name, False, False)
            new = [tile for tile in new if not (resume and is_fresh(tile, folder))]
        here = {"error": "", "versions": named(versions())}
        for job in pictures:
            if job.name in fresh:
                table.add(job.name, table.earlier.get(job.file, {}) | {"file": job.file} | here)
        if not rest:
            table.write()
            return table
        from distributed.client import ClosedClientError

        variant, most = options.get("variant") or "", max(1, len(new))
        with connected(cluster, most, workers, dashboard, variant) as (client, count):
            check_parameters(planned)  # while workers start
            local = cluster is None
            sharing = inspect(client, scratch, count, local)
            setting = Setting(folder, scratch, png, software(), local, sharing)
            table.write()
            try:
                _render(client, setting, retries, parts, rest, new, table, shown)
            except (CancelledError, ClosedClientError, OSError) as error:
                raise ClusterError(
                    "the scheduler is gone: start it and its workers, then run the same sweep again; "
                    "it continues"
                ) from error
    return table


def _refuse_to_replace(folder: str, name: str, listed: bool, png: bool) -> None:
    """Raise ``OutputError`` for a file of the user's own under the name of a picture.

    A sweep's own has a mark in its header or, where that is broken, a row in the table (``listed``).
    """
    for ending in endings(png):
        path = os.path.join(folder, f"{name}.{ending}")
        found = made_with(path)
        if os.path.lexists(path) and not (found or (found is None and listed and os.path.isfile(path))):
            raise OutputError(
                f"{path} was not made by a sweep, which would replace it: move it away, or choose "
                "another folder"
            )


def _render(
    client: Client,
    setting: Setting,
    retries: int,
    parts: Mapping[str, Sequence[Job]],
    rest: Sequence[Job],
    new: Sequence[Job],
    table: Table,
    shown: Progress,
) -> None:
    """Let workers render pictures, or their tiles (``parts``, by the picture's name) and put these together;
    each picture's row goes into the table as it ends. ``new``: parts that no earlier sweep left."""
    from distributed import KilledWorker, as_completed

    calls: dict[Future, tuple[Any, ...]] = {}
    deaths: Counter[str] = Counter()
    coming = as_completed(loop=client.loop)
    made: dict[str, dict[str, Any]] = {}
    whole = {part.name: job for job in rest for part in parts[job.name]}
    left = Counter(whole[part.name].name for part in new)

    def hand_over(function: Any, job: Job, *more: Any) -> None:
        key = (os.path.basename(setting.scratch), f"{job.name} {function.__name__} {deaths[job.name]}")
        spare = max(0, retries - attempts(job.name, setting))
        future = client.submit(function, job, *more, setting, key=key, retries=spare, pure=False)
        calls[future] = function, job, *more
        coming.add(future)

    def outcome(future: Future) -> tuple[Job, dict[str, Any] | None]:
        """Facts by the job's own account or the engine's. This holds a worker's death against all jobs that
        the worker had been given: those not begun too often are handed over again, and have no facts."""
        function, job, *more = calls.pop(future)
        error = future.exception() if future.status == "error" else None
        if error is None:
            return job, dict(future.result())
        if not isinstance(error, KilledWorker):
            return job, {"error": " ".join(f"{type(error).__name__}: {error}".split())}
        deaths[job.name] += 1
        if attempts(job.name, setting) <= retries and deaths[job.name] < MOST_DEATHS:
            hand_over(function, job, *more)
            return job, None
        text = "every worker that rendered it died, perhaps for want of memory: give each worker more"
        return job, {"error": text}

    def ended(job: Job, facts: dict[str, Any]) -> None:
        picture = whole.get(job.name, job)
        if picture is job:
            begun = max(1, *(attempts(part.name, setting) for part in parts[job.name]))
            table.add(job.name, facts | {"attempts": begun, "versions": named(versions())})
            return
        made[job.name] = facts
        left[picture.name] -= 1
        if not left[picture.name]:
            tiles = parts[picture.name]
            hand_over(assemble, picture, tiles, [made.get(tile.name) for tile in tiles])

    try:
        with shown.stage("Sweep", len(new) + sum(job.name not in whole for job in rest)) as advance:
            for part in new:
                hand_over(render_job, part)
            for job in rest:
                if not left[job.name]:
                    hand_over(assemble, job, parts[job.name], [None])
            for future in coming:
                job, facts = outcome(future)
                if facts is not None:
                    ended(job, facts)
                    advance(1)
                    future.release()  # what no one needs is not computed again when its worker goes
    finally:
        table.write()
        if client.status == "running":
            client.cancel(list(calls))
