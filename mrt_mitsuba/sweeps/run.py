"""``sweep``: a grid in, a folder of pictures and their table out."""

from __future__ import annotations

import os
from contextlib import closing
from typing import TYPE_CHECKING, Any

import mitsuba as mi

from mrt_mitsuba import runtime, user_plugins
from mrt_mitsuba.errors import UsageError, needs_extra
from mrt_mitsuba.files.replacing import make_folder
from mrt_mitsuba.options import StrPath, Values, check, integer
from mrt_mitsuba.rendering.api import open_with
from mrt_mitsuba.rendering.progress import TerminalProgress
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.sweeps.folder import is_fresh, reserved
from mrt_mitsuba.sweeps.jobs import jobs, points
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.worker import describe

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from mrt_mitsuba.rendering.settings import RenderOptions


def sweep(  # noqa: PLR0913 - each option has a name that editors show
    scene: Any,
    out: StrPath,
    *,
    grid: Values | None = None,
    zipped: bool = False,
    workers: int | None = None,
    cluster: Any = None,
    retries: int = 2,
    resume: bool = True,
    plugins: Any = (),
    **options: Unpack[RenderOptions],
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
        workers: processes on this machine; by default one for each core. For a ``cuda`` variant, say how
            many the GPU has room for.
        cluster: address of a Dask scheduler, or a ``dask.distributed.Client``; None for this machine.
        retries: how often a job may lose its worker or fail by accident.
        resume: keep the pictures that are whole and were made with the same settings and versions.
        plugins: Python files or names of modules with plugins of your own, imported here and by each
            worker.
        options: arguments of ``render`` that all jobs share; ``progress`` receives how far the sweep is, by
            default shown on a terminal and in notebooks.

    Raises:
        UsageError, SceneError, OutputError: for a sweep that cannot be, before anything is rendered; also for
            files in ``out`` that no sweep made and this one would replace.
        ClusterError: where workers cannot be reached or the scheduler is gone; a second run goes on from
            there.
    """
    with needs_extra("cluster"):
        from mrt_mitsuba.sweeps.cluster import connected, inspect, outcomes
    check("retries", integer(0, 65535), retries)
    if workers is not None:
        check("workers", integer(1, 65535), workers)
    if workers is not None and cluster is not None:
        raise UsageError("workers are for this machine, and a cluster brings its own: give one of them")
    if mi.variant() not in (None, runtime.FAST) and "variant" not in (grid or {}):
        options.setdefault("variant", mi.variant())  # workers use the variant that ``render`` would
    named = points(grid or {}, zipped)
    folder = make_folder(out)
    shown = options.pop("progress", None) or TerminalProgress(unit=" pictures")
    modules = user_plugins.plugin_names(plugins)
    with reserved(folder):
        runtime.use()  # values may hold its types
        user_plugins.load(modules)
        table = Table(folder, named)
        planned = jobs(scene, named, dict(options), [user_plugins.digest(name) for name in modules])
        fresh = {job.name for job in planned if is_fresh(job, folder, job.file in table.earlier)}
        kept = fresh if resume else set()
        missing = [job for job in planned if job.name not in kept]
        if missing and "params" in missing[0].arguments:  # all have the same keys; refuses a misspelt one
            open_with(missing[0].scene, RenderSettings.of(**missing[0].arguments))
        versions = describe(folder)["versions"]
        for job in planned:
            if job.name in kept:
                known = table.earlier.get(job.file, {})
                table.add(job, known | {"file": job.file, "error": "", "versions": versions})
        with shown.stage("Sweep", len(missing)) as advance:
            if missing:
                with connected(cluster, len(missing), workers) as client:
                    setting = {
                        "folder": folder,
                        "versions": versions,
                        "sharing": inspect(client, folder, versions),
                        "plugins": modules,
                        "working_folder": os.getcwd() if cluster is None else None,
                    }
                    try:
                        with closing(outcomes(client, missing, retries, **setting)) as ending:
                            for job, facts in ending:
                                table.add(job, facts | {"versions": versions})
                                advance(1)
                    finally:
                        table.write()
        table.write()
    return table
