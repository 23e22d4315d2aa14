"""Many renders on several processes: how much faster, at what cost for each, and equal to the bit?"""

from __future__ import annotations

import contextlib
import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.cores import usable_cores
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import timed

TITLE = "Many renders on several processes"

SCENE = 3
ALPHA = "material_0.alpha"
FASTER = 0.6  # of the loop's time, on two workers and more
GROWTH = 1.1  # of a worker's memory after its first jobs
FIRST_JOBS = 10  # of each worker, in which it loads code and compiles
OVERHEAD = 10.0  # milliseconds of a job outside its render


@dataclass(frozen=True)
class Extent:
    """How many renders, of what size, how often."""

    alphas: int
    size: tuple[int, int]
    turns: int
    small: int  #: pictures by which the cost of a job is measured


FULL = Extent(100, (160, 120), 3, 300)
QUICK = Extent(3, (32, 24), 0, 0)
AA = (1, 2, 3, 4)


@dataclass
class Watch(Progress):
    """Sees how much memory the processes of a sweep hold, job by job."""

    memory: dict[int, list[tuple[int, int]]] = field(default_factory=dict)  #: jobs and bytes, by process

    @contextlib.contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Callable[[int], None]]:
        """Look at all processes below this one after each job, or batch of small ones."""
        import psutil

        done = 0

        def advance(steps: int) -> None:
            nonlocal done
            done += steps
            for child in psutil.Process().children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    self.memory.setdefault(child.pid, []).append((done, child.memory_info().rss))

        yield advance

    def growth(self, warm: int) -> float:
        """Return by how much the process that grew most did after ``warm`` jobs."""
        grown = [1.0]
        for found in self.memory.values():
            later = [size for count, size in found if count >= warm]
            grown.append(max(later, default=1) / later[0] if later else 1.0)
        return max(grown)


def run(study: Study, *, quick: bool) -> None:
    """Fill the study. A quick one gives no times."""
    extent = QUICK if quick else FULL
    counts = sorted({1, 2, usable_cores()})
    watch = Watch()
    with TemporaryDirectory() as folder:
        alone, swept = Path(folder, "alone"), Path(folder, "swept")
        alone.mkdir()
        loop(alone, extent)
        sweep(swept, extent, 2, watch)
        names = sorted(path.name for path in swept.glob("*.exr"))
        differ = sum(not same(alone / name, swept / name) for name in names)
        study.at_most("pictures that differ from those of a loop", differ, 0, "to the bit")
        study.at_least("pictures", len(names), extent.alphas * len(AA), "one of each combination")
        if extent.turns:
            warm = 2 * FIRST_JOBS
            title = "memory of a worker over that after its first jobs"
            why = "a leak would grow with each of 400 renders"
            study.at_most(title, watch.growth(warm), GROWTH, why)
            _times(study, Path(folder), extent, counts)


def _times(study: Study, folder: Path, extent: Extent, counts: Sequence[int]) -> None:
    taken: dict[int, list[float]] = {count: [] for count in (0, *counts)}
    for turn, count in study.each("Workers", [*itertools.product(range(extent.turns), taken)]):
        out = folder / f"{turn}-{count}"
        out.mkdir()
        run = partial(sweep, workers=count) if count else loop
        taken[count].append(timed(partial(run, out, extent))[1])
    ratios = {n: [own / one for own, one in zip(taken[n], taken[0], strict=True)] for n in counts}
    jobs = extent.alphas * len(AA)
    title = f"{jobs} renders of scene {SCENE}, {extent.size[0]}x{extent.size[1]}, on {usable_cores()} cores"
    columns = ("workers", "seconds", "fastest", "slowest", "of the loop's time")
    rows = [
        (n or "a loop", statistics.median(s), min(s), max(s), statistics.median(ratios[n]) if n else 1.0)
        for n, s in taken.items()
    ]
    note = (
        "A loop: the same renders and files in this process, one after the other. The seconds of a sweep "
        "hold the start of its workers and its contact sheet."
    )
    study.table("workers", title, columns, rows, note, first=True)
    if usable_cores() > 1:
        best = ratios[usable_cores()]
        span, why = (min(best), max(best)), "two workers halve it but for their start"
        study.goal("time of a sweep / a loop", statistics.median(best), FASTER, why, interval=span)
    costs = [_overhead(folder / f"small-{turn}", extent.small) for turn in range(extent.turns)]
    what = "milliseconds of a job outside its render"
    reason = "one worker, 64x48: the time of a long sweep less that of a short one"
    study.goal(what, statistics.median(costs), OVERHEAD, reason, interval=(min(costs), max(costs)))


def loop(folder: Path, extent: Extent) -> None:
    """Render the pictures of a sweep in this process, to files of the same names."""
    width, height = extent.size
    for alpha, aa in itertools.product(alphas(extent), AA):
        result = mrt.render(SCENE, width=width, height=height, aa=aa, params={ALPHA: alpha})
        result.save(folder / f"{ALPHA}={alpha},aa={aa}.exr")


def sweep(folder: Path, extent: Extent, workers: int, progress: Progress | None = None) -> None:
    """Render them by so many workers."""
    width, height = extent.size
    grid = {ALPHA: alphas(extent), "aa": list(AA)}
    progress = progress or Progress()
    mrt.sweep(SCENE, folder, grid=grid, workers=workers, progress=progress, width=width, height=height)


def alphas(extent: Extent) -> list[float]:
    """Return the values of alpha."""
    return [round(float(alpha), 4) for alpha in np.linspace(0.02, 0.5, extent.alphas)]


def same(a: Path, b: Path) -> bool:
    """Return whether two files hold the same picture and layers."""
    one, other = ({"": exr.image, **exr.layers} for exr in map(read_exr, (a, b)))
    return one.keys() == other.keys() and all(np.array_equal(one[k], other[k], equal_nan=True) for k in one)


def _overhead(folder: Path, count: int) -> float:
    """Return the milliseconds of a job beyond what its render and its file take."""
    few, spans = max(1, count // 10), []
    options: dict[str, Any] = {"workers": 1, "progress": Progress(), "width": 64, "height": 48, "aa": 1}
    for number in (few, count):
        grid = {"seed": range(number)}
        table, seconds = timed(partial(mrt.sweep, SCENE, folder / str(number), grid=grid, **options))
        spans.append(seconds)
    job = statistics.median(row["seconds"] for row in table.rows)
    return 1e3 * ((spans[1] - spans[0]) / (count - few) - job)
