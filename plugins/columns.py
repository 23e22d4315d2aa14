"""Vectors for the pure functions whose components are columns of numbers of any kind."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import drjit.scalar
import numpy as np


class Columns(list):
    """Three columns, which Dr.Jit's ``dot``, ``norm`` and ``normalize`` take for a vector."""

    x, y, z = (property(itemgetter(k)) for k in range(3))

    @classmethod
    def of(cls, array: np.ndarray) -> Columns:
        """Return the float64 columns of an array [n, 3]."""
        return cls(column(array[:, k]) for k in range(3))

    def array(self) -> np.ndarray:
        """Return the array [n, 3] of the columns."""
        return np.stack([np.array(c) for c in self], axis=1)

    def __add__(self, other: Sequence[Any]) -> Columns:
        return Columns(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Sequence[Any]) -> Columns:
        return Columns(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor: Any) -> Columns:
        return Columns(a * factor for a in self)

    def __truediv__(self, divisor: Any) -> Columns:
        return self * (1 / divisor)


def column(values: np.ndarray) -> Any:
    """Return one column of float64 numbers."""
    return drjit.scalar.ArrayXf64(np.ascontiguousarray(values, np.float64))
