"""Tables of numbers in kernels, looked up by index or by shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..variants import is_jit


def aligned(values: np.ndarray, kind: type = np.float32) -> mi.Float:
    """Return numbers as a flat array, of float32 or uint32, at a multiple of 64 bytes.

    Dr.Jit uses arrays of numpy where they lie, and most lie elsewhere. Only from aligned ones does a kernel
    read several numbers in a row in one go, which makes one that searches a tree half as fast again; and both
    kernels would be compiled and kept.
    """
    size = np.size(values)
    room: np.ndarray = np.empty(size + 16, kind)
    start = -room.ctypes.data % 64 // 4
    place = room[start : start + size]
    place[:] = np.ravel(values)
    return mi.Float(place) if kind is np.float32 else mi.UInt32(place)


def shape_ids(shapes: Sequence[mi.Shape]) -> mi.UInt32 | Sequence[mi.Shape]:
    """Return Dr.Jit's numbers of shapes for ``shape_at``; in scalar variants, the shapes.

    If a recorded kernel reads pointers instead, Dr.Jit looks at all objects of all scenes at each launch.
    """
    if not is_jit():
        return shapes
    ids = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shapes))
    dr.eval(ids)
    return ids


def shape_at(ids: mi.UInt32 | Sequence[mi.Shape], index: mi.UInt32, active: mi.Bool) -> mi.ShapePtr:
    """Return one of the shapes that were given to ``shape_ids``, by index."""
    if not is_jit():
        return ids[index]
    return dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, ids, index, active))


class Table:
    """Numbers of a type of Mitsuba's, [n], [n, width] or [n, parts, width], looked up by index and part."""

    def __init__(self, kind: type, numbers: Sequence | np.ndarray) -> None:
        rows = np.array(numbers)
        self.kind = kind
        self.parts = rows.shape[1] if rows.ndim == 3 else 1
        self.rows: Any
        if is_jit():
            self.rows = aligned(rows, np.uint32 if kind is mi.UInt32 else np.float32)
        else:
            width = rows.shape[-1] if rows.ndim > 1 else 1
            self.rows = [kind(*row) for row in rows.reshape(-1, width).tolist()]

    def __call__(self, index: mi.UInt32, active: mi.Bool, part: int = 0) -> Any:
        place = index * self.parts + part
        if not is_jit():
            return self.rows[place if active else 0]
        return dr.gather(self.kind, self.rows, place, active)


class ByShape:
    """Numbers for each of some shapes, looked up for the one that was hit; ``fallback`` for others.

    In vectorised variants, they may have parts, as in a ``Table``.
    """

    def __init__(
        self, kind: type, shapes: Sequence[mi.Shape], rows: Sequence, fallback: float | list[float]
    ) -> None:
        self.fallback = kind(fallback)
        if not is_jit():
            self.rows = {s: kind(row) for s, row in zip(shapes, rows, strict=True)}
            return
        ids = np.array(shape_ids(shapes))
        numbers = np.empty((ids.max() + 1, *np.shape(rows)[1:]), np.float32)
        numbers[:] = fallback
        numbers[ids] = rows
        self.table = Table(kind, numbers)
        self.size = dr.opaque(mi.UInt32, len(numbers))
        dr.make_opaque(self.fallback)

    def __call__(self, si: mi.SurfaceInteraction3f, active: mi.Bool, part: int = 0) -> Any:
        if not is_jit():
            return self.rows.get(si.shape, self.fallback) if active else self.fallback
        ids = dr.reinterpret_array(mi.UInt32, si.shape)
        known = active & (ids < self.size)
        return dr.select(known, self.table(ids, known, part), self.fallback)
