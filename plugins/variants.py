"""What differs between Mitsuba's scalar and vectorised variants, and what its objects do not say."""

from __future__ import annotations

import drjit.scalar
import mitsuba as mi


def is_jit() -> bool:
    """Is the current variant a vectorised one (LLVM or CUDA)?"""
    return not mi.variant().startswith("scalar")


def pointer(kind: str, objects):
    """A Dr.Jit pointer array (``kind`` "Shape", "Emitter", ...) to objects; scalar variants have none: the
    objects."""
    return getattr(mi, kind + "Ptr")(objects) if is_jit() else objects


def first(value) -> float:
    """The first entry of a Dr.Jit array, or the number itself, as a Python float."""
    return float(value) if isinstance(value, float) else float(value[0])


def updatable(number: float):
    """A plugin parameter in a form that ``mi.traverse`` can update; scalar variants cannot update Python
    floats."""
    return mi.Float(number) if is_jit() else drjit.scalar.Array1f64(number)


def but_not(mask, excluded):
    """``mask & ~excluded``; on a Python bool, ~ gives a number."""
    return mask & ~excluded if is_jit() else mask and not excluded


def varies(texture) -> bool:
    """Is a texture not the same everywhere? Mitsuba's ``mesh_attribute`` denies it, and needs a shape."""
    return texture.is_spatially_varying() or texture.class_name() == "MeshAttribute"
