"""Files of settings for sub-commands."""

from __future__ import annotations

import sys
from typing import Any

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.scene.files import require_file

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def read_toml(path: str) -> dict[str, Any]:
    """Return the tables of a TOML file; raise ``UsageError`` where it cannot be read."""
    try:
        require_file(path)
        with open(path, "rb") as file:
            return tomllib.load(file)
    except SceneError as error:
        raise UsageError(str(error)) from error
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
