"""``mrt sweep OUT FILE.toml``: the sweep that a file describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mrt_mitsuba.command.toml import read_toml
from mrt_mitsuba.errors import UsageError


def run(out: str, path: str, *, workers: str | None = None, cluster: str | None = None) -> int:
    """Render a sweep; return 1 if a job failed."""
    settings = read_toml(path)
    if workers is not None:
        settings["workers"] = int(workers) if workers.isdecimal() else workers
    if cluster is not None:
        settings["cluster"] = cluster
    for name in ("out", "progress"):
        if name in settings:
            raise UsageError(f"{path}: {name} cannot be set in a file")
    grid = dict(_flat(settings.pop("grid", {})))
    scene = settings.pop("scene", None if "scene" in grid else 0)
    from mrt_mitsuba import sweep

    table = sweep(scene, out, grid=grid, **settings)
    print(table)
    for row in table.failed:
        print(f"failed: {', '.join(f'{key}={row[key]}' for key in table.keys)}: {row['error']}")
    return 1 if table.failed else 0


def _flat(grid: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the axes of a grid; keys with a dot that have no quotes make tables in TOML."""
    if not isinstance(grid, Mapping):
        raise UsageError("grid must be a table: write [grid] and a line for each key")
    for key, values in grid.items():
        if isinstance(values, Mapping):
            yield from _flat(values, f"{before}{key}.")
        else:
            yield before + key, values
