"""The materials of a scene, as rows of a table in place of calls to plugins where they are known.

Mitsuba calls each BSDF of a scene in turn, and the Python code of each runs to record the call: 1 ms for an
instance, at every render. Lobes from a ``MaterialTable`` are recorded once, for any number of materials.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import classes_of, is_known
from ..lobes import CHOICES, LOBES, NUMBERS, Lobes
from ..table import names_in
from ..variants import is_jit, varies
from .plan import SCALAR_VARIANT
from .tables import ByShape


def material_rows(shapes: Sequence[mi.Shape]) -> tuple[list[np.ndarray], str]:
    """Return the ``fixed_row`` of the material of each shape, and ""; or none of them, and the reason why
    they have no place in one table."""
    bsdfs = dict.fromkeys(s.bsdf() for s in shapes)
    if not is_jit():
        return [], SCALAR_VARIANT
    if mi.is_spectral:
        return [], "a spectral variant"
    if any(s.class_name() == "Instance" for s in shapes):  # inside, shapes are not the scene's own
        return [], "instances in the scene"
    # Of the class itself: one derived from it may have other lobes
    if not (bsdfs and all(map(is_mrt_bsdf, bsdfs))):
        return [], f"a material other than {names_in('materials')}"
    for name in CHOICES:
        if len({b.choices[name] for b in bsdfs}) > 1:
            return [], f'materials of different "{name}"'
    rows = {bsdf: bsdf.fixed_row() for bsdf in bsdfs}
    obstacle = next((row for row in rows.values() if isinstance(row, str)), "")
    return [] if obstacle else [rows[s.bsdf()] for s in shapes], obstacle


class MaterialTable:
    """The parameters of the materials, as rows of ``material_rows``: looked up, they make ``Lobes``."""

    def __init__(self, shapes: Sequence[mi.Shape], rows: Sequence[np.ndarray]) -> None:
        self.choices = shapes[0].bsdf().choices
        #: the names of the colours of a row; ``f0`` is read only where a material has one of its own
        self.colors = [lobe.reflectance for lobe in LOBES]
        if any("f0" in shape.bsdf().parameters for shape in shapes):
            self.colors.append("f0")
        self.by_shape = ByShape(mi.Vector4f, shapes, rows, [1] * 4)

    def lobes(self, si: mi.SurfaceInteraction3f) -> Lobes:
        """Return the lobes at a surface point."""
        # One mask for all lights, or they would be looked up for each
        numbers = self.by_shape(si, mi.Bool(True))
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        given = dict(zip(NUMBERS, numbers, strict=False))
        for part, name in enumerate(self.colors, start=1):
            color = self.by_shape(si, mi.Bool(True), part)
            given[name] = mi.UnpolarizedSpectrum(list(color)[:channels])
        return Lobes(self.choices, given, si.wi)


def is_mrt_bsdf(bsdf: mi.BSDF) -> bool:
    """True if a material is an ``mrt_bsdf`` itself: a class derived from it may be anything."""
    return type(bsdf) in classes_of("mrt_bsdf")


def has_mirror(bsdf: mi.BSDF) -> bool:
    """True if a BSDF reflects like a mirror."""
    return bsdf.has_attribute("mirror_reflectance") or mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection)


def is_textured(bsdf: mi.BSDF) -> bool:
    """True if a BSDF varies over its surface, which the flags of Mitsuba's own do not say."""
    return any(varies(node) or not is_known(node) for node in mi.traverse(bsdf).hierarchy)


def is_anisotropic(bsdf: mi.BSDF) -> bool:
    """True if a BSDF depends on how the surface is turned about its normal."""
    if is_mrt_bsdf(bsdf):
        return False
    names = {node.class_name() for node in mi.traverse(bsdf).hierarchy}
    if names & {"BumpMap", "NormalMap"} or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Anisotropic):
        return True
    return not is_known(bsdf)
