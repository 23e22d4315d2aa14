"""The changes that this package makes in Mitsuba: ``CHANGES`` lists each with its reason. Mitsuba needs them
since 3.9 at least.

``make()`` puts the changes into effect, ``undo()`` takes them back; ``mrt.register(guard=False)`` leaves
them out. Names, signatures and pickles of what is changed stay Mitsuba's. A change is known by the function
itself, which ``Change`` keeps: what somebody else puts around Mitsuba's functions is not taken for it.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache, reduce, wraps
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mrt_mitsuba import plugins
from mrt_mitsuba.interrupts import interrupt_behind
from mrt_mitsuba.plugins.whitted.snapshot import updates

Function = Callable[..., Any]

# Files are searched for our plugins up to this size; larger ones are taken to have some
LARGEST_SEARCHED = 2**26  # bytes

# What an XML file has that names a plugin of ours, or may do so in a way that a search does not see: another
# file, an escaped letter, a parameter, an encoding of several bytes for a letter
HINTS = (b"mrt_", b"<include", b"&#", b'type="$', b"type='$", b"\0")


class Turn:
    """A lock that a thread may take several times, and that is free in a process forked by another thread.

    Taken by ``with turn.lock``: an interrupt cannot come between taking it and knowing that it must be given
    back, as it can in a method in Python.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        os.register_at_fork(after_in_child=self._forked)

    def _forked(self) -> None:
        if self.lock.acquire(blocking=False):
            self.lock.release()
        else:  # the thread that holds it is not in this process
            self.lock = threading.RLock()


#: taken while Mitsuba is set up, and while it renders what this project made: there, neither it nor Dr.Jit is
#: safe with several Python threads
one_at_a_time = Turn()


# ----------------------------------------------- The list ----------------------------------------------


class Replacement(NamedTuple):
    """A function that was put in place of one of Mitsuba's."""

    owner: Any  # the module or class that has it
    name: str
    theirs: Function
    ours: Function
    inherited: bool  # had the owner the function from a base class

    def undo(self) -> bool:
        """Take the function back; False where somebody else has put something around it."""
        alone = getattr(self.owner, self.name) is self.ours
        if alone and self.inherited:
            delattr(self.owner, self.name)
        elif alone:
            setattr(self.owner, self.name, self.theirs)
        return alone


@dataclass
class Change:
    """A function of Mitsuba's that is replaced."""

    where: str  #: as users call it, such as "mi.render"
    ours: Function  #: what is called in its place: with the function itself, then its arguments
    what: str
    why: str
    made: list[Replacement] = field(default_factory=list)  #: in the variants so far

    def make(self) -> None:
        """Put our function in place where it is not, in the current variant."""
        _, *path, name = self.where.split(".")
        owner = reduce(getattr, path, mi)
        theirs = getattr(owner, name)
        own = {id(each.ours) for each in self.made}
        with contextlib.suppress(ValueError):  # what has itself, or ever more functions, inside of it
            if id(inspect.unwrap(theirs, stop=lambda function: id(function) in own)) in own:
                return

        @wraps(theirs)
        def call(*args: object, **given: object) -> object:
            return self.ours(theirs, *args, **given) if _in_effect else theirs(*args, **given)

        with contextlib.suppress(ValueError, TypeError):  # functions in C++ have none
            call.__signature__ = inspect.signature(theirs)  # type: ignore[attr-defined]
        owners = [owner]
        home = sys.modules.get(getattr(theirs, "__module__", None) or "")  # which it is pickled by
        if inspect.ismodule(owner) and getattr(home, name, None) is theirs:
            owners.append(home)
        for each in owners:
            self.made.append(Replacement(each, name, theirs, call, inherited=name not in vars(each)))
            setattr(each, name, call)

    def undo(self) -> None:
        """Take our functions back; those inside of somebody else's only pass calls on."""
        self.made = [each for each in self.made if not each.undo()]


CHANGES: list[Change] = []
_in_effect = _watching = False


def change(where: str, *, what: str, why: str) -> Callable[[Function], Function]:
    """Put a change into ``CHANGES``, by the function that is called in place of Mitsuba's."""

    def add(ours: Function) -> Function:
        CHANGES.append(Change(where, ours, what, why))
        return ours

    return add


