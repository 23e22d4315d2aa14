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
from mrt_mitsuba.sweeps.worker import ENDED, TOPIC, House, Task, is_fresh, named, render_task, thumbnail

if TYPE_CHECKING:
    from distributed import Client, Future

    # A picture's task, followed by those of its tiles; nothing for a tile, which has no row of its own
    Pending: TypeAlias = dict[Future, list[Task]]


class Work:
    """The jobs as the engine has them."""

    def __init__(self, client: Client, house: House, retries: int) -> None:
        self._client, self._house = client, house
        self._options: dict[str, Any] = {"house": house, "retries": retries, "pure": False}
        self._attempts: Counter[str] = Counter()
        self._ended: dict[str, dict[str, Any]] = {}
        client.subscribe_topic(TOPIC, lambda event: self._attempts.update([event[1]]))
        client.subscribe_topic(ENDED, lambda event: self._ended.update([event[1]]))

    def submit(self, tasks: Sequence[Task]) -> Pending:
        """Let the workers render pictures."""
        return {future: [task] for future, task in zip(self._map(tasks), tasks, strict=True)}

    def submit_tiles(self, mosaics: Sequence[Mosaic], resume: bool) -> Pending:
        """Let the workers render tiles, but for those that are there, and put the pictures together."""
        pending: Pending = {}
        for mosaic in mosaics:
            tiles = mosaic.tiles
            there = [resume and is_fresh(tile) for tile in tiles]
            futures = iter(self._map([tile for tile, fresh in zip(tiles, there, strict=True) if not fresh]))
            found: list[Future | None] = [None if fresh else next(futures) for fresh in there]
            pending |= {tile: [] for tile in found if tile}
            key = mosaic.picture.key
            picture = self._client.submit(assemble_task, mosaic, found, key=key, **self._options)
            pending[picture] = [mosaic.picture, *tiles]
        return pending

    def _map(self, tasks: Sequence[Task]) -> list[Future]:
        keys = [task.key for task in tasks]
        return list(self._client.map(render_task, tasks, key=keys, **self._options))

    def finish(self, pending: Pending, table: Table, advance: Advance) -> None:
        """Wait for the jobs; each picture's row goes into the table as it comes."""
        from distributed import as_completed

        try:
            for future in as_completed(list(pending), self._client.loop):
                tasks, facts = pending.pop(future), self._ended.pop(future.key, None)
                if facts is None or future.status != "finished":
                    facts = _facts(future)
                if tasks:
                    attempts = max(1, *(self._attempts[task.key] for task in tasks))
                    facts |= {"versions": named(self._house.versions), "attempts": attempts}
                    table.add(tasks[0].name, facts)
                future.release()  # what no one needs is not computed again when its worker goes
                advance(1)
        finally:
            if self._client.status == "running":
                self._client.cancel(list(pending))
                self._client.unsubscribe_topic(TOPIC)
                self._client.unsubscribe_topic(ENDED)

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

    try:
        yield
    except (CancelledError, OSError) as error:
        raise ClusterError(
            "the scheduler is gone: start it and its workers, then run the same sweep again; it continues"
        ) from error
