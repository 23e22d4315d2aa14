"""What this package changes in Mitsuba: ``CHANGES`` lists each change with its reason.

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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, wraps
from typing import Any

import drjit as dr
import mitsuba as mi

from mrt_mitsuba import plugins
from mrt_mitsuba.interrupts import interrupt_behind
from mrt_mitsuba.plugins.snapshot import updates

Function = Callable[..., Any]

# Files are searched for our plugins up to this size; larger ones are taken to have some
LARGEST_SEARCHED = 2**26  # bytes

# What an XML file has that names a plugin of ours, or may do so in a way that a search does not see: another
# file, an escaped letter, a parameter, an encoding of several bytes for a letter
HINTS = (b"mrt_", b"<include", b"&#", b'type="$', b"type='$", b"\0")


class Turn:
    """A lock that a thread may take several times, and that is free in a process forked by another thread."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._mine = threading.local()
        os.register_at_fork(after_in_child=self._forked)

    def __enter__(self) -> None:
        self._lock.acquire()
        self._mine.count = getattr(self._mine, "count", 0) + 1

    def __exit__(self, *_: object) -> None:
        self._mine.count -= 1
        self._lock.release()

    def _forked(self) -> None:
        if not getattr(self._mine, "count", 0):  # the thread that has it, if any, is not in this process
            self._lock = threading.RLock()


#: taken while Mitsuba is set up, and while it renders what this project made: there, neither it nor Dr.Jit is
#: safe with several Python threads
one_at_a_time = Turn()


# ------------------------------------------- Rendering in turn -----------------------------------------


def is_ours(thing: object) -> bool:
    """Return whether this package has the class of an object."""
    return type(thing).__module__.startswith("mrt_mitsuba.")


def _needs_turn(scene: mi.Scene, integrator: mi.Integrator | None) -> bool:
    """Return whether a render runs Python code of ours, and none of somebody else's that may wait for it."""
    integrator = integrator or scene.integrator()
    if is_ours(integrator):
        return True
    if not plugins.any_constructed() or not plugins.is_known(integrator):
        return False
    shapes = scene.shapes()
    materials = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in shapes)}
    direct = (*scene.emitters(), *shapes, *materials.values(), *scene.sensors())
    # A texture, say, in a material of Mitsuba's
    return any(map(is_ours, direct)) or any(map(is_ours, mi.traverse(scene).hierarchy))


def _render_in_turn(render: Function) -> Function:
    parameters = list(inspect.signature(render).parameters)

    def call(*args: Any, **given: Any) -> Any:
        named = dict(zip(parameters, args, strict=False)) | given
        scene, integrator = named.get("scene"), named.get("integrator")
        if not isinstance(scene, mi.Scene) or not _needs_turn(scene, integrator):
            return render(*args, **given)
        with one_at_a_time:
            try:
                return render(*args, **given)
            except RuntimeError as error:
                if interrupt := interrupt_behind(error):
                    raise interrupt from None
                raise

    return call


def _change_in_turn(change: Function) -> Function:
    def call(*args: Any, **given: Any) -> Any:
        with one_at_a_time:
            return change(*args, **given)

    return call


def _update_in_turn(update: Function) -> Function:
    def call(parameters: mi.SceneParameters, *args: Any, **given: Any) -> Any:
        with one_at_a_time:
            updated = update(parameters, *args, **given)
            _note(parameters, dict(updated))
            return updated

    return call


def _note(parameters: mi.SceneParameters, updated: Mapping[mi.Object, set[str]]) -> None:
    """Take note of the objects whose own parameters were updated: what contains them is updated, too."""
    if updated and plugins.any_constructed():
        for key, (_, _, node, _) in parameters.properties.items():
            if key.rsplit(".", 1)[-1] in updated.get(node, ()):
                updates.note(node)


# ----------------------------------------------- Loading -----------------------------------------------


