"""The code that runs on a worker: plugins, scene, render, file."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Mapping, Sequence

import drjit as dr

from mrt_mitsuba import runtime, user_plugins
from mrt_mitsuba.errors import MrtError
from mrt_mitsuba.files.images import save
from mrt_mitsuba.machine import affinity, memory, usable_cores
from mrt_mitsuba.options import SMALLEST_MEMORY
from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.sweeps.folder import LOCK, MADE_WITH
from mrt_mitsuba.sweeps.jobs import Facts, Job, decode, scene_digest


def describe(folder: str) -> Facts:
    """Return what the caller checks of each worker: the versions of everything that affects pixels, the
    cores it runs on, and whether it can write to the sweep's folder, known by its lock."""
    versions = {**runtime.versions(), "python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    return {
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "cores": f"{socket.gethostname()} {affinity()}",
        "sees": os.path.exists(os.path.join(folder, LOCK)) and os.access(folder, os.W_OK),
    }


def render_job(
    data: bytes,
    folder: str,
    versions: str,
    sharing: Mapping[str, int],
    plugins: Sequence[str],
    working_folder: str | None,
) -> Facts:
    """Render a picture, write it to ``folder``, and return its facts for the table, or its "error".

    ``data``: an encoded ``Job``; ``versions``: those that all workers must have; ``sharing``: how many
    workers share cores, by their name; ``working_folder``: that of the caller, for relative names in scenes.
    Unexpected errors are raised, as another attempt may succeed where memory or a device ran out.
    """
    from distributed import get_worker

    worker = get_worker()
    facts: Facts = {"worker": worker.address}
    try:
        with runtime.render_lock:
            here = describe(folder)
            if here["versions"] != versions:
                raise MrtError(f"the worker has {here['versions']}; the sweep began with {versions}")
            if working_folder:
                os.chdir(working_folder)
            user_plugins.load(plugins)
            threads = max(2, usable_cores() // sharing.get(here["cores"], 1))
            if dr.thread_count() != threads:
                dr.set_thread_count(threads)
            facts |= _render(decode(data), folder, worker.memory_manager.memory_limit)
    except MrtError as error:
        facts["error"] = str(error)
    return facts


def _render(job: Job, folder: str, limit: int | None) -> Facts:
    start = time.perf_counter()
    arguments = dict(job.arguments)
    runtime.use(arguments.get("variant") or runtime.default_variant())  # whatever an earlier sweep used
    if limit:  # other workers need theirs
        arguments.setdefault("memory", max(min(memory()[0], limit) // 2, SMALLEST_MEMORY))
    result = render(job.scene, progress=Progress(), **arguments)
    if scene_digest(job.scene) != job.scene_digest:
        raise MrtError(f"{job.scene} has changed since the sweep began: run it again")
    path = os.path.join(folder, job.file)
    header = result.header() | {MADE_WITH: job.made_with}
    save(path, result.image, layers=result.layers, header=header, inputs=result.inputs)
    return {
        "file": job.file,
        "seconds": time.perf_counter() - start,
        "rays": int(sum(result.rays.values())),
        "rmse": result.error and float(result.error.rmse),
    }
