"""Vectors whose components are whole columns of numbers, for the pure functions on tables of objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit.scalar
import numpy as np


class Columns(list):
    """Three columns of float64 numbers. Takes part in Dr.Jit's ``dot``, ``norm`` and ``squared_norm``."""

    @classmethod
    def of(cls, array: np.ndarray) -> Columns:
        """The columns of an array [n, 3]."""
        return cls(column(array[:, k]) for k in range(3))

    def array(self) -> np.ndarray:
        """The array [n, 3] of the columns."""
        return np.stack([np.array(c) for c in self], axis=1)

    @property
    def x(self) -> Any:
        return self[0]

    @property
    def y(self) -> Any:
        return self[1]

    @property
    def z(self) -> Any:
        return self[2]

    def __sub__(self, other: Sequence[Any]) -> Columns:
        return Columns(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor: Any) -> Columns:
        return Columns(a * factor for a in self)

    def __truediv__(self, divisor: Any) -> Columns:
        return self * (1 / divisor)


def column(values: np.ndarray) -> Any:
    """One column of float64 numbers."""
    return drjit.scalar.ArrayXf64(np.ascontiguousarray(values, np.float64))
