"""Start-up of Mitsuba: which variant, which LLVM, the plugins registered in it, and what is changed in how it
loads and renders."""

from __future__ import annotations

import contextlib
import difflib
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import cache, wraps
from typing import Any

import drjit as dr
import mitsuba as mi

from mrt_mitsuba import llvm, plugins
from mrt_mitsuba.errors import MrtWarning, UnknownVariantError, VariantError
from mrt_mitsuba.interrupts import held
from mrt_mitsuba.machine import usable_cores

FAST = "llvm_ad_rgb"
SLOW = "scalar_rgb"

# Held while Mitsuba is set up and while it renders: neither it nor Dr.Jit is safe with several Python threads
one_at_a_time = threading.RLock()

_warned = False  # that variants are slow
_used: str | None = None  # the variant that was made current last


def use(variant: str | None = None) -> str:
    """Make a Mitsuba variant current, with the plugins registered in it, and return its name.

    Without a name, the variant that is already set stays; if there is none, it is ``llvm_ad_rgb``, or
    ``scalar_rgb`` with one warning where LLVM cannot be used.

    Raises ``UnknownVariantError`` for a name that this Mitsuba does not know, and ``VariantError`` for one
    that cannot run here.
    """
    global _used
    if _used and variant in (None, _used) and mi.variant() == _used:
        return _used
    with one_at_a_time, held(), rewriting_later():
        if variant is None:
            variant = mi.variant() or default_variant()
        elif variant not in mi.variants():
            close, known = difflib.get_close_matches(variant, mi.variants(), n=1), ", ".join(mi.variants())
            hint = f" Did you mean {close[0]}?" if close else ""
            raise UnknownVariantError(f"unknown variant {variant!r}.{hint} This Mitsuba has {known}.")
        if problem := obstacle(variant):
            raise VariantError(f"the variant {variant} cannot be used: {problem}")
        if mi.variant() != variant:
            mi.set_variant(variant)
            # Dr.Jit does not look at quotas of control groups; two at least, see ``two_threads``
            if dr.thread_count() > (threads := max(usable_cores(), 2)):
                dr.set_thread_count(threads)
        mitsuba_first()
        one_by_one()
        plugins.register()
        plugins.register_modules("mrt_mitsuba.rays", ["samplers"])
        plugins.register_modules("mrt_mitsuba.rendering", ["adaptive"])
        _used = variant
    return variant


def register() -> None:
    """Register the plugins with Mitsuba, so that ``mi.load_dict`` and ``mi.load_file`` know them.

    They follow every later switch of the variant. Where no variant is set yet, the default one is.
    """
    global _used
    _used = None  # also where a caller has taken them out since
    use()


def default_variant() -> str:
    """Return ``llvm_ad_rgb`` if LLVM works here, else ``scalar_rgb`` with one warning per process."""
    problem = obstacle(FAST)
    if problem:
        _warn_once(f"rendering in the slow variant {SLOW}: {problem}")
    return SLOW if problem else FAST


def obstacle(variant: str) -> str | None:
    """Return why a known variant cannot run here, with the fix, or None if nothing speaks against it."""
    if variant.startswith("llvm"):
        return llvm.problem(llvm.prepare())
    if not variant.startswith("cuda"):
        return None
    none = f"it needs an NVIDIA GPU with its driver, and none was found. Use {FAST} or {SLOW}."
    return None if dr.has_backend(dr.JitBackend.CUDA) else none


def warn_if_slow() -> None:
    """Say once in a process that the current variant is slow, if it is."""
    if mi.variant().startswith("scalar"):
        _warn_once(
            f"{mi.variant()} traces one ray at a time in Python: use it for small pictures, else {FAST}"
        )


def _warn_once(text: str) -> None:
    global _warned
    if not _warned:
        _warned = True
        warnings.warn(text, MrtWarning, stacklevel=4)


