"""The code that runs on a worker: variant, scene, render, file."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Mapping
from typing import Any

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, one_line
from mrt_mitsuba.machine import memory, usable_cores
from mrt_mitsuba.options import SMALLEST_MEMORY
from mrt_mitsuba.output.files import save, to_8bit
from mrt_mitsuba.output.replacing import check_target
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.sweeps.jobs import Job, identify, receive
from mrt_mitsuba.sweeps.pictures import MADE_WITH


def describe(folder: str) -> dict[str, Any]:
    """Return what a client asks of each worker before it begins: the versions of what decides about pixels,
    a name for its cores, which workers that share them have in common, and whether it sees a folder."""
    found = {**runtime.versions(), "python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    return {
        "versions": ", ".join(f"{name} {version}" for name, version in found.items()),
        "cores": f"{socket.gethostname()} {sorted(os.sched_getaffinity(0))}",
        "sees": os.access(folder, os.W_OK),
    }


def outcome(job: Job, scratch: str) -> dict[str, Any]:
    """Return what workers have noted of a job: "attempts", and what the last left where that has ended.
    Notes outlive workers: one may die of its next job before Dask has reported on this."""
    with contextlib.suppress(FileNotFoundError), open(f"{scratch}/{job.name}.json", "rb") as file:
        return json.load(file)
    return {"attempts": 0}


def render_job(
    job: Job, folder: str, scratch: str, png: bool, versions: str, sharing: Mapping[str, int]
) -> None:
    """Render a picture, write it to ``folder``, and note its facts for the table, or why there is none.

    ``scratch``: holds the files until they are complete, and the notes; ``versions``: those that all workers
    must have; ``sharing``: how many workers share cores, by their name.

    Errors that are not this project's are raised, too, and marked "again": a repetition may help, where
    memory or a device ran out.
    """
    from distributed import get_worker

    facts = outcome(job, scratch)
    if facts.get("file"):  # Dask repeats what it cannot get the result of
        return
    worker, own = get_worker(), os.path.join(scratch, job.name)
    os.makedirs(os.path.dirname(own), exist_ok=True)  # of tiles
    facts = {"attempts": facts["attempts"] + 1, "worker": worker.address}
    _note(own, facts)
    try:
        with runtime.one_at_a_time:
            here = describe(folder)
            if here["versions"] != versions:
                raise MrtError(f"the worker has {here['versions']}; the sweep began with {versions}")
            threads = max(1, usable_cores() // sharing.get(here["cores"], 1))
            facts |= _render(job, folder, scratch, png, threads, worker.memory_manager.memory_limit)
    except MrtError as error:
        facts["error"] = str(error)
    except BaseException as error:
        facts |= {"error": one_line(f"{type(error).__name__}: {error}"), "again": True}
        raise
    finally:
        _note(own, facts)


def _note(own: str, facts: Mapping[str, Any]) -> None:
    with open(f"{own}.note", "w") as file:
        json.dump(facts, file)
    os.replace(f"{own}.note", f"{own}.json")


def _render(job: Job, folder: str, scratch: str, png: bool, threads: int, limit: Any) -> dict[str, Any]:
    start = time.perf_counter()
    import drjit as dr

    from mrt_mitsuba.rendering.api import render

    if dr.thread_count() != threads:
        dr.set_thread_count(threads)
    arguments = dict(job.arguments)
    if limit:  # other workers need theirs
        arguments.setdefault("memory", max(min(memory()[0], limit) // 2, SMALLEST_MEMORY))
    runtime.use(arguments.get("variant") or runtime.default_variant())  # whatever an earlier sweep used
    result = render(receive(job.scene), progress=Progress(), **arguments)
    if identify(job.scene) != job.identity:
        raise MrtError(f"{job.scene} has changed since the sweep began: run it again")
    header = result.header() | {MADE_WITH: job.made_with}
    save(f"{scratch}/{job.file}", result.image, layers=result.layers, header=header)
    if png:
        mark = PngInfo()
        mark.add_text(MADE_WITH, job.made_with)
        Image.fromarray(to_8bit(result.image)).save(f"{scratch}/{job.name}.png", pnginfo=mark)
    for file in job.files(png):
        target = os.path.join(folder, file)
        os.makedirs(os.path.dirname(target), exist_ok=True)
        check_target(target, result.inputs)  # a scene may read pictures of earlier sweeps
        os.replace(os.path.join(scratch, file), target)
    rays, error = int(sum(result.rays.values())), result.error and float(result.error.rmse)
    return {"file": job.file, "seconds": time.perf_counter() - start, "rays": rays, "rmse": error}
