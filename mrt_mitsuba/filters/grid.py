"""The pixels of one picture as flat Dr.Jit arrays, in whichever backend is at hand."""

from __future__ import annotations

import functools
import importlib
import math
import operator
import sys
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import numpy as np

from mrt_mitsuba import llvm
from mrt_mitsuba.errors import UsageError


class Grid:
    """A picture's pixels row by row, top row first, and the arrays to compute with.

    A filter writes its maths once over these flat arrays: the JIT backends fuse it into kernels, and
    ``drjit.scalar`` runs the same operations one after the other.

    The backend is that of ``image`` if it is a Dr.Jit tensor. For anything else it is that of the current
    Mitsuba variant, or without one LLVM where that works and else ``drjit.scalar``.

    Sizes, and the options of filters, are opaque to Dr.Jit: a new value makes no new kernel.
    """

    def __init__(self, image: Any) -> None:
        shape = np.shape(image)
        if len(shape) < 2:
            raise UsageError(f"image has shape {shape}; expected [rows, columns] or more")
        if dr.is_tensor_v(image):
            name = {dr.JitBackend.LLVM: "llvm", dr.JitBackend.CUDA: "cuda"}.get(dr.backend_v(image), "scalar")
        elif variant := (mitsuba := sys.modules.get("mitsuba")) and mitsuba.variant():
            name = variant.partition("_")[0]
        else:
            name = "scalar" if llvm.problem(llvm.prepare()) else "llvm"
        self._tensor = importlib.import_module(f"drjit.{name}").TensorXf
        self._kind = type(image) if dr.is_tensor_v(image) else np.ndarray
        self.Float: Any = dr.array_t(self._tensor)
        self.Int: Any = dr.int32_array_t(self.Float)
        self.Bool: Any = dr.mask_t(self.Float)
        self.rows, self.columns = shape[:2]
        self.count = self.rows * self.columns
        self.size = dr.opaque(self.Int, self.count)
        self.height = dr.opaque(self.Int, self.rows)
        self.width = dr.opaque(self.Int, self.columns)
        self.index = dr.arange(self.Int, self.count)

    def flat(self, array: Any, channels: Sequence[int], name: str) -> Any:
        """Return an array of shape [rows, columns, *channels] as a flat float32 array of this backend.

        Raises ``UsageError`` under the name ``name`` if the shape is another one.
        """
        wanted = (self.rows, self.columns, *channels)
        if np.shape(array) != wanted or self.count == 0:
            expected = "at least one pixel" if 0 in wanted else f"[{', '.join(map(str, wanted))}]"
            raise UsageError(f"{name} has shape {np.shape(array)}; expected {expected}")
        if dr.is_tensor_v(array):
            return self._tensor(dr.detach(array, preserve_type=False)).array
        return self.Float(np.ascontiguousarray(array, dtype=np.float32).ravel())

    def planes(self, array: Any, name: str) -> list[Any]:
        """Return an array [rows, columns, 3] as three flat planes."""
        flat = self.flat(array, (3,), name)
        return [dr.gather(self.Float, flat, 3 * self.index + channel) for channel in range(3)]

    def coordinates(self, index: Any) -> tuple[Any, Any]:
        """Return column and row of pixels given by their index."""
        row = index // self.width
        return index - row * self.width, row

    def accumulate(
        self, count: Any, totals: Sequence[Any], add: Callable[[Any, Sequence[Any]], Sequence[Any]]
    ) -> Sequence[Any]:
        """Return ``totals`` after ``totals = add(j, totals)`` for j from 0 to ``count − 1``.

        One loop inside the kernel, so that its length makes no new kernel and its text stays short;
        ``drjit.scalar`` has no kernels and loops here. Where ``count`` is an array, ``add`` leaves out what
        is beyond it.
        """
        if not dr.is_jit_v(self.Float):
            for j in range(count if isinstance(count, int) else int(dr.max(count))):
                totals = add(j, totals)
            return totals
        end = dr.opaque(self.Int, count) if isinstance(count, int) else count
        return dr.while_loop(
            (self.Int(0), *totals), lambda j, *_: j < end, lambda j, *totals: (j + 1, *add(j, totals))
        )[1:]

    def output(self, planes: Sequence[Any], channels: Sequence[int] = ()) -> Any:
        """Return planes as one array [rows, columns, *channels] of the kind that the filter was given.

        ``planes``: one plane of numbers or truth values, or several to be interleaved.
        """
        flat = planes[0]
        if len(planes) > 1:
            flat = dr.empty(self.Float, len(planes) * self.count)
            for channel, plane in enumerate(planes):
                dr.scatter(flat, plane, len(planes) * self.index + channel)
        shape = (self.rows, self.columns, *channels)
        if self._kind is np.ndarray:
            return np.array(flat).reshape(shape)
        dr.eval(flat)
        kinds: tuple[Any, Any] = (self._tensor, dr.float32_array_t(self._kind))  # ours, the caller's
        ours, theirs = map(dr.mask_t, kinds) if dr.is_mask_v(flat) else kinds
        return theirs(ours(flat, shape))


def check_numbers(**options: float) -> None:
    """Raise ``UsageError`` for an option that is NaN."""
    for name, value in options.items():
        if math.isnan(value):
            raise UsageError(f"{name} is not a number; give one")


def finite(planes: Sequence[Any]) -> Any:
    """Return where all of several planes hold finite numbers."""
    return functools.reduce(operator.and_, map(dr.isfinite, planes))


def window_means(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the means over windows of ``reach`` pixels, a power of two, to each side.

    Sums of 1, 2, 4, ... neighbours are each formed of the last ones, without differences that would cancel.
    """
    shape = values.shape[-2:]
    wide = np.zeros((*values.shape[:-2], *(count + 2 * reach for count in shape)), values.dtype)
    wide[..., reach:-reach, reach:-reach] = values
    for count in shape[::-1]:  # along rows, then, turned, along columns
        sums, step = wide, 1
        while step <= reach:
            sums, step = sums[..., :-step] + sums[..., step:], 2 * step
        wide = (sums[..., :count] + wide[..., 2 * reach :]).swapaxes(-2, -1)
    near = [np.minimum(np.arange(count), reach) for count in shape]
    return wide / np.outer(*(before + before[::-1] + 1 for before in near)).astype(values.dtype)


def dilated(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return where a mask is true within so many pixels along both axes."""
    for count in mask.shape[:-3:-1]:  # along rows, then, turned, along columns
        wide = np.pad(mask, [(0, 0)] * (mask.ndim - 1) + [(reach, reach)])
        near = (wide[..., step : step + count] for step in range(2 * reach + 1))
        mask = functools.reduce(np.logical_or, near).swapaxes(-2, -1)
    return mask
