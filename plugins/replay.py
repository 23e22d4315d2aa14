"""Launching kernels again that were recorded before, without running the Python code that describes them.

Recording the code of a small picture takes ten times as long as running it. ``dr.freeze`` spares it where
that is safe, which ``mrt_whitted`` decides: in vectorised variants, where no derivatives are wanted and all
that a kernel reads is known. A recording is told apart by a key, which names everything in Python that shapes
the code, and by Dr.Jit by number, types and sizes of the arrays. An array that the code reads and that is not
among the inputs is an error while recording, so none can go out of date unseen.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Any

import drjit as dr
import mitsuba as mi

# Recordings of one kind that are kept: of a picture with filters there are up to eight
MOST = 32


_all: weakref.WeakSet[Replay] = weakref.WeakSet()


def forget_recordings() -> None:
    """Drop all recordings; to be called before Dr.Jit drops its kernels, which they would still launch."""
    for replay in _all:
        replay.forget()


class Replay:
    """Recordings of one kind; ``replay(key, inputs, run)`` returns what ``run()`` does: arrays."""

    def __init__(self) -> None:
        self._asked: dict[_Call, None] = {}  # the last to be asked for at the end
        self._frozen: Any = None
        _all.add(self)

    def forget(self) -> None:
        """Drop the recordings."""
        self._asked, self._frozen = {}, None

    def __call__(self, key: Hashable, inputs: Any, run: Callable[[], Any]) -> Any:
        """Return what ``run()`` does, which reads no arrays but ``inputs`` and those that it makes.

        It is recorded when it is asked for again: many a picture is rendered once.
        """
        call = _Call(key, run)
        again = call in self._asked
        self._asked[call] = self._asked.pop(call, None)
        try:
            if again:
                if self._frozen is None:
                    self._frozen = dr.freeze(_run, limit=MOST, warn_after=2**31 - 1)
                return self._frozen(call, inputs)
            for old in list(self._asked)[:-MOST]:
                del self._asked[old]
            return run()
        finally:
            call.run = None  # a call is kept, and must not keep the scene


def held(things: list[Any]) -> list[Any]:
    """Return the arrays, and the emitters, in objects of this package and in what they hold."""
    found, waiting, seen = list[Any](), list(things), set[int]()
    while waiting:
        value = waiting.pop()
        if id(value) in seen or isinstance(value, type):
            continue
        seen.add(id(value))
        if dr.is_array_v(value):
            found += [value] if dr.width(value) else []  # Dr.Jit aborts on an array of nothing
        elif isinstance(value, mi.Emitter):
            found.append(value)
        elif isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list | tuple):
            waiting += value
        elif type(value).__module__.startswith(f"{__package__}.") and hasattr(value, "__dict__"):
            waiting.append(vars(value))
    return found


class _Call:
    """A function of no arguments, which is the same as another one of its key."""

    def __init__(self, key: Hashable, run: Callable[[], Any] | None) -> None:
        self.key, self.run = key, run
        self._hash = hash(key)  # taken once: keys are long

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Call) and self.key == other.key

    def __hash__(self) -> int:
        return self._hash


def _run(call: _Call, inputs: Any) -> Any:
    assert call.run is not None
    return call.run()
