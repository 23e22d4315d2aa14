"""The pixels of one picture as flat Dr.Jit arrays, in the backend of the current variant."""

from __future__ import annotations

import functools
import importlib
import math
import operator
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from mrt_mitsuba import llvm
from mrt_mitsuba.errors import UsageError

if TYPE_CHECKING:
    from mitsuba import Float, Int, Mask

    Array: TypeAlias = Any  # [H, W, ...]: what NumPy makes an array of
    Add = Callable[[Int, Sequence[Float]], Sequence[Float]]


class Grid:
    """A picture's pixels row by row, top row first, and the arrays to compute with.

    A filter writes its maths once over these flat arrays: the JIT backends fuse it into kernels, and
    ``drjit.scalar`` runs the same operations one after the other.

    The backend is that of the current Mitsuba variant, or without one LLVM where that works and else
    ``drjit.scalar``.

    Sizes, and the options of filters, are opaque to Dr.Jit: a new value makes no new kernel.
    """

    def __init__(self, image: Array) -> None:
        shape = np.shape(image)
        if len(shape) < 2:
            raise UsageError(f"image has shape {shape}; expected [rows, columns] or more")
        mitsuba = sys.modules.get("mitsuba")
        if mitsuba and mitsuba.variant():
            backend = mitsuba.variant().partition("_")[0]
        else:
            backend = "scalar" if llvm.problem(llvm.prepare()) else "llvm"
        self.Float: Any = dr.array_t(importlib.import_module(f"drjit.{backend}").TensorXf)
        self.Int: Any = dr.int32_array_t(self.Float)
        self.Bool: Any = dr.mask_t(self.Float)
        self.rows, self.columns = shape[:2]
        self.count = self.rows * self.columns
        self.size = dr.opaque(self.Int, self.count)
        self.height = dr.opaque(self.Int, self.rows)
        self.width = dr.opaque(self.Int, self.columns)
        self.index = dr.arange(self.Int, self.count)

    def flat(self, array: Array, channels: Sequence[int], name: str) -> Float:
        """An array of shape [rows, columns, *channels] as a flat float32 array of this backend.

        Raises ``UsageError`` under the name ``name`` if the shape is another one.
        """
        shape = (self.rows, self.columns, *channels)
        if np.shape(array) != shape or self.count == 0:
            expected = "at least one pixel" if 0 in shape else f"[{', '.join(map(str, shape))}]"
            raise UsageError(f"{name} has shape {np.shape(array)}; expected {expected}")
        return self.Float(np.ascontiguousarray(array, dtype=np.float32).ravel())

    def planes(self, array: Array, name: str) -> list[Float]:
        """An array [rows, columns, 3] as three flat planes."""
        flat = self.flat(array, (3,), name)
        return [dr.gather(self.Float, flat, 3 * self.index + channel) for channel in range(3)]

    def coordinates(self, index: Int) -> tuple[Int, Int]:
        """Column and row of pixels given by their index."""
        row = index // self.width
        return index - row * self.width, row

    def accumulate(self, count: Int | int, totals: Sequence[Float], add: Add) -> Sequence[Float]:
        """``totals`` after ``totals = add(j, totals)`` for j from 0 to ``count − 1``.

        One loop inside the kernel, so that its length makes no new kernel and its text stays short;
        ``drjit.scalar`` has no kernels and loops here. Where ``count`` is an array, ``add`` leaves out what
        is beyond it.
        """
        if not dr.is_jit_v(self.Float):
            for j in range(count if isinstance(count, int) else int(dr.max(count))):
                totals = add(j, totals)
            return totals
        end = dr.opaque(self.Int, count) if isinstance(count, int) else count

        def is_before_end(j: Int, *_: Float) -> Mask:
            return j < end

        def advance(j: Int, *totals: Float) -> tuple[Any, ...]:
            return j + 1, *add(j, totals)

        _, *sums = dr.while_loop((self.Int(0), *totals), is_before_end, advance)
        return sums

    def output(self, planes: Sequence[Float | Mask], channels: Sequence[int] = ()) -> np.ndarray:
        """Planes as one NumPy array [rows, columns, *channels].

        ``planes``: one plane of numbers or truth values, or several to be interleaved.
        """
        values = np.stack([np.array(plane) for plane in planes], axis=-1)
        return values.reshape(self.rows, self.columns, *channels)


def check_numbers(**options: float) -> None:
    """Raise ``UsageError`` for an option that is NaN."""
    for name, value in options.items():
        if math.isnan(value):
            raise UsageError(f"{name} is not a number; give one")


def finite(planes: Sequence[Float]) -> Mask:
    """The pixels at which all of several planes are finite, as a mask."""
    return functools.reduce(operator.and_, map(dr.isfinite, planes))


def window_means(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the means [..., H, W] over square windows of ``reach`` pixels, a power of two, to each side.

    Windows are clipped at the border. Sums are formed by doubling, so that no differences cancel.
    """
    rows, columns = values.shape[-2:]
    wide = np.zeros((*values.shape[:-2], rows + 2 * reach, columns + 2 * reach), values.dtype)
    wide[..., reach:-reach, reach:-reach] = values
    for count in (columns, rows):  # along rows, then, turned, along columns
        sums = wide
        step = 1
        while step <= reach:
            sums = sums[..., :-step] + sums[..., step:]
            step *= 2
        wide = (sums[..., :count] + wide[..., 2 * reach :]).swapaxes(-2, -1)
    return wide / window_counts((rows, columns), reach).astype(values.dtype)


def window_counts(shape: tuple[int, ...], reach: int) -> np.ndarray:
    """Number of pixels of a picture in the window of ``reach`` pixels around each, [H, W]."""
    return np.outer(*(_window_sizes(count, reach) for count in shape))


def _window_sizes(count: int, reach: int) -> np.ndarray:
    """Number of pixels of a line within ``reach`` of each, itself included."""
    before = np.minimum(np.arange(count), reach)
    return before + before[::-1] + 1


def dilated(mask: np.ndarray, reach: int) -> np.ndarray:
    """A mask dilated by ``reach`` pixels along both axes."""
    for count in mask.shape[:-3:-1]:  # along rows, then, turned, along columns
        wide = np.pad(mask, [(0, 0)] * (mask.ndim - 1) + [(reach, reach)])
        near = (wide[..., step : step + count] for step in range(2 * reach + 1))
        mask = functools.reduce(np.logical_or, near).swapaxes(-2, -1)
    return mask
