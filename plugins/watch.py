"""What was read of Mitsuba's objects, kept until one of their parameters changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from .variants import is_jit

Value = TypeVar("Value")


class Notes:
    """What was read of some objects, each value by the function that reads it."""

    def __init__(self, things: Sequence[Any]) -> None:
        self._watches = [Watch(thing) for thing in things]
        self._entries = [entry for watch in self._watches for entry in watch.entries]
        self._state = _look(self._entries)[0]
        self._values: dict[int, dict[Callable, Any]] = {id(thing): {} for thing in things}

    def read(self, function: Callable[[Any], Value], thing: Any) -> Value:
        """Return ``function(thing)``, from the notes where nothing of the object has changed since."""
        known = self._values[id(thing)]
        if function not in known:
            known[function] = function(thing)
        return known[function]

    def refresh(self) -> bool:
        """Forget what was read of objects that have changed; return whether there is any."""
        state = _look(self._entries)[0]  # of all at once, as mostly nothing has changed
        if state == self._state:
            return False
        self._state = state
        changed = [watch for watch in self._watches if watch.changed()]
        for watch in changed:
            self._values[id(watch.thing)].clear()
        return bool(changed)


class Watch:
    """An object and its textures: have their parameters become other arrays, or numbers?

    The arrays are held, so that Dr.Jit cannot give their indices to others.
    """

    def __init__(self, thing: Any) -> None:
        self.thing = thing
        collector = _collector(mi.variant())(thing, [])
        thing.traverse(collector)
        self.entries = collector.entries
        self._state, values = _look(self.entries)
        self._held = [type(v)(v) for v in values]  # get_property shows the parameter itself

    def changed(self) -> bool:
        """Return whether a parameter has changed since the last call."""
        state, values = _look(self.entries)
        if state == self._state:
            return False
        self._state, self._held = state, [type(v)(v) for v in values]
        return True


def _look(entries: Sequence[tuple[Any, Any, Any]]) -> tuple[list[Any], list[Any]]:
    """Return what tells parameters apart, and the parameters."""
    values = [v if kind is None else mi.get_property(v, kind, node) for v, kind, node in entries]
    if not is_jit():
        return [np.array(v).tobytes() for v in values], []
    numbers = [v for v in values if isinstance(v, (bool, int, float))]
    # Derivatives are suspended while Mitsuba renders for the first time
    return [dr.grad_enabled(values), *numbers, *dr.detail.collect_indices(values)], values


@cache
def _collector(variant: str) -> type:
    """Return the class of what collects parameters, for a variant: there is none before one is chosen."""

    class Collector(mi.TraversalCallback):
        """Collects the parameters of an object, of its textures and of the BSDFs inside a BSDF."""

        def __init__(self, node: Any, entries: list[tuple[Any, Any, Any]]) -> None:
            super().__init__()
            self.node, self.entries = node, entries

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if not isinstance(value, mi.Object):
                self.entries.append((value, cpptype, self.node))
            elif not isinstance(value, (mi.Shape, mi.Emitter, mi.Medium)):
                value.traverse(Collector(value, self.entries))

    return Collector