def _argument(place: int, name: str, args: tuple[Any, ...], given: dict[str, Any]) -> Any:
    """An argument of one of Mitsuba's functions; None where it is missing, which Mitsuba reports."""
    return args[place] if place < len(args) else given.get(name)


# ------------------------------------------- Rendering in turn -----------------------------------------


def of_this_package(thing: object) -> bool:
    """Whether this package has the class of an object."""
    return type(thing).__module__.startswith("mrt_mitsuba.")


def needs_turn(scene: mi.Scene, integrator: mi.Integrator) -> bool:
    """Whether a render runs Python code of ours, and none of somebody else's that may wait for it."""
    if of_this_package(integrator):
        return True
    if not plugins.any_constructed() or not isinstance(integrator, mi.Integrator):
        return False
    inside = mi.traverse(integrator).hierarchy  # aov renders with others
    if not all(plugins.is_known(each) for each in inside if isinstance(each, mi.Integrator)):
        return False
    shapes = scene.shapes()
    materials = [shape.bsdf() for shape in shapes]
    direct = (*scene.emitters(), *shapes, *materials, *scene.sensors())
    # A texture, say, in a material of Mitsuba's
    return any(map(of_this_package, direct)) or any(map(of_this_package, mi.traverse(scene).hierarchy))


@change(
    "mi.render",
    what="renders scenes with plugins of this project one after the other, and passes Ctrl-C on",
    why="two threads that trace plugins in Python at once end the process; Dr.Jit turns a Ctrl-C in an "
    "integrator in Python into a RuntimeError",
)
def render_in_turn(render: Function, /, *args: object, **given: object) -> object:
    scene = _argument(0, "scene", args, given)
    integrator = _argument(3, "integrator", args, given)
    if not isinstance(scene, mi.Scene) or not needs_turn(scene, integrator or scene.integrator()):
        return render(*args, **given)
    with one_at_a_time.lock:
        try:
            return render(*args, **given)
        except RuntimeError as error:
            if interrupt := interrupt_behind(error):
                raise interrupt from None
            raise


@change(
    "mi.SceneParameters.__setitem__",
    what="waits while such a scene is rendered",
    why="a change in the midst of a render ends the process",
)
def set_in_turn(setitem: Function, /, *args: object, **given: object) -> object:
    with one_at_a_time.lock:
        return setitem(*args, **given)


@change(
    "mi.SceneParameters.update",
    what="waits while such a scene is rendered, and notes what was updated",
    why="numbers may have been written where they lie, which no array shows",
)
def update_in_turn(update: Function, /, *args: object, **given: object) -> list[tuple[mi.Object, set[str]]]:
    with one_at_a_time.lock:
        updated = update(*args, **given)
        parameters = _argument(0, "self", args, given)
        changed = dict(updated) if plugins.any_constructed() else {}
        # What contains an object whose own parameters were updated is updated, too
        for key, (_, _, node, _) in parameters.properties.items() if changed else ():
            if key.rsplit(".", 1)[-1] in changed.get(node, ()):
                updates.note(node)
        return updated


# ----------------------------------------------- Loading -----------------------------------------------


class TwoThreads:
    """Lets Dr.Jit have two threads at least: with one, Mitsuba waits for the EXR files it reads for ever.

    Blocks may overlap: one that needs a second thread sets it, and the last that leaves takes it back.
    """

    def __init__(self) -> None:
        self._forget()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        self._lock = threading.Lock()
        self._blocks = 0  # that have been entered and not left
        self._raised = False

    def __enter__(self) -> None:
        with self._lock:
            self._blocks += 1
            if dr.thread_count() == 1:
                self._raised = True
                dr.set_thread_count(2)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0 and self._raised:
                self._raised = False
                if dr.thread_count() == 2:
                    dr.set_thread_count(1)


two_threads = TwoThreads()


def dict_is_ours(scene: object) -> bool:
    """Whether a dict has a plugin of ours."""
    waiting = [scene]
    seen = set[int]()  # a dict may lie in itself
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict) and id(node) not in seen:
            seen.add(id(node))
            if str(node.get("type", "")).startswith("mrt_"):
                return True
            waiting += node.values()
    return False


def text_is_ours(text: object) -> bool:
    """Whether XML may have a plugin of ours."""
    return isinstance(text, str) and any(hint.decode() in text for hint in HINTS)


