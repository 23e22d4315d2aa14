"""Patches of Mitsuba's functions that make our plugins safe in ``mi.render``, each with its reason.

``apply_patches()`` puts those in ``PATCHES`` into effect, ``undo_patches()`` takes them back;
``mrt.register(guard=False)`` leaves them out. Names, signatures and pickles of patched functions stay
Mitsuba's. Mitsuba 3.9 needs them.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache, reduce, wraps
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from mrt_mitsuba import plugins
from mrt_mitsuba.interrupts import defer_signals, interrupt_behind
from mrt_mitsuba.plugins.whitted.snapshot import updates

Function = Callable[..., Any]

# What an XML file has that names a plugin of ours, or may do so in a way that a search does not see: another
# file, or a parameter
HINTS = ("mrt_", "<include", 'type="$', "type='$")
SOURCES = ("dict", "value", "path")  # names of the first parameter of Mitsuba's loaders


#: held while Mitsuba is set up, and while it renders our plugins: there, neither it nor Dr.Jit is safe with
#: several Python threads
render_lock = threading.RLock()


# ----------------------------------------------- The list ----------------------------------------------


@dataclass
class Patch:
    """A function that replaces one of Mitsuba's."""

    where: str  #: as users call it, such as "mi.render"
    replacement: Function  #: called with the original function, then its arguments
    what: str
    why: str
    undo_steps: list[Callable[[], None]] = field(default_factory=list)

    def apply(self) -> None:
        """Replace the function in the current variant, unless it is replaced already."""
        _, *path, name = self.where.split(".")
        owner = reduce(getattr, path, mi)
        original = getattr(owner, name)
        replacement = self.replacement
        if getattr(original, "mrt_patch", "") == self.where:  # ours, or another's that wraps ours
            return

        @wraps(original)
        def call(*args: object, **given: object) -> object:
            return replacement(original, *args, **given) if _in_effect else original(*args, **given)

        call.mrt_patch = self.where  # type: ignore[attr-defined]
        with contextlib.suppress(ValueError, TypeError):  # functions in C++ have none
            call.__signature__ = inspect.signature(original)  # type: ignore[attr-defined]
        self._set(owner, name, call)
        home = sys.modules.get(getattr(original, "__module__", None) or "")  # by which it is pickled
        if inspect.ismodule(owner) and getattr(home, name, None) is original:
            self._set(home, name, call)

    def _set(self, owner: Any, name: str, call: Function) -> None:
        inherited = name not in vars(owner)
        original = getattr(owner, name)

        def undo() -> None:  # nothing where somebody else has wrapped it since
            if getattr(owner, name) is call:
                delattr(owner, name) if inherited else setattr(owner, name, original)

        self.undo_steps.append(undo)
        setattr(owner, name, call)

    def undo(self) -> None:
        """Restore Mitsuba's functions; a patch that somebody else has wrapped only passes calls on."""
        while self.undo_steps:
            self.undo_steps.pop()()


PATCHES: list[Patch] = []
_in_effect = _watching = False


def patch(where: str, *, what: str, why: str) -> Callable[[Function], Function]:
    """Put a patch into ``PATCHES``, by the function that is called in place of Mitsuba's."""

    def add(replacement: Function) -> Function:
        PATCHES.append(Patch(where, replacement, what, why))
        return replacement

    return add


def _argument(place: int, name: str, args: tuple[Any, ...], given: dict[str, Any]) -> Any:
    """Return an argument of one of Mitsuba's functions; None if it is missing, which Mitsuba reports."""
    return args[place] if place < len(args) else given.get(name)


# ------------------------------------------ Renders under a lock ---------------------------------------


def of_this_package(thing: object) -> bool:
    """True if this package has the class of an object."""
    return type(thing).__module__.startswith("mrt_mitsuba.")


def needs_lock(integrator: mi.Integrator) -> bool:
    """True if a render may run Python code of ours, and no third-party integrator that may wait for it."""
    if of_this_package(integrator):
        return True
    if not plugins.any_loaded() or not isinstance(integrator, mi.Integrator):
        return False
    inside = mi.traverse(integrator).hierarchy  # aov renders with others
    return all(plugins.is_known(each) for each in inside if isinstance(each, mi.Integrator))


