"""The jobs of a sweep as the engine has them: handed over, waited for, written down."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeAlias

from mrt_mitsuba.rendering.progress import Advance
from mrt_mitsuba.sweeps.cluster import ClusterError
from mrt_mitsuba.sweeps.sheet import MOST, write_sheet
from mrt_mitsuba.sweeps.table import Table
from mrt_mitsuba.sweeps.tiles import Mosaic, assemble_task
from mrt_mitsuba.sweeps.worker import ENDED, TOPIC, House, Task, is_fresh, named, render_batch, thumbnail

if TYPE_CHECKING:
    from distributed import Client, Future

    # The pictures, or tiles, that each is to render
    Pending: TypeAlias = dict[Future, Sequence[Task]]

BATCH = 4  # pictures of a batch at most: the engine takes for a batch what a tenth of a small picture takes
BATCHES = 16  # for each worker at least, so that all end at the same time


class Work:
    """The jobs as the engine has them."""

    def __init__(self, client: Client, house: House, retries: int) -> None:
        self._client, self._house = client, house
        self._retries = retries
        self._attempts: Counter[str] = Counter()
        self._ended: dict[str, dict[str, Any]] = {}
        self._tiles: dict[str, Sequence[Task]] = {}  #: of a picture, by its key
        client.subscribe_topic(TOPIC, lambda event: self._attempts.update([event[1]]))
        client.subscribe_topic(ENDED, lambda event: self._ended.update([event[1]]))

    def submit(self, tasks: Sequence[Task]) -> Pending:
        """Let the workers render pictures."""
        workers = sum(self._house.sharing.values())
        size = max(1, min(BATCH, len(tasks) // (BATCHES * workers)))
        return self._map([tasks[first : first + size] for first in range(0, len(tasks), size)])

    def submit_tiles(self, mosaics: Sequence[Mosaic], resume: bool) -> Pending:
        """Let the workers render tiles, but for those that are there, and put the pictures together."""
        pending: Pending = {}
        for mosaic in mosaics:
            tiles = mosaic.tiles
            there = [resume and is_fresh(tile) for tile in tiles]
            missing = self._map([[tile] for tile, fresh in zip(tiles, there, strict=True) if not fresh])
            futures = iter(missing)
            found: list[Future | None] = [None if fresh else next(futures) for fresh in there]
            key = mosaic.picture.key
            options = {"house": self._house, "retries": self._retries, "pure": False}
            picture = self._client.submit(assemble_task, mosaic, found, key=key, **options)
            pending |= missing | {picture: [mosaic.picture]}
            self._tiles[key] = tiles
        return pending

    def _map(self, batches: Sequence[Sequence[Task]], retries: int | None = None) -> Pending:
        retries, again = (self._retries, "") if retries is None else (retries, "+")
        keys = [batch[0].key + again for batch in batches]
        futures = self._client.map(
            render_batch, batches, key=keys, house=self._house, retries=retries, pure=False
        )
        return dict(zip(futures, batches, strict=True))

    def finish(self, pending: Pending, table: Table, advance: Advance) -> None:
        """Wait for the jobs; each picture's row goes into the table as it comes."""
        from distributed import as_completed

        try:
            coming = as_completed(list(pending), self._client.loop)
            for future in coming:
                more = self._again(future, pending[future])
                pending |= more
                coming.update(more)
                advance(self._add(pending.pop(future), table))
                future.release()  # what no one needs is not computed again when its worker goes
        finally:
            for tasks in pending.values():
                self._add(tasks, table)
            if self._client.status == "running":
                self._client.cancel(list(pending))
                self._client.unsubscribe_topic(TOPIC)
                self._client.unsubscribe_topic(ENDED)

    def _again(self, future: Future, tasks: Sequence[Task]) -> Pending:
        """Hand over what is left of a batch, each by itself: the others took long, or one failed."""
        more: Pending = {}
        for task in tasks:
            spare = self._retries - self._attempts[task.key]
            if task.key in self._ended:
                continue
            if len(tasks) > 1 and spare >= 0 and future.status in ("finished", "error"):
                with _explained():
                    more |= self._map([[task]], spare)
            else:
                self._ended[task.key] = _facts(future)
        return more

    def _add(self, tasks: Sequence[Task], table: Table) -> int:
        """Let those of some tasks that ended have their rows, but for tiles; return how many ended."""
        ended = [task for task in tasks if task.key in self._ended]
        for task in ended:
            facts = self._ended.pop(task.key)
            if task.name in table.jobs:
                parts = self._tiles.get(task.key, [task])
                attempts = max(1, *(self._attempts[part.key] for part in parts))
                table.add(task.name, facts | {"versions": named(self._house.versions), "attempts": attempts})
        return len(ended)

    def write_sheet(self, path: str, tasks: Sequence[Task]) -> None:
        """Write the pictures of some tasks, small, as one."""
        import numpy as np

        tasks = tasks[:MOST]
        paths = {
            task.name: os.path.join(task.folder, task.files[-1])
            for task in tasks
            if not os.path.exists(task.thumbnail)  # of an earlier sweep
        }
        with _explained():
            older = self._client.gather(self._client.map(thumbnail, list(paths.values()), pure=False))
        pictures = dict(zip(paths, older, strict=True))
        pictures |= {task.name: np.load(task.thumbnail) for task in tasks if task.name not in pictures}
        write_sheet(path, [task.name for task in tasks], [pictures[task.name] for task in tasks])


def _facts(future: Future) -> dict[str, Any]:
    """Return the facts of a job that ended, by its own account or the engine's."""
    with _explained():
        if future.status == "error":
            error = future.exception()
            return {"error": " ".join(f"{type(error).__name__}: {error}".split())}
        return dict(future.result())


@contextmanager
def _explained() -> Iterator[None]:
    """Say what it means that the engine does not answer."""
    from concurrent.futures import CancelledError

    from distributed.client import ClosedClientError

    try:
        yield
    except (CancelledError, ClosedClientError, OSError) as error:
        raise ClusterError(
            "the scheduler is gone: start it and its workers, then run the same sweep again; it continues"
        ) from error
