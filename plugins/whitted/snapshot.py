"""Snapshots of a scene: the only module that decides whether something has changed.

All that ``mrt_whitted`` makes of a scene depends on three parts of its snapshot: the shapes, their materials
and the lights. A part lists objects, references between them, their plain properties and the Dr.Jit index of
each of their arrays. It holds the arrays, so that Dr.Jit cannot give their indices to others, and the
objects, so that Python cannot give away their ids: parts with equal lists are the same, and no array is read
to tell.

Numbers may also be written where they lie, through an array of NumPy's: no index shows that, but an update by
``mi.traverse`` does (``updates``). What somebody else wrote in Python may depend on anything.

What is made of a part is cache with that part as its key (``Cache``). A part that has not changed since the
last snapshot is the same object as then; one with derivatives never is, as what was made of it has none, nor
one of materials or lights with a class that is somebody else's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import is_known
from ..variants import is_jit

Value = TypeVar("Value")
PLAIN = (bool, int, float, str, bytes, type(None))


#: updates by ``mi.traverse`` of each object, by its id: unique while the object lives
updates = Counter[int]()


@dataclass(eq=False)
class SnapshotPart:
    """Some objects with their textures and the like, as they are; equal to itself only."""

    state: list[object] = field(default_factory=list)  # what is compared
    comparable: bool = True  # equal states mean that nothing has changed
    differentiated: bool = False  # are derivatives wanted
    _held: dict[int, object] = field(default_factory=dict)  # objects, by id
    _arrays: list[dr.ArrayBase] = field(default_factory=list)

    def add(self, thing: mi.Object | None, elsewhere: tuple[type, ...], *facts: object) -> None:
        """Add an object and what it holds, but for objects of the classes that belong ``elsewhere``."""
        self.state += [id(thing), updates[id(thing)], *facts]
        if thing is None or id(thing) in self._held:
            return
        self._held[id(thing)] = thing
        if not (is_known(thing) or isinstance(thing, mi.Shape)):  # all that is read of shapes is in arrays
            self.comparable = False
        if is_jit() and hasattr(thing, "snapshot_state"):  # many are looked at in less time
            made, arrays = thing.snapshot_state()
            self.state.append(id(made))
            self._held[id(made)] = made
            self._arrays += arrays
            return
        own = getattr(thing, "__dict__", None) or {}  # of a class in Python
        for name, value, kind in [*parameters_of(thing), *((*item, None) for item in own.items())]:
            if isinstance(value, elsewhere):
                continue
            self.state.append(name)
            if isinstance(value, mi.Object):
                self.add(value, elsewhere)
            elif kind is None:
                self._add_value(value)
            else:  # made for this look at it
                self._add_value(mi.get_property(value, kind, thing), in_words=True)

    def _add_value(self, value: Any, in_words: bool = False) -> None:
        """Add a value; one of an unknown type by its text where ``in_words``, else by its identity."""
        numbers = value if dr.is_array_v(value) else getattr(value, "matrix", None)  # of transforms
        if isinstance(value, PLAIN):
            self.state.append(value)
        elif numbers is not None:
            if dr.is_jit_v(numbers):
                self._arrays.append(value)
            else:
                self.state.append(np.array(numbers).tobytes())
        elif in_words:
            self.state.append(str(value))
        else:
            self.state.append(id(value))
            self._held[id(value)] = value

    def close(self, before: SnapshotPart | None) -> SnapshotPart:
        """Return the part from ``before`` if nothing has changed since, else this one."""
        self.differentiated = dr.grad_enabled(self._arrays)
        self.comparable = self.comparable and not self.differentiated
        self.state += dr.detail.collect_indices(self._arrays)
        if before is not None and self.comparable and before.comparable and self.state == before.state:
            return before
        # An object shows its arrays themselves; copies share the numbers, and stay as they are
        self._arrays = [type(a)(a) for a in self._arrays] if self.comparable else []
        return self


class Snapshot:
    """The objects of a scene, and the parts that tell whether they have changed."""

    def __init__(self, scene: mi.Scene, before: Snapshot | None = None) -> None:
        """Look at a scene; parts that have not changed since ``before`` are taken from there."""
        # Not the scene itself: it owns the integrator, which owns this, and such a ring is never freed
        self.shapes = scene.shapes()
        self.emitters = scene.emitters()
        self.environment = scene.environment()
        self.eye = _eye(scene)
        # Groups are traced through their instances, which don't say what group they belong to
        inside = [value for _, value, _ in parameters_of(scene) if isinstance(value, mi.Shape)]
        self.groups = [shape for shape in inside if shape.class_name().startswith("ShapeGroup")]
        #: the shapes of the groups
        self.inner = [v for g in self.groups for _, v, _ in parameters_of(g) if isinstance(v, mi.Shape)]
        shapes = SnapshotPart()
        materials = SnapshotPart()
        lights = SnapshotPart()
        for shape in [*self.shapes, *self.groups, *self.inner]:
            elsewhere = (mi.Shape, mi.BSDF, mi.Emitter, mi.Sensor, mi.Medium)
            shapes.add(shape, elsewhere, shape.has_flipped_normals(), shape.is_emitter())
        bsdfs = [shape.bsdf() for shape in [*self.shapes, *self.inner]]
        materials.state += map(id, bsdfs)
        self.bsdfs = [b for b in dict.fromkeys(bsdfs) if b is not None]  #: each material once
        for bsdf in self.bsdfs:
            materials.add(bsdf, (mi.Shape, mi.Emitter, mi.Medium), bsdf.flags())
        for emitter in self.emitters:
            lights.add(emitter, (mi.Shape, mi.Medium), emitter.flags())
        lights.add(self.environment, (mi.Shape, mi.Medium))
        self.shape_part: SnapshotPart = shapes.close(before.shape_part if before else None)
        self.material_part: SnapshotPart = materials.close(before.material_part if before else None)
        self.light_part: SnapshotPart = lights.close(before.light_part if before else None)


class Cache(dict[str, tuple[Hashable, Any]]):
    """One-entry cache per name, keyed by all dependencies."""

    def __call__(self, name: str, key: Hashable, make: Callable[..., Value], *arguments: object) -> Value:
        """Return ``make(*arguments)``, made last time if the key was the same."""
        known = self.get(name)
        if known is None or known[0] != key:
            # Key and value come together or, where ``make`` is interrupted, not at all
            known = self[name] = key, make(*arguments)
        return known[1]


def _eye(scene: mi.Scene) -> tuple[float, ...] | None:
    """Return where the rays of the first camera come from; None where that is no point."""
    sensor = next(iter(scene.sensors()), None)
    if sensor is None or sensor.class_name() != "PerspectiveCamera":
        return None
    place = np.array(sensor.world_transform().translation(), float).ravel()
    return tuple(place) if np.isfinite(place).all() else None


def parameters_of(thing: mi.Object) -> list[tuple[str, Any, Any]]:
    """Return the parameters of one object: name, value, and how ``mi.get_property`` reads it, or None."""
    found = _collector(mi.variant())()
    found.entries = []
    thing.traverse(found)
    return found.entries


@cache
def _collector(variant: str) -> type[mi.TraversalCallback]:
    """Return the class of what collects parameters, for a variant: there is none before one is chosen."""

    class Collector(mi.TraversalCallback):
        def put(self, name: str, value: object, flags: int, cpptype: type | None = None) -> None:
            self.entries.append((name, value, cpptype))

    return Collector