class TwoThreads:
    """Lets Dr.Jit have two threads at least: with one, Mitsuba waits for the EXR files it reads for ever.

    Blocks may overlap: the first that enters sets them, and the last that leaves takes them back.
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
            if self._blocks == 0:
                self._raised = dr.thread_count() == 1
            if self._raised and dr.thread_count() == 1:
                dr.set_thread_count(2)
            self._blocks += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0 and self._raised and dr.thread_count() == 2:
                dr.set_thread_count(1)


two_threads = TwoThreads()


def _load_in_turn(loader: Function, source: str, has_ours: Callable[[Any], bool]) -> Function:
    """``source``: the name of the loader's first parameter; ``has_ours``: may it have a plugin of ours."""

    def load(*args: Any, **given: Any) -> Any:
        what = args[0] if args else given.get(source)
        values = [value for name, value in given.items() if name not in (source, "parallel", "optimize")]
        free = len(args) < 2 and "parallel" not in given
        if free and (has_ours(what) or any("mrt_" in str(value) for value in values)):
            given = {**given, "parallel": False}
        with two_threads:
            return loader(*args, **given)

    return load


def _dict_has_ours(source: Any) -> bool:
    waiting, seen = [source], set[int]()  # a dict may lie in itself
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict) and id(node) not in seen:
            seen.add(id(node))
            if str(node.get("type", "")).startswith("mrt_"):
                return True
            waiting += node.values()
    return False


def _text_has_ours(source: Any) -> bool:
    return isinstance(source, str) and any(hint.decode() in source for hint in HINTS)


def _file_has_ours(source: Any) -> bool:
    """Return whether a file of XML may have a plugin of ours: reads no more of it than tells.

    Mitsuba itself reports what cannot be read. What is no file, such as a pipe, can be read only once.
    """
    if not isinstance(source, str | os.PathLike):
        return False
    try:
        path = str(mi.file_resolver().resolve(os.fspath(source)))
        state = os.stat(path)
        if not stat.S_ISREG(state.st_mode) or state.st_size > LARGEST_SEARCHED:
            return True
        with open(path, "rb") as file:
            text = file.read(state.st_size)
    except (OSError, ValueError, TypeError):
        return False
    return any(hint in text for hint in HINTS)


# -------------------------------------------- Light tracing --------------------------------------------


def _refuse_light_tracing(render: Function) -> Function:
    def call(integrator: mi.Integrator, scene: mi.Scene, *args: Any, **given: Any) -> Any:
        kind = plugins.plugin("light").MrtLight
        for light in scene.emitters():
            if isinstance(light, kind):
                raise NotImplementedError(
                    f"{_name_of(light)}: light tracing needs a finite emitted power; use a stock 'point' "
                    "light"
                )
        return render(integrator, scene, *args, **given)

    return call


def _name_of(thing: object) -> str:
    rows = [row.name for row in plugins.PLUGINS if row.class_name == type(thing).__name__]
    return rows[0] if rows else type(thing).__name__


# ----------------------------------------------- The list ----------------------------------------------


@dataclass(frozen=True)
class Replacement:
    """A function that was put in place of one of Mitsuba's."""

    owner: Any
    name: str
    before: Function
    ours: Function
    inherited: bool  # had the owner the function from a base class


