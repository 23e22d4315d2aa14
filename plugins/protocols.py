"""What ``mrt.render`` asks of an integrator that plans its kernels.

Mitsuba's classes take no mix-in; a class joins by ``LayeredIntegrator.register(MyIntegrator)``. What shapes,
lights and materials declare about themselves is told in ``facts.Reading``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .kernel_plan import KernelPlan, SceneFacts


class LayeredIntegrator(ABC):
    """An integrator that plans its kernels and returns layers with the picture."""

    plugin_name: str  # by which it is registered

    @abstractmethod
    def provided_layers(self) -> frozenset[str]:
        """Return the names of the layers that ``trace`` knows."""

    @abstractmethod
    def read(self, scene: Any) -> Any:
        """Read a scene as it is; ``facts`` of what is returned are what the kernels depend on."""

    @abstractmethod
    def kernel_plan(self, facts: SceneFacts) -> KernelPlan:
        """Return what the kernels for such a scene hold."""

    @abstractmethod
    def prepare(self, scene: Any, plan: KernelPlan | None = None, reading: Any = None) -> Any:
        """Return what ``trace`` needs, by a plan of the kernels for what was read; by default, of both new
        ones."""

    @abstractmethod
    def trace(self, scene: Any, sampler: Any, ray: Any, active: Any = True, data: Any = None) -> Any:
        """Return the radiance along rays, and what the layers are made of. ``data``: from ``prepare``."""
