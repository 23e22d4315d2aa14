"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from itertools import chain
from typing import TYPE_CHECKING, Any

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import OutputError, UsageError, needs_extra
from mrt_mitsuba.options import StrPath, Values, check, integer
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.sweeps.folder import Facts, read_note, reserved
from mrt_mitsuba.sweeps.jobs import Job, check_parameters, jobs, points
from mrt_mitsuba.sweeps.pictures import cut, is_fresh, join
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.worker import describe

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from mrt_mitsuba.rendering.settings import SharedOptions


def sweep(
    scene: Any,
    out: StrPath,
    *,
    grid: Values | None = None,
    zipped: bool = False,
    workers: int | None = None,
    cluster: Any = None,
    tiles: tuple[int, int] | None = None,
    retries: int = 2,
    resume: bool = True,
    png: bool = False,
    dashboard: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[SharedOptions],
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
    with needs_extra("cluster"):
        from mrt_mitsuba.sweeps.cluster import connected, inspect, outcomes
    for name, number, least in (
        ("workers", workers, 1),
        ("retries", retries, 0),
        ("dashboard", dashboard, 0),
    ):
        if number is not None:
            check(name, integer(least, 65535), number)
    if workers is not None and cluster is not None:
        raise UsageError("workers are for this machine, and a cluster brings its own: give one of them")
    if tiles is not None and png:
        raise UsageError("tiles: pictures in tiles are written as EXR only; leave out png")
    current = getattr(sys.modules.get("mitsuba"), "variant", str)()
    if current not in (None, "", runtime.FAST) and "variant" not in (grid or {}):
        options.setdefault("variant", current)  # workers use the variant that ``render`` would
    named = points({} if grid is None else grid, zipped)
    try:
        folder = os.path.abspath(os.fsdecode(out))
        os.makedirs(folder, exist_ok=True)
    except (OSError, TypeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"cannot make the folder {out!s}: {reason}") from error
    shown = TerminalProgress(unit=" pictures") if progress is None else progress
    with reserved(folder) as (scratch, notes):
        table = Table(folder, named)
        table.earlier |= notes
        planned = jobs(scene, named, dict(options), scratch)
        whole = {job.name for job in planned if is_fresh(job, folder, table.earlier.get(job.file), png)}
        missing = [job for job in planned if not (job.name in whole and resume)]
        parts = {job.name: [job] if tiles is None else cut(job, tiles) for job in missing}
        pictures = {part.name: job for job in missing for part in parts[job.name]}
        every = list(chain(*parts.values()))
        kept = {}  # tiles of an earlier sweep, which has kept no facts of them but their checksums
        for tile in every if tiles is not None else ():
            noted = read_note(os.path.join(folder, tile.note)) or None
            if is_fresh(tile, folder, noted) and resume:
                kept[tile.name] = tile
        check_parameters(missing)
        versions = describe(scratch)["versions"]
        for job in planned:
            if job.name not in parts:
                known = table.earlier.get(job.file, {})
                table.add(job.name, known | {"file": job.file, "error": "", "versions": versions})
        made: dict[str, Facts] = {}
        ending: Iterator[tuple[Job, Facts]] = iter(())
        with ExitStack() as stack:
            if missing:
                variant = options.get("variant") or ""
                client = stack.enter_context(connected(cluster, len(every), workers, dashboard, variant))
                sharing = inspect(client, scratch, versions)
                setting = {"folder": folder, "png": png, "versions": versions, "sharing": sharing}
                rest = [part for part in every if part.name not in kept]
                ending = stack.enter_context(closing(outcomes(client, rest, retries, scratch, **setting)))
            stack.callback(table.write)
            advance = stack.enter_context(shown.stage("Sweep", len(every)))
            for part, facts in chain(((tile, {}) for tile in kept.values()), ending):
                made[part.name] = facts
                job = pictures[part.name]
                own = parts[job.name]
                if all(each.name in made for each in own):
                    outcome = join(job, own, [made[each.name] for each in own], folder)
                    table.add(job.name, outcome | {"versions": versions})
                advance(1)
    return table
