"""``mrt sweep OUT FILE.toml``: the sweep that a file describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mrt_mitsuba.command.words import read_toml, words
from mrt_mitsuba.errors import UsageError

FORM = "mrt sweep OUT FILE.toml [workers=N] [cluster=ADDRESS]"


def run(arguments: list[str]) -> int:
    """Render a sweep; return 1 if a job failed."""
    out, path, overrides = _parse(arguments)
    settings = read_toml(Path(path)) | overrides
    grid = dict(_flat(settings.pop("grid", {})))
    scene = settings.pop("scene", None if "scene" in grid else 0)
    from mrt_mitsuba import sweep

    for name in ("out", "progress"):
        if name in settings:
            raise UsageError(f"{path}: {name} cannot be set in a file")
    table = sweep(scene, out, grid=grid, **settings)
    print(table)
    for row in table.failed:
        print(f"failed: {', '.join(f'{key}={row[key]}' for key in table.keys)}: {row['error']}")
    return 1 if table.failed else 0


def _parse(arguments: list[str]) -> tuple[str, str, dict[str, Any]]:
    plain, given = words(arguments, ("workers", "cluster"), FORM)
    if len(plain) != 2:
        raise UsageError(f"give a folder and a file. Usage: {FORM}")
    overrides: dict[str, Any] = dict(given)
    if given.get("workers", "").isdecimal():
        overrides["workers"] = int(given["workers"])
    return plain[0], plain[1], overrides


def _flat(grid: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the axes of a grid; keys with a dot that have no quotes make tables in TOML."""
    if not isinstance(grid, Mapping):
        raise UsageError("grid must be a table: write [grid] and a line for each key")
    for key, values in grid.items():
        if isinstance(values, Mapping):
            yield from _flat(values, f"{before}{key}.")
        else:
            yield before + key, values
