"""The code that runs on a worker: variant, scene, render, file."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba import runtime
from mrt_mitsuba.cores import affinity, usable_cores
from mrt_mitsuba.errors import MrtError
from mrt_mitsuba.memory import free_memory
from mrt_mitsuba.options import SMALLEST_MEMORY
from mrt_mitsuba.sweeps.jobs import Job
from mrt_mitsuba.sweeps.scenes import identify, is_copy, receive

MADE_WITH = "mrt:sweep"  # in the header of each picture: fingerprint of scene, settings and versions
UNREADABLE = (OSError, RuntimeError, ValueError, TypeError, SyntaxError)  # what libraries raise for files
ROWS = 64  # of a picture, read at a time; a multiple of the 16 that are compressed together


@dataclass(frozen=True)
class Setting:
    """What all jobs of a sweep share."""

    folder: str
    scratch: str  #: holds the file of each picture until it is complete and moves to ``folder``
    png: bool
    software: Mapping[str, str]  #: that all workers must have
    local: bool  #: do workers share this machine's home, and so its cache of kernels
    sharing: Mapping[str, int]  #: how many workers share cores, by ``cores``


def software(worker: Any = None) -> dict[str, str]:
    """Return the versions of what decides about pixels, and Python's.

    With a ``worker`` of a cluster, Dr.Jit, which is imported here first, keeps its kernels near it: the homes
    of clusters are often far away.
    """
    if worker is not None:
        near = os.path.join(os.path.dirname(worker.local_directory), "drjit")
        os.environ.setdefault("DRJIT_CACHE_DIR", near)
    return {**runtime.versions(), "python": f"{sys.version_info[0]}.{sys.version_info[1]}"}


def named(versions: Mapping[str, str]) -> str:
    """Return versions as text."""
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def cores() -> str:
    """Return a name for the cores of this process: workers that share them have the same."""
    return f"{socket.gethostname()} {affinity()}"


def describe(path: str, local: bool, dask_worker: Any = None) -> dict[str, Any]:
    """Return what a client asks of each worker before it begins, such as whether it sees a file."""
    sees = os.path.exists(path) and os.access(os.path.dirname(path), os.W_OK)
    return {"software": software(None if local else dask_worker), "cores": cores(), "sees": sees}


def attempts(name: str, setting: Setting) -> int:
    """Return how often workers have begun a job."""
    try:
        return os.path.getsize(os.path.join(setting.scratch, f"{name}.begun"))
    except FileNotFoundError:
        return 0


def render_job(job: Job, setting: Setting) -> dict[str, Any]:
    """Render a picture and write it; return its facts for the table, or the reason why there is none.

    Errors that are not this project's are raised: a repetition may help, where memory or a device ran out.
    """
    from distributed import get_worker

    worker, scratch = get_worker(), os.path.join(setting.scratch, job.name)
    os.makedirs(os.path.dirname(scratch), exist_ok=True)  # tiles have a folder of their own
    with open(f"{scratch}.begun", "ab") as file:
        file.write(b"+")
    try:
        with runtime.one_at_a_time:
            found = _render(job, setting, scratch, worker)
    except MrtError as error:
        found = {"error": " ".join(str(error).split())}
    return found | {"worker": worker.address}


def _render(job: Job, setting: Setting, scratch: str, worker: Any) -> dict[str, Any]:
    start = time.perf_counter()
    here = software(None if setting.local else worker)
    if here != setting.software:
        raise MrtError(f"the worker has {named(here)}; the sweep began with {named(setting.software)}")
    import drjit as dr
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from mrt_mitsuba.output.files import save, to_8bit
    from mrt_mitsuba.rendering.api import render
    from mrt_mitsuba.rendering.progress import Progress

    threads = max(1, usable_cores() // setting.sharing.get(cores(), 1))
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)
    arguments = dict(job.arguments)
    limit = worker.memory_manager.memory_limit
    if limit:  # other workers need theirs
        arguments.setdefault("memory", max(min(free_memory(), limit) // 2, SMALLEST_MEMORY))
    runtime.use(arguments.get("variant"))
    result = render(receive(job.scene), progress=Progress(), **arguments)
    if not is_copy(job.scene) and identify(job.scene) != job.identity:
        raise MrtError(f"{job.scene} has changed since the sweep began: run it again")
    header = result.header() | {MADE_WITH: job.made_with}
    save(f"{scratch}.exr", result.image, layers=result.layers, header=header)
    if setting.png:
        mark = PngInfo()
        mark.add_text(MADE_WITH, job.made_with)
        Image.fromarray(to_8bit(result.image)).save(f"{scratch}.png", pnginfo=mark)
    for ending in endings(setting.png):
        target = os.path.join(setting.folder, f"{job.name}.{ending}")
        os.makedirs(os.path.dirname(target), exist_ok=True)
        os.replace(f"{scratch}.{ending}", target)
    return {
        "file": job.file,
        "seconds": time.perf_counter() - start,
        "rays": sum(result.rays.values()),
        "rmse": result.error.rmse if result.error else None,
    }


def is_fresh(job: Job, folder: str, png: bool = False) -> bool:
    """Return whether a picture is there, whole, and made with the same scene, settings and versions."""
    import OpenEXR
    from PIL import Image

    from mrt_mitsuba.output.files import silenced

    path = os.path.join(folder, job.name)
    if any(made_with(f"{path}.{ending}") != job.made_with for ending in endings(png)):
        return False
    try:
        with silenced():
            file = OpenEXR.InputFile(f"{path}.exr")
            for _ in strips(file, list(file.header()["channels"])):
                pass
        if png:
            with Image.open(f"{path}.png") as picture:
                picture.load()
    except UNREADABLE:
        return False
    return True


def endings(png: bool) -> tuple[str, ...]:
    """Return the kinds of files that a job leaves."""
    return ("exr", "png") if png else ("exr",)


def made_with(path: str) -> str | None:
    """Return the fingerprint in a picture that a sweep made, "" in any other; None for what is no picture."""
    import OpenEXR
    from PIL import Image

    from mrt_mitsuba.output.files import silenced

    if not os.path.isfile(path):
        return None
    try:
        if path.endswith(".png"):
            with Image.open(path) as picture:
                return str(picture.info.get(MADE_WITH, ""))
        with silenced():
            return str(OpenEXR.File(path, header_only=True).header().get(MADE_WITH, ""))
    except UNREADABLE:
        return None


def strips(file: Any, channels: list[str]) -> Iterator[dict[str, bytes]]:
    """Yield the channels of an EXR, ``ROWS`` rows at a time."""
    height = file.header()["dataWindow"].max.y + 1
    for top in range(0, height, ROWS):
        bottom = min(top + ROWS, height) - 1
        yield dict(zip(channels, file.channels(channels, scanLine1=top, scanLine2=bottom), strict=True))
