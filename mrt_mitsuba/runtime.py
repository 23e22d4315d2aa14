"""Start-up of Mitsuba: which variant, which LLVM, and the plugins registered in it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cache

import drjit as dr
import mitsuba as mi

from mrt_mitsuba import llvm, mitsuba_changes, plugins
from mrt_mitsuba.errors import UsageError, VariantError, warn
from mrt_mitsuba.interrupts import defer_signals
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.mitsuba_changes import render_lock
from mrt_mitsuba.plugins import Plugin

FAST = "llvm_ad_rgb"
SLOW = "scalar_rgb"

#: the plugins of adaptive sampling
ADAPTIVE = (
    Plugin("mrt_adaptive", "integrator", "MrtAdaptive", "integrator", "mrt_mitsuba.adaptive"),
    Plugin("mrt_rays", "samplers", "RaySampler", "sampler", "mrt_mitsuba.adaptive"),
    Plugin("mrt_sequence", "samplers", "PixelSequence", "sampler", "mrt_mitsuba.adaptive"),
)

_warned = False  # that variants are slow
_used: str | None = None  # the variant that was made current last
_guard = True  # is Mitsuba to be changed


def use(variant: str | None = None) -> str:
    """Make a Mitsuba variant current, with the plugins registered in it, and return its name.

    Without a name, the variant that is already set stays; where none is set, it is ``llvm_ad_rgb``, or
    ``scalar_rgb`` with one warning where LLVM cannot be used.

    Raises ``UsageError`` for a name that this Mitsuba does not know, and ``VariantError`` for one
    that cannot run here.
    """
    global _used
    if _used and variant in (None, _used) and mi.variant() == _used:
        return _used
    quickly = mitsuba_changes.rewriting_later() if _guard else contextlib.nullcontext()
    with render_lock, defer_signals(), quickly:
        if variant is None:
            variant = mi.variant() or default_variant()
        elif variant not in mi.variants():
            raise UsageError(f"unknown variant {variant!r}: this Mitsuba has {', '.join(mi.variants())}")
        if problem := obstacle(variant):
            raise VariantError(f"the variant {variant} cannot be used: {problem}")
        if mi.variant() != variant:
            mi.set_variant(variant)
            # Dr.Jit does not look at quotas of control groups; two at least: Mitsuba 3.9 reads EXR
            # files in a second thread, and deadlocks without one
            if dr.thread_count() > (threads := max(usable_cores(), 2)):
                dr.set_thread_count(threads)
        if _guard:
            mitsuba_changes.mitsuba_first()
            mitsuba_changes.apply_patches()
        plugins.register()
        plugins.register(ADAPTIVE)
        _used = variant
    return variant


@contextlib.contextmanager
def within(variant: str) -> Iterator[None]:
    """Make a variant current for a block."""
    before = mi.variant()
    use(variant)
    try:
        yield
    finally:
        use(before)


def register(guard: bool = True) -> None:
    """Register the plugins with Mitsuba, so that ``mi.load_dict`` and ``mi.load_file`` know them.

    They follow every later switch of the variant. Where no variant is set yet, the default one is.

    ``guard``: apply the patches in ``mrt_mitsuba.mitsuba_changes.PATCHES`` to how Mitsuba loads, renders and
    updates, for scenes with these plugins. With False, nothing of Mitsuba is changed, and earlier changes are
    taken back, until the next ``register()``: then such scenes must be loaded with ``parallel=False`` and
    used by one thread, and numbers that are written where they lie are not noticed.
    """
    global _used, _guard
    _used = None  # also where a caller has taken them out since
    _guard = guard
    if not guard:
        mitsuba_changes.undo_patches()
    use()


def default_variant() -> str:
    """``llvm_ad_rgb`` if LLVM works here, else ``scalar_rgb`` with one warning per process."""
    global _warned
    problem = obstacle(FAST)
    if problem and not _warned:
        _warned = True
        warn(f"rendering in the slow variant {SLOW}: {problem}")
    return SLOW if problem else FAST


def obstacle(variant: str) -> str | None:
    """The reason that keeps a known variant from running here, with the fix, or None."""
    if variant.startswith("llvm"):
        return llvm.problem(llvm.prepare())
    if not variant.startswith("cuda"):
        return None
    none = f"it needs an NVIDIA GPU with its driver, and none was found. Use {FAST} or {SLOW}."
    return None if dr.has_backend(dr.JitBackend.CUDA) else none


def usable_variants() -> list[str]:
    """The variants of this Mitsuba that can run here."""
    return [variant for variant in mi.variants() if obstacle(variant) is None]


@cache
def versions() -> dict[str, str]:
    """The versions of all that decides about pixels, by name."""
    from mrt_mitsuba import __version__

    version = llvm.prepare().version
    return {
        "mrt-mitsuba": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, version)) if version else "of unknown version",
    }
