"""What is changed in Mitsuba: how it loads, and that threads change and render scenes one after the other."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def rewriting_later() -> Iterator[None]:
    """Let functions under ``@dr.syntax`` be rewritten when they are first called.

    Mitsuba has ten of them, in integrators for derivatives; to rewrite them takes 60 ms of each start.
    """
    import drjit as dr

    rewrite = dr.syntax

    def later(function: Any = None, **options: Any) -> Any:
        if function is None or options:
            return rewrite(function, **options)
        rewritten = functools.cache(lambda: rewrite(function))
        return functools.wraps(function)(lambda *args, **given: rewritten()(*args, **given))

    dr.syntax = later
    try:
        yield
    finally:
        dr.syntax = rewrite


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


def one_by_one(lock: contextlib.AbstractContextManager[Any]) -> None:
    """Let Mitsuba's loaders make this project's objects one by one, and ``mi.render`` and changes by
    ``mi.traverse`` hold a lock: done at once, either ends the process.

    Scenes without our plugins, and calls that say ``parallel``, load as before. Idempotent.
    """
    import mitsuba as mi

    def in_turn(loader: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(loader)
        def load(source: Any, parallel: bool | None = None, optimize: bool = True, **parameters: Any) -> Any:
            parallel = not _mentions_ours(source) if parallel is None else parallel
            return loader(source, parallel, optimize, **parameters)

        return load

    def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            with lock:
                return function(*args, **given)

        return call

    changes = ((mi, "render"), (mi.SceneParameters, "update"), (mi.SceneParameters, "__setitem__"))
    loaders = ((mi, name) for name in ("load_dict", "load_file", "load_string"))
    for (owner, name), wrapped in [*((c, guarded) for c in changes), *((f, in_turn) for f in loaders)]:
        function = getattr(owner, name)
        if not hasattr(function, "__wrapped__"):
            setattr(owner, name, wrapped(function))


def _mentions_ours(source: Any) -> bool:
    """Return whether a dict, or a file of XML or its text, may have a plugin of this project; Mitsuba itself
    refuses anything else, and reports files that cannot be read."""
    text = repr(source) if isinstance(source, dict) else str(source)
    with contextlib.suppress(OSError, ValueError), open(text, encoding="utf-8", errors="ignore") as file:
        text = file.read()
    return "mrt_" in text or "<include" in text
