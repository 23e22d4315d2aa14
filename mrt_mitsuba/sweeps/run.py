"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.runtime import versions
from mrt_mitsuba.sweeps.cluster import ClusterError, check_engine, connected, inspect
from mrt_mitsuba.sweeps.grid import Job, jobs
from mrt_mitsuba.sweeps.scenes import check_parameters, fingerprint, identify, send
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.tiles import assemble, check_tiles, cut
from mrt_mitsuba.sweeps.worker import Setting, attempts, is_fresh, made_with, named, render_job, software

if TYPE_CHECKING:
    from distributed import Client, Future


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
        pictures = _sent(planned, scratch)
        for job in pictures:
            _refuse_to_replace(folder, job.name, job.file in table.earlier, png)
        fresh = {job.name for job in pictures if resume and is_fresh(job, folder, png)}
        rest = [job for job in pictures if job.name not in fresh]
        parts = {job.name: cut(job, tiles) if tiles else [job] for job in rest}
        for tile in itertools.chain(*parts.values()) if tiles else ():
            _refuse_to_replace(folder, tile.name, False, False)
        here = {"error": "", "versions": named(versions())}
        for job in pictures:
            if job.name in fresh:
                table.add(job.name, table.earlier.get(job.file, {}) | {"file": job.file} | here)
        if not rest:
            table.write()
            return table
        steps = sum(map(len, parts.values())) + (len(rest) if tiles else 0)
        variant = options.get("variant") or ""
        with connected(
            cluster, steps, workers=workers, retries=retries, dashboard=dashboard, variant=variant
        ) as (client, count):
            check_parameters(planned)  # while workers start
            local = cluster is None
            sharing = inspect(client, scratch, count, local)
            setting = Setting(folder, scratch, png, software(), local, sharing)
            table.write()
            with shown.stage("Sweep", steps) as advance, _explained():
                futures = _submit(client, rest, parts, setting, retries, resume)
                try:
                    for job, facts in _ended(client, futures):
                        if job.name in parts:
                            begun = max(attempts(each.name, setting) for each in parts[job.name])
                            table.add(job.name, facts | {"attempts": begun, "versions": here["versions"]})
                        advance(1)
                finally:
                    table.write()
                    if client.status == "running":
                        client.cancel(list(futures))
    return table


def _sent(jobs: Sequence[Job], scratch: str) -> list[Job]:
    """Return jobs as workers take them, with their fingerprints; they need no values of the grid."""
    sent = {key: send(scene, scratch) for key, scene in {id(job.scene): job.scene for job in jobs}.items()}
    identities = {key: identify(scene) for key, scene in sent.items()}
    found = []
    for job in jobs:
        identity = identities[id(job.scene)]
        pixels = sorted((key, value) for key, value in job.arguments.items() if key != "memory")
        made = fingerprint(identity, pixels, versions())
        scene = sent[id(job.scene)]
        found.append(replace(job, scene=scene, parameters={}, identity=identity, made_with=made))
    return found


def _refuse_to_replace(folder: str, name: str, listed: bool, png: bool) -> None:
    """Raise ``OutputError`` for a file of the user's own under the name of a picture.

    A sweep's own has a mark in its header or, where that is broken, a row in the table; a PNG is next to it.
    """
    path = os.path.join(folder, name)
    for file in (f"{path}.exr", f"{path}.png") if png else (f"{path}.exr",):
        ours = os.path.isfile(file) and (listed or made_with(f"{path}.exr") is not None)
        if os.path.lexists(file) and not ours:
            raise OutputError(
                f"{file} was not made by a sweep, which would replace it: move it away, or choose "
                "another folder"
            )


def _submit(
    client: Client,
    rest: Sequence[Job],
    parts: Mapping[str, Sequence[Job]],
    setting: Setting,
    retries: int,
    resume: bool,
) -> dict[Future, Job]:
    """Hand over the pictures or their tiles, but for those tiles that are there; return what is to end."""
    prefix = os.path.basename(setting.scratch)
    given: dict[str, Any] = {"retries": retries, "pure": False}
    wanted = [
        each
        for job in rest
        for each in parts[job.name]
        if each is job or not (resume and is_fresh(each, setting.folder, png=False))
    ]
    keys = [(prefix, job.name) for job in wanted]
    futures = client.map(render_job, wanted, key=keys, setting=setting, **given)
    found = dict(zip(futures, wanted, strict=True))
    by_name = {job.name: future for future, job in found.items()}
    for job in rest:
        if job.name not in by_name:
            tiles = parts[job.name]
            made, key = [by_name.get(tile.name) for tile in tiles], (f"{prefix}-joined", job.name)
            found[client.submit(assemble, job, tiles, made, setting, key=key, **given)] = job
    return found


def _ended(client: Client, futures: dict[Future, Job]) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Yield jobs as they end, each with its facts by its own account or the engine's."""
    from distributed import KilledWorker, as_completed

    for future in as_completed(list(futures), client.loop):
        job = futures.pop(future)
        if future.status == "error":
            error = future.exception()
            text = " ".join(f"{type(error).__name__}: {error}".split())
            if isinstance(error, KilledWorker):
                text = "every worker that rendered it died, perhaps for want of memory: give each worker more"
            yield job, {"error": text}
        else:
            yield job, dict(future.result())
        future.release()  # what no one needs is not computed again when its worker goes


@contextmanager
def _explained() -> Iterator[None]:
    """Say what it means that the engine does not answer."""
    from concurrent.futures import CancelledError

    from distributed.client import ClosedClientError

    try:
        yield
    except (CancelledError, ClosedClientError, OSError) as error:
        raise ClusterError(
            "the scheduler is gone: start it and its workers, then run the same sweep again; it continues"
        ) from error
