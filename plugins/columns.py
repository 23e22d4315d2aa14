"""Vectors for the pure functions, of components of any kind; of whole columns of numbers for tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import drjit.scalar
import numpy as np

if TYPE_CHECKING:
    from typing_extensions import Self  # of typing itself from Python 3.11 on


class Vector3(list):
    """Three components, each a float or an array; Dr.Jit's ``dot``, ``norm`` and ``normalize`` take it."""

    @property
    def x(self) -> Any:
        return self[0]

    @property
    def y(self) -> Any:
        return self[1]

    @property
    def z(self) -> Any:
        return self[2]

    def __add__(self, other: Sequence[Any]) -> Self:
        return type(self)(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Sequence[Any]) -> Self:
        return type(self)(a - b for a, b in zip(self, other, strict=True))

    def __neg__(self) -> Self:
        return type(self)(-a for a in self)

    def __mul__(self, factor: Any) -> Self:
        return type(self)(a * factor for a in self)

    def __truediv__(self, divisor: Any) -> Self:
        return self * (1 / divisor)


class Columns(Vector3):
    """Three columns of float64 numbers."""

    @classmethod
    def of(cls, array: np.ndarray) -> Columns:
        """Return the columns of an array [n, 3]."""
        return cls(column(array[:, k]) for k in range(3))

    def array(self) -> np.ndarray:
        """Return the array [n, 3] of the columns."""
        return np.stack([np.array(c) for c in self], axis=1)


def column(values: np.ndarray) -> Any:
    """Return one column of float64 numbers."""
    return drjit.scalar.ArrayXf64(np.ascontiguousarray(values, np.float64))
