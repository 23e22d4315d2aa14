"""Where Mitsuba looks for plugins: in its own folder first."""

from __future__ import annotations

import os


def mitsuba_first(folder: str | None = None) -> None:
    """Let Mitsuba find its own plugins before files of their names in ``folder`` and others."""
    import mitsuba as mi

    current = mi.file_resolver()
    others = [str(current[i]) for i in range(len(current))]
    resolver = mi.FileResolver()
    resolver.clear()
    for each in dict.fromkeys([mitsuba_home(), *([folder] if folder else []), *others]):
        resolver.append(each)
    mi.set_file_resolver(resolver)


def mitsuba_home() -> str:
    """Return the folder in which Mitsuba is installed."""
    import mitsuba as mi

    return os.path.dirname(os.path.abspath(mi.__file__))
