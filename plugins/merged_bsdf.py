"""Many ``mrt_bsdf`` evaluated as one, whose parameters are those of the shape that was hit.

Mitsuba calls each BSDF of a scene in turn, and the Python code of each runs to record the call: 1 ms for an
instance, at every render. This one is recorded once, for any number of materials. It is not an ``mi.BSDF``:
Dr.Jit would record its calls in the kernels of every scene, and only Python calls it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .kernel_plan import Reason, UniformMaterial
from .lobes import Lobes, Pair
from .lookup import ByShape
from .protocols import MergeableBSDF
from .variants import is_jit


def uniform_materials(
    shapes: Sequence[mi.Shape], read: Callable[[Callable, Any], Any]
) -> dict[int, UniformMaterial] | Reason:
    """Return the materials by the ids of the shapes' BSDFs, or why they have no place in one table.

    ``read(function, bsdf)``: what the function returns of the BSDF, see ``watch.Notes``.
    """
    bsdfs = {id(b): b for b in (s.bsdf() for s in shapes)}
    if not is_jit():
        return Reason.SCALAR_VARIANT
    if mi.is_spectral:
        return Reason.SPECTRAL_VARIANT
    # Inside an instance, shapes are not the scene's own
    if any(s.class_name() == "Instance" for s in shapes):
        return Reason.INSTANCES
    if not bsdfs or not all(isinstance(b, MergeableBSDF) for b in bsdfs.values()):
        return Reason.OTHER_BSDF
    if len({b.fresnel for b in bsdfs.values()}) != 1:
        return Reason.MIXED_FRESNEL
    materials = {}
    for key, bsdf in bsdfs.items():
        found = materials[key] = read(_uniform, bsdf)
        if isinstance(found, Reason):
            return found
    return materials


def _uniform(bsdf: MergeableBSDF) -> UniformMaterial | Reason:
    return bsdf.uniform()


class MergedBSDF:
    """Tables of the parameters of the shapes' materials, and the lobes that they make."""

    def __init__(self, shapes: Sequence[mi.Shape], materials: dict[int, UniformMaterial]) -> None:
        rows = [materials[id(s.bsdf())] for s in shapes]
        self.fresnel = shapes[0].bsdf().fresnel
        self.numbers = _by_shape(shapes, [m.numbers for m in rows])
        self.diffuse = _by_shape(shapes, [m.diffuse for m in rows])
        self.specular = _by_shape(shapes, [m.specular for m in rows])

    def lobes(self, si: mi.SurfaceInteraction3f) -> Lobes:
        """Return the lobes at a surface point."""
        return Lobes(self.fresnel, self._row(si), si.wi)

    def _row(self, si: mi.SurfaceInteraction3f) -> _Row:
        # One mask for all lights, or they would be looked up for each
        everywhere = mi.Bool(True)
        alpha, int_ior, ext_ior, _ = self.numbers(si, everywhere)
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        diffuse, specular = (
            mi.UnpolarizedSpectrum(list(color(si, everywhere))[:channels])
            for color in (self.diffuse, self.specular)
        )
        return _Row(alpha, int_ior, ext_ior, diffuse, specular)

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> mi.Spectrum:
        """Return f cos θo."""
        return mi.depolarizer(self.lobes(si).value(ctx, Pair.above(si.wi, wo, active)))

    def has_attribute(self, name: str) -> bool:
        """Return whether the BSDFs of the table have an attribute."""
        return name in ("mirror_reflectance", "int_ior")

    def eval_attribute(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Any:
        """Return ``mirror_reflectance``."""
        return self.lobes(si).mirror_reflectance

    def eval_attribute_1(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Return ``int_ior``."""
        return self._row(si).int_ior


@dataclass
class _Row:
    """The parameters of the shape at a surface point."""

    alpha: mi.Float
    int_ior: mi.Float
    ext_ior: mi.Float
    diffuse: mi.UnpolarizedSpectrum
    specular: mi.UnpolarizedSpectrum
    f0: None = None


def _by_shape(shapes: Sequence[mi.Shape], rows: list[tuple[float, ...]]) -> ByShape:
    return ByShape(mi.Vector4f, shapes, [[*row, *[0] * (4 - len(row))] for row in rows], [1] * 4)
