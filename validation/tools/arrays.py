"""Float64 arrays for the pure functions of ``plugins``, with LLVM or without, and 3-vectors of them.

No Mitsuba variant computes in double precision, but Dr.Jit does: on one core without LLVM
(``drjit.scalar.ArrayXf64``), several times faster with it (``drjit.llvm.Float64``).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mrt_mitsuba.errors import VariantError
from mrt_mitsuba.plugins.columns import Vector3
from mrt_mitsuba.runtime import FAST, obstacle


@dataclass(frozen=True)
class Backend:
    """Array types of one of Dr.Jit's backends, and what differs in the use of them."""

    name: str  # "llvm" or "scalar"
    batch: int  # elements to compute at a time: what suits the cache, or the kernel launch

    def __post_init__(self) -> None:
        if self.name == "llvm":
            problem = obstacle(FAST)
            if problem:
                raise VariantError(f"float64 arrays of the llvm backend cannot be used: {problem}")

    @property
    def _types(self) -> Any:
        import drjit.llvm
        import drjit.scalar

        return drjit.llvm if self.name == "llvm" else drjit.scalar

    def floats(self, values: Any) -> Any:
        """A float64 array from numbers [N]."""
        kind = self._types.Float64 if self.name == "llvm" else self._types.ArrayXf64
        return kind(np.ascontiguousarray(values, dtype=np.float64))

    def indices(self, values: Any) -> Any:
        """An int32 array from numbers [N]."""
        kind = self._types.Int32 if self.name == "llvm" else self._types.ArrayXi
        return kind(np.ascontiguousarray(values, dtype=np.int32))

    def vectors(self, values: np.ndarray) -> Vector3:
        """A vector of arrays from numbers [N, 3]."""
        return Vector3(self.floats(column) for column in np.asarray(values, dtype=np.float64).T)

    def parameter(self, value: float) -> Any:
        """A number that is data to a kernel, not part of its code: kernels can then be used again."""
        return dr.opaque(self._types.Float64, value) if self.name == "llvm" else float(value)

    def parameter_index(self, value: int) -> Any:
        """As ``parameter``, of an int32."""
        return dr.opaque(self._types.Int32, value) if self.name == "llvm" else value

    def vector_parameter(self, values: Iterable[float]) -> Vector3:
        """As ``parameter``, of three numbers."""
        return Vector3(self.parameter(float(value)) for value in values)


def numbers(value: Any) -> np.ndarray:
    """An array [N], or a vector as [N, 3], as numpy."""
    if isinstance(value, Vector3):
        return np.stack([np.array(component) for component in value], axis=-1)
    return np.array(value)


def backend(name: str | None = None) -> Backend:
    """The backend of that name, "llvm" or "scalar"; without a name the faster one that works here.

    Raises ``VariantError`` where LLVM is asked for and cannot be used.
    """
    name = name or ("scalar" if obstacle(FAST) else "llvm")
    return Backend(name, batch=2**20 if name == "llvm" else 2**12)
