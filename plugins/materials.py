"""The materials of a scene as one table, looked up by the shape that was hit.

Mitsuba calls each BSDF of a scene in turn, and the Python code of each runs to record the call: 1 ms for an
instance, at every render. Lobes from a table are recorded once, for any number of materials.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .kernel_plan import SCALAR_VARIANT
from .lobes import LOBES, TABLED, Lobes
from .lookup import ByShape
from .variants import is_jit


def material_rows(shapes: Sequence[mi.Shape]) -> list[np.ndarray] | str:
    """Return the ``row`` of the material of each shape, or why they have no place in one table."""
    bsdfs = {id(b): b for b in (s.bsdf() for s in shapes)}
    mergeable = bool(bsdfs) and all(hasattr(b, "row") for b in bsdfs.values())
    obstacles = {
        SCALAR_VARIANT: not is_jit(),
        "a spectral variant": mi.is_spectral,
        # Inside an instance, shapes are not the scene's own
        "instances in the scene": any(s.class_name() == "Instance" for s in shapes),
        "a material other than mrt_bsdf": not mergeable,
        "materials of different Fresnel formulas": mergeable and len({b.fresnel for b in bsdfs.values()}) > 1,
    }
    reasons = [why for why, holds in obstacles.items() if holds]
    rows = {} if reasons else {key: bsdf.row() for key, bsdf in bsdfs.items()}
    reasons += [row for row in rows.values() if isinstance(row, str)]
    return reasons[0] if reasons else [rows[id(s.bsdf())] for s in shapes]


def lobes_in(rows: Sequence[np.ndarray]) -> tuple[tuple[str, bool], ...]:
    """Return the names of all lobes, and whether a material of these has them."""
    return tuple((lobe.name, any(row[1 + k].any() for row in rows)) for k, lobe in enumerate(LOBES))


class MaterialTable:
    """The parameters of the materials, as rows of ``material_rows``: looked up, they make ``Lobes``."""

    def __init__(self, shapes: Sequence[mi.Shape], rows: Sequence[np.ndarray]) -> None:
        self.fresnel = shapes[0].bsdf().fresnel
        self.by_shape = ByShape(mi.Vector4f, shapes, rows, [1] * 4)

    def lobes(self, si: mi.SurfaceInteraction3f) -> Lobes:
        """Return the lobes at a surface point."""
        # One mask for all lights, or they would be looked up for each
        numbers, *colors = (self.by_shape(si, mi.Bool(True), part) for part in range(1 + len(LOBES)))
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        given = dict(zip(TABLED, numbers, strict=False))
        for lobe, color in zip(LOBES, colors, strict=True):
            given[lobe.reflectance] = mi.UnpolarizedSpectrum(list(color)[:channels])
        return Lobes(self.fresnel, given, si.wi)
