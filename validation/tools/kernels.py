"""The kernels of a render, one by one: in which pass they run, what they cost to compile and to run.

Dr.Jit keeps a history of them; the stages that a render reports to its ``Progress`` say where they belong.
"""

from __future__ import annotations

import os
import statistics
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mrt_mitsuba.rendering.progress import Advance, Progress

CACHE = "DRJIT_CACHE_DIR"
PREFIX = "mrt-kernels-"
OUTSIDE = "outside of passes"


@dataclass(frozen=True)
class Kernel:
    """All launches of a kernel in one pass of one render. Kind and hash identify a kernel."""

    stage: str
    kind: str  # "traces rays", "computes", or Dr.Jit's own name: "BlockReduce", ...
    hash: str
    launches: int
    size: int  # threads of all launches
    operations: int  # of the code, a measure of its length; 0 for Dr.Jit's own kernels
    codegen: float  # seconds that writing the code took, every time
    compile: float  # seconds of the compiler, where no cache held the kernel
    seconds: float  # running

    @property
    def key(self) -> tuple[str, str, str]:
        return self.stage, self.kind, self.hash


@contextmanager
def own_cache() -> Iterator[None]:
    """Let Dr.Jit keep its kernels in a new folder, for ``forget`` to work; enter before it is imported."""
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as folder:
        before, os.environ[CACHE] = os.environ.get(CACHE), folder
        try:
            yield
        finally:
            del os.environ[CACHE]
            os.environ |= {} if before is None else {CACHE: before}


def forget() -> None:
    """Make the next render compile its kernels, or, without a cache of our own, read them from the cache."""
    import drjit as dr

    dr.flush_kernel_cache()
    if has_own_cache():
        for file in Path(os.environ[CACHE]).iterdir():
            file.unlink(missing_ok=True)


def has_own_cache() -> bool:
    """Return whether seconds of compilation are those of the compiler, not of reading a cache."""
    return Path(os.environ.get(CACHE, "")).name.startswith(PREFIX)


def profile(render: Callable[..., Any], *, repeats: int = 3) -> list[Kernel]:
    """Return the kernels of ``render(progress=...)``, compiled first, then timed as medians of ``repeats``.

    They come in the order in which they first ran.
    """
    forget()
    compiled = {kernel.key: kernel for kernel in _watched(render)}
    runs = [{kernel.key: kernel for kernel in _watched(render)} for _ in range(repeats)]
    return [
        replace(
            last,
            compile=compiled[key].compile if key in compiled else 0.0,
            seconds=statistics.median(run[key].seconds for run in runs if key in run),
        )
        for key, last in runs[-1].items()
    ]


def _watched(render: Callable[..., Any]) -> list[Kernel]:
    watch = _Watch()
    render(progress=watch)
    return watch.grouped()


@dataclass
class _Watch(Progress):
    """Notes kernels with the stage in which they ran."""

    entries: list[tuple[str, Mapping[str, Any]]] = field(default_factory=list)
    current: str = OUTSIDE

    @contextmanager
    def stage(self, title: str, total: int, message: str = "") -> Iterator[Advance]:
        self.current = title.lower()
        with super().stage(title, total, message) as advance:
            yield advance
        self.current = OUTSIDE

    def kernels(self, records: Sequence[Mapping[str, Any]]) -> None:
        self.entries += [(self.current, record) for record in records]

    def grouped(self) -> list[Kernel]:
        groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
        for stage, entry in self.entries:
            groups.setdefault((stage, _kind(entry), str(entry.get("hash", ""))), []).append(entry)
        return [_kernel(key, entries) for key, entries in groups.items()]


def _kind(entry: Mapping[str, Any]) -> str:
    import drjit as dr

    if entry["type"] != dr.KernelType.JIT:
        return str(entry["type"]).split(".")[-1]
    # what Dr.Jit calls its arguments to Embree, and OptiX
    code = entry["ir"].getvalue()
    return "traces rays" if "_in_ctx" in code or entry.get("uses_optix") else "computes"


def _kernel(key: tuple[str, str, str], entries: Sequence[Mapping[str, Any]]) -> Kernel:
    def total(name: str) -> float:
        return sum(entry.get(name, 0.0) for entry in entries) / 1000  # from milliseconds

    size = sum(entry["size"] for entry in entries)
    operations = entries[0].get("operation_count", 0)
    seconds = (total("codegen_time"), total("backend_time"), total("execution_time"))
    return Kernel(*key, len(entries), size, operations, *seconds)