@dataclass
class Change:
    """Functions of Mitsuba's that are replaced."""

    where: str  #: as users call it
    names: tuple[str, ...]  #: of the functions
    owner: Callable[[], Any]  #: what has them, in the current variant
    around: Callable[[Function], Function]  #: makes the function in place of Mitsuba's
    what: str
    why: str
    since: str = "Mitsuba 3.9"  #: the first release that needs it, as far as is known
    #: the functions that were put in place, by owner and name, with what they are around
    made: list[Replacement] = field(default_factory=list)

    def make(self) -> None:
        """Put the functions in place where they are not."""
        owner = self.owner()
        for name in self.names:
            present = getattr(owner, name)
            if self._contains_ours(present):
                continue
            ours = _disguised(self.around(present), present)
            self.made.append(Replacement(owner, name, present, ours, inherited=name not in vars(owner)))
            for each in (owner, _home(owner, name, present)):
                setattr(each, name, ours)

    def _contains_ours(self, function: Any) -> bool:
        own = {id(each.ours) for each in self.made}
        while function is not None:
            if id(function) in own:
                return True
            function = getattr(function, "__wrapped__", None)
        return False

    def undo(self) -> None:
        """Take the functions back; those that somebody else has put something around only pass calls on."""
        kept = []
        for each in reversed(self.made):
            home = _home(each.owner, each.name, each.before)
            if getattr(each.owner, each.name) is not each.ours:
                kept.append(each)
            elif each.inherited:
                delattr(each.owner, each.name)
            else:
                setattr(each.owner, each.name, each.before)
            if getattr(home, each.name) is each.ours:
                setattr(home, each.name, each.before)
        self.made = kept


def _home(owner: Any, name: str, function: Function) -> Any:
    """Return the module that a function of Mitsuba's is pickled by, or its owner."""
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    return module if module is not None and inspect.ismodule(owner) and hasattr(module, name) else owner


def _disguised(ours: Function, theirs: Function) -> Function:
    """Return a function that calls ours while the changes are in effect; all else about it is theirs."""

    @wraps(theirs)
    def call(*args: Any, **given: Any) -> Any:
        return (ours if _in_effect else theirs)(*args, **given)

    with contextlib.suppress(ValueError, TypeError):  # functions in C++ have none
        call.__signature__ = inspect.signature(theirs)  # type: ignore[attr-defined]
    return call


_in_effect = _watching = False


def _loader(name: str, source: str, has_ours: Callable[[Any], bool]) -> Change:
    return Change(
        where=f"mi.{name}",
        names=(name,),
        owner=lambda: mi,
        around=lambda loader: _load_in_turn(loader, source, has_ours),
        what="loads scenes with plugins of this project one object at a time, unless parallel= is given",
        why="Mitsuba's parallel loader overflows the stack, or crashes, with hundreds of objects in Python",
    )


CHANGES = (
    Change(
        where="mi.render",
        names=("render",),
        owner=lambda: mi,
        around=_render_in_turn,
        what="renders scenes with plugins of this project one after the other, and passes Ctrl-C on",
        why="two threads that trace plugins in Python at once end the process; Dr.Jit turns a Ctrl-C in an "
        "integrator in Python into a RuntimeError",
    ),
    Change(
        where="mi.SceneParameters.__setitem__",
        names=("__setitem__",),
        owner=lambda: mi.SceneParameters,
        around=_change_in_turn,
        what="waits while such a scene is rendered",
        why="a change in the midst of a render ends the process",
    ),
    Change(
        where="mi.SceneParameters.update",
        names=("update",),
        owner=lambda: mi.SceneParameters,
        around=_update_in_turn,
        what="waits while such a scene is rendered, and notes what was updated",
        why="numbers may have been written where they lie, which no array shows",
    ),
    _loader("load_dict", "dict", _dict_has_ours),
    _loader("load_file", "path", _file_has_ours),
    _loader("load_string", "value", _text_has_ours),
    Change(
        where="mi.AdjointIntegrator.render",
        names=("render",),
        owner=lambda: mi.AdjointIntegrator,
        around=_refuse_light_tracing,
        what="refuses scenes with mrt_light",
        why="the light cannot do so itself: Dr.Jit calls its methods for scenes that have none, too",
    ),
)


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

    def later(function: Function | None = None, **options: Any) -> Any:
        if function is None or options:
            return rewrite(function, **options)

        @cache
        def rewritten() -> Function:
            return rewrite(function)

        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
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
    """Return the folder in which Mitsuba is installed."""
    return os.path.dirname(os.path.abspath(mi.__file__))
