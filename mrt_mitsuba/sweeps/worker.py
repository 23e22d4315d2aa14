"""The code that runs on a worker: variant, scene, render, file."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from collections.abc import Mapping

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, one_line
from mrt_mitsuba.files.images import save, to_8bit
from mrt_mitsuba.files.replacing import check_target
from mrt_mitsuba.machine import memory, usable_cores
from mrt_mitsuba.options import SMALLEST_MEMORY
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.sweeps.folder import Facts, read_note, write_note
from mrt_mitsuba.sweeps.jobs import Job, identify, receive
from mrt_mitsuba.sweeps.pictures import MADE_WITH, checksum


def describe(folder: str) -> Facts:
    """Facts that a client asks each worker for before it begins: the versions of all that decides about
    pixels, a name for its cores, the same for workers that share them, and whether it sees a folder."""
    versions = {**runtime.versions(), "python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    return {
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "cores": f"{socket.gethostname()} {sorted(os.sched_getaffinity(0))}",
        "sees": os.access(folder, os.W_OK),
    }


def outcome(job: Job, scratch: str) -> Facts:
    """The facts that workers have noted of a job: "attempts", and those of the last if it has ended.

    Notes outlive workers: one may die of its next job before Dask has reported on this.
    """
    return {"attempts": 0} | read_note(f"{scratch}/{job.name}.json")


def render_job(
    job: Job, folder: str, scratch: str, png: bool, versions: str, sharing: Mapping[str, int]
) -> None:
    """Render a picture, write it to ``folder``, and note its facts for the table, or its error.

    ``scratch``: holds the files until they are complete, and the notes; ``versions``: those that all workers
    must have; ``sharing``: how many workers share cores, by their name.

    Errors that are not this project's are raised, too, and marked "again": a repetition may help, where
    memory or a device ran out.
    """
    from distributed import get_worker

    facts = outcome(job, scratch)
    if facts.get("file"):  # Dask repeats what it cannot get the result of
        return
    worker = get_worker()
    note = os.path.join(scratch, f"{job.name}.json")
    with contextlib.suppress(FileExistsError):
        os.mkdir(os.path.dirname(note))  # of tiles; of a sweep that was killed, nothing is made anew
    facts = {"attempts": facts["attempts"] + 1, "worker": worker.address}
    write_note(note, facts)
    try:
        with runtime.one_at_a_time.lock:
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
        write_note(note, facts)


def _render(job: Job, folder: str, scratch: str, png: bool, threads: int, limit: int | None) -> Facts:
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
    sums = [checksum(os.path.join(scratch, file)) for file in job.files(png)]
    for file in job.files(png):
        target = os.path.join(folder, file)
        os.makedirs(os.path.dirname(target), exist_ok=True)
        check_target(target, result.inputs)  # a scene may read pictures of earlier sweeps
        os.replace(os.path.join(scratch, file), target)
    if job.is_tile:
        write_note(os.path.join(folder, job.note), {"checksum": sums[0]})
    return {
        "file": job.file,
        "seconds": time.perf_counter() - start,
        "rays": int(sum(result.rays.values())),
        "rmse": result.error and float(result.error.rmse),
        "checksum": " ".join(sums),
    }
