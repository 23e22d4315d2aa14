"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.errors import OutputError, one_line
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.sweeps.cluster import ClusterError, check_engine, connected, inspect
from mrt_mitsuba.sweeps.jobs import Job, check_parameters, jobs, sent
from mrt_mitsuba.sweeps.pictures import check_tiles, cut, is_fresh, join, refuse_to_replace
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.worker import Setting, noted, render_job, software

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
    try:
        folder = os.path.abspath(os.fsdecode(out))
        os.makedirs(folder, exist_ok=True)
    except (OSError, TypeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise OutputError(f"cannot make the folder {out!s}: {reason}") from error
    table = Table(folder, tuple(grid or {}), planned)
    shown = TerminalProgress(unit=" pictures") if progress is None else progress
    with TemporaryDirectory(prefix=".mrt-", dir=folder, ignore_cleanup_errors=True) as scratch:
        pictures = sent(planned, scratch)
        for job in pictures:
            refuse_to_replace(job, folder, job.file in table.earlier, png)
        rest = [job for job in pictures if not (resume and is_fresh(job, folder, png))]
        work = [(job, cut(job, tiles) if tiles else [job]) for job in rest]
        made: dict[str, dict[str, Any]] = {}  # facts of tiles that an earlier sweep left, which has kept none
        for tile in (tile for _, own in work for tile in own if tiles):
            refuse_to_replace(tile, folder)
            if resume and is_fresh(tile, folder):
                made[tile.name] = {}
        left = {job.name for job in rest}
        for job in pictures:
            if job.name not in left:
                known = table.earlier.get(job.file, {})
                table.add(job.name, known | {"file": job.file, "error": "", "versions": software()})
        if rest:
            from distributed.client import ClosedClientError

            check_parameters(planned)
            variant, most = options.get("variant") or "", sum(len(own) for _, own in work)
            with connected(cluster, most, workers, dashboard, variant) as client:
                setting = Setting(folder, scratch, png, software(), inspect(client, scratch))
                try:
                    _render(client, setting, retries, work, made, table, shown)
                except (CancelledError, ClosedClientError, OSError) as error:
                    raise ClusterError(
                        "the scheduler is gone: start it and its workers, then run the same sweep again; "
                        "it continues"
                    ) from error
        table.write()
    return table


def _render(
    client: Client,
    setting: Setting,
    retries: int,
    work: Sequence[tuple[Job, list[Job]]],
    made: dict[str, dict[str, Any]],
    table: Table,
    shown: Progress,
) -> None:
    """Let workers render pictures in their parts, tiles or the whole; put tiles together here.

    Each picture's row goes into the table as its last part ends. ``made``: facts of parts that are there.
    """
    from distributed import KilledWorker, as_completed

    calls: dict[Future, tuple[Job, list[Job], Job]] = {}
    handed: Counter[str] = Counter()
    coming = as_completed(loop=client.loop)

    def hand_over(job: Job, parts: list[Job], part: Job) -> None:
        handed[part.name] += 1
        key = f"{os.path.basename(setting.scratch)} {part.name} {handed[part.name]}"
        future = client.submit(render_job, part, setting, key=key, pure=False)
        calls[future] = job, parts, part
        coming.add(future)

    def finish(job: Job, parts: list[Job]) -> None:
        if all(part.name in made for part in parts):
            found = [made[part.name] for part in parts]
            facts = found[0] if parts == [job] else join(job, parts, found, setting.folder, setting.scratch)
            begun = max(1, *(noted(part, setting)[0] for part in parts))
            table.add(job.name, facts | {"attempts": begun, "versions": setting.software})

    try:
        for job, parts in work:
            for part in parts:
                if part.name not in made:
                    hand_over(job, parts, part)
            finish(job, parts)
        with shown.stage("Sweep", len(calls)) as advance:
            for future in coming:
                job, parts, part = calls.pop(future)
                if future.status not in ("finished", "error"):
                    raise CancelledError
                begun, facts = noted(part, setting)  # whatever has become of the worker since
                again = facts.pop("again", not facts)
                # The engine holds a worker's death against all jobs that the worker had been given
                if again and begun <= retries and handed[part.name] < retries + MOST_DEATHS:
                    hand_over(job, parts, part)
                    continue
                if not facts:
                    error = future.exception()
                    text = one_line(f"{type(error).__name__}: {error}")
                    if isinstance(error, KilledWorker):
                        text = (
                            "every worker that rendered it died, perhaps for want of memory: give each more"
                        )
                    facts = {"error": text}
                made[part.name] = facts
                future.release()  # what no one needs is not computed again when its worker goes
                finish(job, parts)
                advance(1)
    finally:
        table.write()
        if client.status == "running":
            client.cancel(list(calls))
