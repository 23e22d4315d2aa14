"""Reading the arguments of sub-commands: words and ``name=value``, and files in TOML."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import UsageError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def words(arguments: Sequence[str], names: Sequence[str], form: str) -> tuple[list[str], dict[str, str]]:
    """Split arguments into plain ones and ``name=value``; raise ``UsageError`` for an unknown name."""
    plain, given = [], {}
    for word in arguments:
        name, equals, value = word.partition("=")
        if not equals:
            plain.append(word)
        elif name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            meant = f", meant {close[0]}?" if close else "."
            raise UsageError(f"unknown option {name!r}{meant} Usage: {form}")
        elif name in given:
            raise UsageError(f"{name} is given twice")
        else:
            given[name] = value
    return plain, given


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a file; raise ``UsageError`` where it is missing or no TOML."""
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
