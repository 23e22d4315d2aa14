"""Values of a loaded scene, by the keys of ``mi.traverse``."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from mrt_mitsuba.errors import UsageError


def set_parameters(scene: Any, values: Mapping[str, Any]) -> None:
    """Set values by their ``mi.traverse`` key; raise ``UsageError`` for unknown ones and wrong types."""
    import mitsuba as mi

    if not values:
        return
    parameters = mi.traverse(scene)
    for key, value in values.items():
        if key not in parameters:
            close = difflib.get_close_matches(key, parameters.keys(), n=1)
            hint = f"did you mean {close[0]}?" if close else "print(mi.traverse(scene)) lists all"
            raise UsageError(f"the scene has no parameter {key}: {hint}")
        kind = type(parameters[key])
        try:
            parameters[key] = kind(value)
        except (TypeError, ValueError, RuntimeError):
            raise UsageError(f"{key}={value!r}: must be a {kind.__name__}") from None
    parameters.update()
