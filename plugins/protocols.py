"""Declarations of plugins about themselves, so that nobody has to guess from attributes.

Mitsuba's classes take no mix-in; a class joins a protocol by registration: after
``QuadricShape.register(MrtCone)``, ``isinstance(shape, QuadricShape)`` holds. Others' plugins may join.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from .intersect import Frame
    from .kernel_plan import KernelPlan, Mirror, SceneFacts
    from .quadric_kinds import QuadricTable


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


class PlaneShape(ABC):
    """A shape that stands for an infinite plane."""

    unit_normal: np.ndarray  # float64 [3]
    distance: float  # unit_normal · P + distance = 0
    tangents: np.ndarray  # float64 [2, 3]

    @abstractmethod
    def has_flipped_normals(self) -> bool:
        """Return whether the plane faces the other side; every shape of Mitsuba says so."""


class QuadricShape(ABC):
    """A mesh that stands for exact quadrics."""

    @abstractmethod
    def quadrics(self) -> QuadricTable:
        """Return the quadrics."""

    @abstractmethod
    def moving_frame(self) -> Frame | None:
        """Return the unit frame of the only quadric with its derivatives; None where none are wanted."""


class SteadyLight(ABC):  # noqa: B024 - lights join by register()
    """A light that is as bright far away as near by."""


class TabledLight(SteadyLight):
    """A steady point light whose numbers may be looked up in a table."""

    @abstractmethod
    def numbers(self) -> tuple[list[float], list[float]] | None:
        """Return position and intensity; None where that varies, or where derivatives are wanted."""


class MirrorBSDF(ABC):
    """A BSDF with the attributes ``mirror_reflectance`` and ``int_ior``, which drive the mirror rays."""

    @abstractmethod
    def mirror_bound(self) -> Mirror:
        """Return upper bounds of them."""

    @abstractmethod
    def value_bound(self) -> float:
        """Return an upper bound of f cos θ; inf where there is none."""


class MergeableBSDF(MirrorBSDF):
    """A ``MirrorBSDF`` with the lobes of ``mrt_bsdf``, which may be looked up in a table of materials."""

    fresnel: str  # one of the forms of mrt_bsdf

    @abstractmethod
    def rows(self, points: Any = None) -> np.ndarray | str:
        """Return the parameters as plain numbers [n, 1 + lobes, 4], or why they are none.

        ``points``: one surface point on each object of a shape, for textures that vary from face to face.
        """
