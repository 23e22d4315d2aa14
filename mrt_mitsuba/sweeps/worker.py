"""The code that runs on a worker: variant, scene, render, file."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba import runtime
from mrt_mitsuba.cores import affinity, usable_cores
from mrt_mitsuba.errors import MrtError, one_line
from mrt_mitsuba.memory import free_memory
from mrt_mitsuba.options import SMALLEST_MEMORY
from mrt_mitsuba.sweeps.jobs import SENT, Job, identify, receive
from mrt_mitsuba.sweeps.pictures import MADE_WITH, endings


@dataclass(frozen=True)
class Setting:
    """What all jobs of a sweep share."""

    folder: str
    scratch: str  #: holds the file of each picture until it is complete and moves to ``folder``
    png: bool
    software: str  #: that all workers must have
    sharing: Mapping[str, int]  #: how many workers share cores, by ``cores``


def software(worker: Any = None) -> str:
    """Return the versions of what decides about pixels, and Python's.

    With a ``worker``, Dr.Jit, which is imported here first, keeps its kernels near it: the homes of clusters
    are often far away.
    """
    if worker is not None:
        near = os.path.join(os.path.dirname(worker.local_directory), "drjit")
        os.environ.setdefault("DRJIT_CACHE_DIR", near)
    found = {**runtime.versions(), "python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    return ", ".join(f"{name} {version}" for name, version in found.items())


def describe(path: str, dask_worker: Any = None) -> dict[str, Any]:
    """Return what a client asks of each worker before it begins, such as whether it sees a file."""
    sees = os.path.exists(path) and os.access(os.path.dirname(path), os.W_OK)
    return {"software": software(dask_worker), "cores": _cores(), "sees": sees}


def _cores() -> str:
    """Return a name for the cores of this process: workers that share them have the same."""
    return f"{socket.gethostname()} {affinity()}"


def noted(job: Job, setting: Setting) -> tuple[int, dict[str, Any]]:
    """Return how often workers have begun a job, and what the last that ended it noted: facts, or an error.

    Notes outlive workers: one may die of its next job before Dask has reported on this.
    """
    path, begun, outcome = os.path.join(setting.scratch, job.name), 0, {}
    with contextlib.suppress(FileNotFoundError):
        begun = os.path.getsize(f"{path}.begun")
        with open(f"{path}.json", encoding="utf-8") as file:
            outcome = json.load(file)
    return begun, outcome


def render_job(job: Job, setting: Setting) -> None:
    """Render a picture, write it, and note its facts for the table, or the reason why there is none.

    Errors that are not this project's are raised, too: a repetition may help, where memory or a device ran
    out.
    """
    from distributed import get_worker

    from mrt_mitsuba.output.replacing import replacing

    if "file" in noted(job, setting)[1]:  # Dask repeats what it cannot get the result of
        return
    worker, scratch = get_worker(), os.path.join(setting.scratch, job.name)
    os.makedirs(os.path.dirname(scratch), exist_ok=True)  # tiles have a folder of their own
    with open(f"{scratch}.begun", "ab") as file:
        file.write(b"+")
    outcome: dict[str, Any] = {}
    try:
        with runtime.one_at_a_time:
            outcome = _render(job, setting, scratch, worker)
    except MrtError as error:
        outcome = {"error": str(error)}
    except BaseException as error:
        outcome = {"error": one_line(f"{type(error).__name__}: {error}"), "again": True}
        raise
    finally:
        with replacing(f"{scratch}.json") as (file,):
            file.write(json.dumps(outcome | {"worker": worker.address}).encode())


def _render(job: Job, setting: Setting, scratch: str, worker: Any) -> dict[str, Any]:
    start = time.perf_counter()
    here = software(worker)
    if here != setting.software:
        raise MrtError(f"the worker has {here}; the sweep began with {setting.software}")
    import drjit as dr
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from mrt_mitsuba.output.files import save, to_8bit
    from mrt_mitsuba.output.replacing import check_target
    from mrt_mitsuba.rendering.api import render
    from mrt_mitsuba.rendering.progress import Progress

    threads = max(1, usable_cores() // setting.sharing.get(_cores(), 1))
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)
    arguments = dict(job.arguments)
    limit = worker.memory_manager.memory_limit
    if limit:  # other workers need theirs
        arguments.setdefault("memory", max(min(free_memory(), limit) // 2, SMALLEST_MEMORY))
    runtime.use(arguments.get("variant"))
    result = render(receive(job.scene), progress=Progress(), **arguments)
    if not str(job.scene).endswith(SENT) and identify(job.scene) != job.identity:
        raise MrtError(f"{job.scene} has changed since the sweep began: run it again")
    save(
        f"{scratch}.exr",
        result.image,
        layers=result.layers,
        header=result.header() | {MADE_WITH: job.made_with},
    )
    if setting.png:
        mark = PngInfo()
        mark.add_text(MADE_WITH, job.made_with)
        Image.fromarray(to_8bit(result.image)).save(f"{scratch}.png", pnginfo=mark)
    for ending in endings(setting.png):
        target = os.path.join(setting.folder, f"{job.name}.{ending}")
        os.makedirs(os.path.dirname(target), exist_ok=True)
        check_target(target, result.inputs)  # a scene may read pictures of earlier sweeps
        os.replace(f"{scratch}.{ending}", target)
    return {
        "file": job.file,
        "seconds": time.perf_counter() - start,
        "rays": int(sum(result.rays.values())),
        "rmse": float(result.error.rmse) if result.error else None,
    }