@patch(
    "mi.render",
    what="renders scenes with plugins of this project one after the other, and passes Ctrl-C on",
    why="two threads that trace plugins in Python at once end the process; Dr.Jit turns a Ctrl-C in an "
    "integrator in Python into a RuntimeError",
)
def render_under_lock(render: Function, /, *args: object, **given: object) -> object:
    scene = _argument(0, "scene", args, given)
    integrator = _argument(3, "integrator", args, given)
    if not isinstance(scene, mi.Scene) or not needs_lock(integrator or scene.integrator()):
        return render(*args, **given)
    with render_lock:
        try:
            return render(*args, **given)
        except RuntimeError as error:
            if interrupt := interrupt_behind(error):
                raise interrupt from None
            raise


@patch(
    "mi.SceneParameters.__setitem__",
    what="waits while such a scene is rendered",
    why="a change in the midst of a render ends the process",
)
def set_under_lock(setitem: Function, /, *args: object, **given: object) -> object:
    with render_lock:
        return setitem(*args, **given)


@patch(
    "mi.SceneParameters.update",
    what="waits while such a scene is rendered, and notes what was updated",
    why="NumPy views can modify arrays in place, undetected",
)
def update_under_lock(
    update: Function, /, *args: object, **given: object
) -> list[tuple[mi.Object, set[str]]]:
    with render_lock:
        updated = update(*args, **given)
        parameters = _argument(0, "self", args, given)
        changed = dict(updated) if plugins.any_loaded() else {}
        # What contains an object whose own parameters were updated is updated, too
        for key, (_, _, node, _) in parameters.properties.items() if changed else ():
            if key.rsplit(".", 1)[-1] in changed.get(node, ()):
                updates[id(node)] += 1
        return updated


# ----------------------------------------------- Loading -----------------------------------------------


def dict_is_ours(scene: object) -> bool:
    """True if a dict has a plugin of ours."""
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


def xml_is_ours(source: Any) -> bool:
    """True if XML, or the file of this path, may have a plugin of ours."""
    texts = [source]
    with contextlib.suppress(OSError, ValueError, TypeError):  # Mitsuba itself reports what cannot be read
        path = str(mi.file_resolver().resolve(os.fspath(source)))
        if os.path.isfile(path):  # no device
            texts.append(Path(path).read_text(errors="ignore"))
    return any(hint in text for text in texts if isinstance(text, str) for hint in HINTS)


def load_serially(load: Function, /, *args: object, **given: object) -> object:
    source = args[0] if args else next((given[name] for name in SOURCES if name in given), None)
    values = [str(value) for name, value in given.items() if name not in SOURCES]  # of parameters
    ours = any("mrt_" in value for value in values) or dict_is_ours(source) or xml_is_ours(source)
    if ours and len(args) < 2:
        given.setdefault("parallel", False)
    with defer_signals() if ours else contextlib.nullcontext():
        return load(*args, **given)


for loader in ("mi.load_dict", "mi.load_string", "mi.load_file"):
    patch(
        loader,
        what="loads scenes with plugins of this project one object at a time, unless parallel= is given, and "
        "raises Ctrl-C afterwards",
        why="Mitsuba's parallel loader overflows the stack, or crashes, with hundreds of objects in Python, "
        "and turns a Ctrl-C in one into a RuntimeError",
    )(load_serially)


# -------------------------------------------- Light tracing --------------------------------------------


@patch(
    "mi.AdjointIntegrator.render",
    what="refuses scenes with mrt_light",
    why="the light cannot do so itself: Dr.Jit calls its methods for scenes that have none, too",
)
def refuse_light_tracing(render: Function, /, *args: object, **given: object) -> object:
    scene = _argument(1, "scene", args, given)
    kind = plugins.classes_of("mrt_light")
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


def apply_patches() -> None:
    """Put all patches into effect, also in variants that are switched to later. Idempotent."""
    global _in_effect, _watching
    _in_effect = True
    if not _watching:
        _watching = True
        mi.detail.add_variant_callback(lambda old, new: apply_patches() if _in_effect else None)
    for each in PATCHES:
        each.apply()


def undo_patches() -> None:
    """Take all patches back, in all variants."""
    global _in_effect
    _in_effect = False
    for each in PATCHES:
        each.undo()


# --------------------------------------------- While it starts -----------------------------------------


@contextlib.contextmanager
def rewriting_later() -> Iterator[None]:
    """Postpone ``@dr.syntax`` within the block until the decorated functions are first called.

    Mitsuba has ten of them, in integrators for derivatives; rewriting them takes 60 ms of each start.
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
    """Make Mitsuba search its own folder for plugins before ``folder`` and all others."""
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