def usable_variants() -> list[str]:
    """Return the variants of this Mitsuba that can run here."""
    return [variant for variant in mi.variants() if obstacle(variant) is None]


@cache
def versions() -> dict[str, str]:
    """Return the versions of what decides about pixels."""
    from mrt_mitsuba import __version__

    version = llvm.prepare().version
    return {
        "mrt-mitsuba": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, version)) if version else "of unknown version",
    }


# ------------------------------------- What is changed in Mitsuba --------------------------------------


@contextlib.contextmanager
def rewriting_later() -> Iterator[None]:
    """Let functions under ``@dr.syntax`` be rewritten when they are first called.

    Mitsuba has ten of them, in integrators for derivatives; to rewrite them takes 60 ms of each start.
    """
    rewrite = dr.syntax

    def later(function: Any = None, **options: Any) -> Any:
        if function is None or options:
            return rewrite(function, **options)
        rewritten = cache(lambda: rewrite(function))
        return wraps(function)(lambda *args, **given: rewritten()(*args, **given))

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


@contextlib.contextmanager
def two_threads() -> Iterator[None]:
    """Let Dr.Jit have two threads at least: with one, Mitsuba waits for the EXR files it reads for ever."""
    before = dr.thread_count()
    dr.set_thread_count(max(before, 2))
    try:
        yield
    finally:
        dr.set_thread_count(before)


@cache
def mitsuba_home() -> str:
    """Return the folder in which Mitsuba is installed."""
    return os.path.dirname(os.path.abspath(mi.__file__))


def one_by_one() -> None:
    """Let Mitsuba's loaders make this project's objects one by one, and ``mi.render`` and changes by
    ``mi.traverse`` wait for each other: done at once, either ends the process.

    Light tracing refuses ``mrt_light``, which cannot do so itself: Dr.Jit calls its methods for scenes that
    have none, too.

    Scenes without our plugins, and calls that say ``parallel``, load at once as before. Idempotent.
    """

    def in_turn(loader: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(loader)
        def load(source: Any, *flags: bool, **given: Any) -> Any:
            if not flags:
                given.setdefault("parallel", not _mentions_ours(source))
            with two_threads():
                return loader(source, *flags, **given)

        return load

    def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            with one_at_a_time:
                return function(*args, **given)

        return call

    def refusing(render: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(render)
        def call(integrator: Any, scene: Any, *args: Any, **given: Any) -> Any:
            if any(hasattr(emitter, "arriving") for emitter in scene.emitters()):
                raise NotImplementedError(
                    "mrt_light: light tracing needs a finite emitted power; use a stock 'point' light"
                )
            return render(integrator, scene, *args, **given)

        return call

    for wrapped, owner, names in (
        (guarded, mi, ("render",)),
        (refusing, mi.AdjointIntegrator, ("render",)),
        (guarded, mi.SceneParameters, ("update", "__setitem__")),
        (in_turn, mi, ("load_dict", "load_file", "load_string")),
    ):
        for name in names:
            if not hasattr(function := getattr(owner, name), "__wrapped__"):
                setattr(owner, name, wrapped(function))


def _mentions_ours(source: Any) -> bool:
    """Return whether a dict, or a file of XML or its text, may have a plugin of this project; Mitsuba itself
    refuses anything else, and reports files that cannot be read."""
    if isinstance(source, dict):  # as text, it would have Dr.Jit evaluate what lies in it
        waiting, seen = [source], set[int]()  # a dict may lie in itself
        while waiting:
            node = waiting.pop()
            if isinstance(node, dict) and id(node) not in seen:
                seen.add(id(node))
                if str(node.get("type", "")).startswith("mrt_"):
                    return True
                waiting += node.values()
        return False
    text = str(source)
    with contextlib.suppress(OSError, ValueError), open(text, encoding="utf-8", errors="ignore") as file:
        text = file.read()
    return "mrt_" in text or "<include" in text
