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


def one_by_one() -> None:
    """Let ``mi.load_dict``, ``mi.load_file`` and ``mi.load_string`` make this project's objects one by one.

    Scenes without them, and calls that say ``parallel``, go on as before. Idempotent.
    """
    import mitsuba as mi

    def in_turn(loader: Callable[..., Any], mentions: Callable[[Any], bool]) -> Callable[..., Any]:
        @functools.wraps(loader)
        def load(source: Any, parallel: bool | None = None, optimize: bool = True, **parameters: Any) -> Any:
            parallel = not mentions(source) if parallel is None else parallel
            return loader(source, parallel, optimize, **parameters)

        return load

    for name, mentions in _MENTIONS.items():
        loader = getattr(mi, name)
        if not hasattr(loader, "__wrapped__"):
            setattr(mi, name, in_turn(loader, mentions))


def exclusive(lock: contextlib.AbstractContextManager[Any]) -> None:
    """Let ``mi.render`` and changes by ``mi.traverse`` hold a lock: done at once, they end the process.

    Idempotent.
    """
    import mitsuba as mi

    def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            with lock:
                return function(*args, **given)

        return call

    parameters = mi.SceneParameters
    for owner, name in ((mi, "render"), (parameters, "update"), (parameters, "__setitem__")):
        function = getattr(owner, name)
        if not hasattr(function, "__wrapped__"):
            setattr(owner, name, guarded(function))


def _is_mentioned(scene: Any) -> bool:
    """Return whether a dict has a plugin of this project; Mitsuba itself refuses anything else."""
    waiting, seen = [scene], set()
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict) and id(node) not in seen:
            seen.add(id(node))
            if str(node.get("type", "")).startswith(_OURS):
                return True
            waiting += node.values()
    return False


def _is_mentioned_in(path: Any) -> bool:
    """Return whether an XML file may have one, or one that it includes; Mitsuba reports unreadable files."""
    text = b""
    with contextlib.suppress(OSError, TypeError), open(path, "rb") as file:
        text = file.read()
    return _OURS.encode() in text or b"<include" in text


_OURS = "mrt_"
_MENTIONS: dict[str, Callable[[Any], bool]] = {
    "load_dict": _is_mentioned,
    "load_file": _is_mentioned_in,
    "load_string": lambda text: _OURS in text or "<include" in text,
}
