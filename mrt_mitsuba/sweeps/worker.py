"""The code that runs on a worker: one job at a time; variant, scene, render, file."""

from __future__ import annotations

import functools
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.cores import affinity, usable_cores
from mrt_mitsuba.errors import MrtError, OutputError
from mrt_mitsuba.runtime import versions
from mrt_mitsuba.sweeps.scenes import Opener, SceneFile

# Of the scheduler's events, by which a client learns what has begun, and the facts about what has ended: to
# fetch a result takes it and the worker much longer
TOPIC = "mrt-sweep"
ENDED = "mrt-sweep-ended"
MADE_WITH = "mrt:sweep"  # header attribute: fingerprint of scene, settings and versions
THUMBNAIL = 160  # pixels, the longer side
ENOUGH = 0.2  # seconds of a batch, after which it ends
PAUSE = 0.5  # seconds before a worker ends, in which the client fetches the facts about its last job

_one_at_a_time = threading.Lock()  # Dr.Jit is not safe with several Python threads
_open = Opener()
_cores = functools.cache(usable_cores)
_done = 0  # jobs since this process began
_ending = threading.Event()  # it is about to be replaced


@dataclass(frozen=True)
class Task:
    """A picture to render: ``scratch`` holds its file until it is complete and moves to ``folder``."""

    name: str
    folder: str
    scratch: str
    scene: Any
    arguments: Mapping[str, Any]  #: of ``render``
    made_with: str
    png: bool = False

    @property
    def key(self) -> str:
        """Names the task among those of all clients of a scheduler."""
        return f"{os.path.basename(self.scratch)}/{self.name}"

    @property
    def thumbnail(self) -> str:
        """The path of the picture for the contact sheet, as an array."""
        return os.path.join(self.scratch, f"{self.name}.npy")

    @property
    def files(self) -> list[str]:
        """The names of the pictures to write, the EXR last."""
        return [f"{self.name}.{ending}" for ending in ("png", "exr") if self.png or ending == "exr"]


@dataclass(frozen=True)
class House:
    """The rules that all jobs of a worker share.

    ``sharing``: how many workers share cores, by ``cores_of``; ``renew``: jobs after which a worker gets a
    new process; ``local``: do workers share this machine's home, and so its cache of kernels.
    """

    sharing: Mapping[str, int]
    renew: int
    local: bool
    versions: Mapping[str, str]


def named(versions: Mapping[str, str]) -> str:
    """Return versions as text."""
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def cores_of() -> str:
    """Return a name for the cores of this process: workers that share them have the same."""
    return f"{socket.gethostname()} {affinity()}"


def facts(path: str) -> dict[str, Any]:
    """Return what a client asks of each worker before it begins, such as whether it sees a file."""
    return {
        "versions": versions(),
        "cores": cores_of(),
        "sees": os.path.exists(path) and os.access(os.path.dirname(path), os.W_OK),
    }


def is_fresh(task: Task) -> bool:
    """Return whether the pictures are there and were made with the same scene, settings and versions."""
    import OpenEXR

    paths = [os.path.join(task.folder, file) for file in task.files]
    if not all(map(os.path.isfile, paths)):
        return False
    try:
        header = OpenEXR.File(paths[-1], header_only=True).header()
    except (OSError, RuntimeError, ValueError, TypeError):
        return False
    return header.get(MADE_WITH) == task.made_with


def render_batch(tasks: Sequence[Task], house: House) -> dict[str, Any]:
    """Render pictures one after the other, as many as take little time; return the facts of the last.

    Errors that are not this project's are raised: a repetition may help, where memory or a device ran out.
    """
    start = time.monotonic()
    for task in tasks:
        found = _render_task(task, house)
        if time.monotonic() > start + ENOUGH:
            break
    return found


