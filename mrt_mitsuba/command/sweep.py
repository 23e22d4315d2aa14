"""``mrt sweep OUT FILE.toml``: the sweep that a file describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mrt_mitsuba.command.toml import read_toml
from mrt_mitsuba.errors import UsageError

FORM = "OUT FILE.toml [workers=N] [cluster=ADDRESS]"


def run(words: list[str]) -> int:
    """Render a sweep; return 1 if a job failed."""
    out, path, overrides = _parse(words)
    settings = read_toml(path) | overrides
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


def _parse(words: list[str]) -> tuple[str, str, dict[str, Any]]:
    if len(words) < 2:
        raise UsageError(f"write mrt sweep {FORM}")
    overrides: dict[str, Any] = {}
    for word in words[2:]:
        name, _, value = word.partition("=")
        if name not in ("workers", "cluster") or not value:
            raise UsageError(f"unexpected argument {word!r}: write mrt sweep {FORM}")
        if name in overrides:
            raise UsageError(f"{name} is given twice")
        if name == "workers" and not value.isdecimal():
            raise UsageError(f"{word}: workers must be a whole number, 1 or more")
        overrides[name] = int(value) if name == "workers" else value
    return words[0], words[1], overrides


def _flat(grid: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the axes of a grid; keys with a dot that have no quotes make tables in TOML."""
    if not isinstance(grid, Mapping):
        raise UsageError("grid must be a table: write [grid] and a line for each key")
    for key, values in grid.items():
        if isinstance(values, Mapping):
            yield from _flat(values, f"{before}{key}.")
        else:
            yield before + key, values