def file_is_ours(path: Any) -> bool:
    """Whether an XML file may have a plugin of ours."""
    # Mitsuba itself reports what cannot be read. What is no file, such as a pipe, can be read only once
    with contextlib.suppress(OSError, ValueError, TypeError):
        name = str(mi.file_resolver().resolve(os.fspath(path)))
        state = os.stat(name)
        if not stat.S_ISREG(state.st_mode) or state.st_size > LARGEST_SEARCHED:
            return True
        with open(name, "rb") as file:
            text = file.read(state.st_size)
        return any(hint in text for hint in HINTS)
    return False


def _loading(where: str, source: str, is_ours: Callable[[Any], bool]) -> Change:
    """The change of a loader, whose first parameter is ``source``."""

    def load_in_turn(load: Function, /, *args: object, **given: object) -> object:
        if len(args) < 2 and "parallel" not in given:
            values = [value for name, value in given.items() if name not in (source, "optimize")]
            parameters_are_ours = any("mrt_" in str(value) for value in values)
            if parameters_are_ours or is_ours(_argument(0, source, args, given)):
                given["parallel"] = False
        with two_threads:
            return load(*args, **given)

    return Change(
        where,
        load_in_turn,
        what="loads scenes with plugins of this project one object at a time, unless parallel= is given",
        why="Mitsuba's parallel loader overflows the stack, or crashes, with hundreds of objects in Python",
    )


CHANGES.append(_loading("mi.load_dict", "dict", dict_is_ours))
CHANGES.append(_loading("mi.load_string", "value", text_is_ours))
CHANGES.append(_loading("mi.load_file", "path", file_is_ours))


# -------------------------------------------- Light tracing --------------------------------------------


@change(
    "mi.AdjointIntegrator.render",
    what="refuses scenes with mrt_light",
    why="the light cannot do so itself: Dr.Jit calls its methods for scenes that have none, too",
)
def refuse_light_tracing(render: Function, /, *args: object, **given: object) -> object:
    scene = _argument(1, "scene", args, given)
    kind = plugins.plugin("light").MrtLight
    names = {row.class_name: row.name for row in plugins.PLUGINS}
    for light in scene.emitters() if isinstance(scene, mi.Scene) else ():
        if isinstance(light, kind):
            name = type(light).__name__
            raise NotImplementedError(
                f"{names.get(name, name)}: light tracing needs a finite emitted power; use a stock 'point' "
                "light"
            )
    return render(*args, **given)


# --------------------------------------------- Putting in effect ---------------------------------------


def make() -> None:
    """Put all changes into effect, also in variants that are switched to later. Idempotent."""
    global _in_effect, _watching
    _in_effect = True
    if not _watching:
        _watching = True
        mi.detail.add_variant_callback(lambda old, new: make() if _in_effect else None)
    for change in CHANGES:
        change.make()


def undo() -> None:
    """Take all changes back, in all variants."""
    global _in_effect
    _in_effect = False
    for change in CHANGES:
        change.undo()


# --------------------------------------------- While it starts -----------------------------------------


@contextlib.contextmanager
def rewriting_later() -> Iterator[None]:
    """Let functions under ``@dr.syntax`` be rewritten when they are first called.

    Mitsuba has ten of them, in integrators for derivatives; to rewrite them takes 60 ms of each start.
    """
    rewrite = dr.syntax

    def later(function: Function | None = None, **options: object) -> Function:
        if function is None or options:
            return rewrite(function, **options)

        @cache
        def rewritten() -> Function:
            return rewrite(function)

        @wraps(function)
        def call(*args: object, **given: object) -> object:
            return rewritten()(*args, **given)

        return call

    dr.syntax = later
    try:
        yield
    finally:
        dr.syntax = rewrite


def mitsuba_first(folder: str | None = None) -> None:
    """Let Mitsuba find its own plugins before files of their names in ``folder`` and others."""
    current = mi.file_resolver()
    others = [str(current[i]) for i in range(len(current))]
    resolver = mi.FileResolver()
    resolver.clear()
    for each in dict.fromkeys([mitsuba_home(), *([folder] if folder else []), *others]):
        resolver.append(each)
    mi.set_file_resolver(resolver)


@cache
def mitsuba_home() -> str:
    """The folder in which Mitsuba is installed."""
    return os.path.dirname(os.path.abspath(mi.__file__))