def _render_task(task: Task, house: House) -> dict[str, Any]:
    """Render a picture and write it; return its facts for the table, or the reason why there is none."""
    from distributed import Reschedule, get_worker

    global _done
    worker, note = get_worker(), os.path.join(task.scratch, f"{task.name}.json")
    with _one_at_a_time:
        if found := _read_note(note):  # done, but the worker was gone before it could report
            worker.log_event(ENDED, (task.key, found))
            return found
        if _done >= house.renew and (worker.nanny or house.local):
            _renew(worker)
            raise Reschedule  # to another worker, or to this one's next process
        worker.log_event(TOPIC, task.key)
        try:
            _prepare(worker, house)
            found = _render(task, worker) | {"worker": worker.address}
            with open(note, "w") as file:
                json.dump(found, file)
        except MrtError as error:
            found = {"error": " ".join(str(error).split()), "worker": worker.address}
        _done += 1
        worker.log_event(ENDED, (task.key, found))
    return found


def _read_note(path: str) -> dict[str, Any]:
    """Return what a worker wrote about a job that it has done; nothing where it did not come so far."""
    try:
        with open(path) as file:
            return dict(json.load(file))
    except (FileNotFoundError, json.JSONDecodeError):
        return {}


def _renew(worker: Any) -> None:
    """Let this process be replaced by a new one."""
    time.sleep(PAUSE)
    if not _ending.is_set():
        _ending.set()
        logging.getLogger("tornado.application").setLevel(logging.CRITICAL)  # or the end is a traceback
        worker.loop.add_callback(worker.close_gracefully, restart=True, reason="mrt-sweep: renewed")


def _prepare(worker: Any, house: House) -> None:
    """Choose Dr.Jit's cache, before it is imported, and its share of the cores; check the versions."""
    if versions() != house.versions:
        raise MrtError(f"the worker has {named(versions())}; the sweep began with {named(house.versions)}")
    if not house.local:  # homes of clusters are often far away
        near = os.path.join(os.path.dirname(worker.local_directory), "drjit")
        os.environ.setdefault("DRJIT_CACHE_DIR", near)
    import drjit as dr

    threads = max(1, _cores() // house.sharing.get(cores_of(), 1))
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)


def _render(task: Task, worker: Any) -> dict[str, Any]:
    import numpy as np

    from mrt_mitsuba import runtime
    from mrt_mitsuba.output.files import save
    from mrt_mitsuba.rendering.api import render_with
    from mrt_mitsuba.rendering.progress import Progress
    from mrt_mitsuba.rendering.settings import RenderSettings

    start = time.perf_counter()
    settings = RenderSettings.of(**{"memory": _memory(worker), **task.arguments})
    scene = task.scene
    if isinstance(scene, SceneFile):
        runtime.use(settings.variant)
        scene = scene.load()
    result = render_with(scene, settings, Progress(), opener=_open)
    header = result.header() | {MADE_WITH: task.made_with}
    for file in task.files:
        path, target = os.path.join(task.scratch, file), os.path.join(task.folder, file)
        for place in (path, target):  # tiles have a folder of their own
            os.makedirs(os.path.dirname(place), exist_ok=True)
        save(path, result.image, layers=result.layers, header=header)
        os.replace(path, target)
    if "region" not in task.arguments:
        np.save(task.thumbnail, shrunk(result.image))
    return {
        "file": task.files[-1],
        "seconds": time.perf_counter() - start,
        "rays": sum(result.rays.values()),
        "rmse": result.error.rmse if result.error else None,
    }


def _memory(worker: Any) -> int | None:
    """Return half of what is free or, if that is less, of what the worker may take; others need theirs."""
    from mrt_mitsuba.memory import Budget
    from mrt_mitsuba.options import SMALLEST_MEMORY

    limit = worker.memory_manager.memory_limit
    return max(min(Budget.of(None).size, limit // 2), SMALLEST_MEMORY) if limit else None


def thumbnail(path: str) -> Any:
    """Return a picture as ``shrunk`` does; None where it cannot be read."""
    from mrt_mitsuba.output.files import read_exr

    try:
        return shrunk(read_exr(path).image)
    except OutputError:
        return None


def shrunk(image: Any) -> Any:
    """Return a picture [H, W, 3] in sRGB, 8 bit, no larger than ``THUMBNAIL``."""
    import numpy as np
    from PIL import Image

    from mrt_mitsuba.output.files import to_8bit

    picture = Image.fromarray(to_8bit(np.nan_to_num(image), "srgb"))
    picture.thumbnail((THUMBNAIL, THUMBNAIL))
    return np.asarray(picture)
