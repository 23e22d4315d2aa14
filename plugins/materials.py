"""The materials of a scene as one table, looked up by the shape, or the object of a group, that was hit.

Mitsuba calls each BSDF of a scene in turn, and the Python code of each runs to record the call: 1 ms for an
instance, at every render. Lobes from a table are recorded once, for any number of materials.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .kernel_plan import SCALAR_VARIANT, VARYING
from .lobes import LOBES, TABLED, Lobes
from .lookup import ByShape, aligned
from .variants import is_jit

# Objects of a group are told apart by the faces of their stand-ins, up to so many in float32
MOST_FACES = 2**20


def material_rows(shapes: Sequence[mi.Shape]) -> list[np.ndarray] | str:
    """Return the ``rows`` of the materials of the shapes, or why they have no place in one table."""
    bsdfs = {id(b): b for b in (s.bsdf() for s in shapes)}
    mergeable = bool(bsdfs) and all(hasattr(b, "rows") for b in bsdfs.values())
    obstacles = {
        SCALAR_VARIANT: not is_jit(),
        "a spectral variant": mi.is_spectral,
        # Inside an instance, shapes are not the scene's own
        "instances in the scene": any(s.class_name() == "Instance" for s in shapes),
        "a material other than mrt_bsdf": not mergeable,
        "materials of different Fresnel formulas": mergeable and len({b.fresnel for b in bsdfs.values()}) > 1,
    }
    if any(obstacles.values()):
        return next(why for why, holds in obstacles.items() if holds)
    rows, known = list[np.ndarray](), dict[int, np.ndarray | str]()
    for shape in shapes:
        found = _of_objects(shape) if varies_by_object(shape) else known.get(id(shape.bsdf()))
        if found is None:
            found = known[id(shape.bsdf())] = shape.bsdf().rows()
        if isinstance(found, str):
            return found
        rows.append(found)
    return rows


def lobes_in(rows: Sequence[np.ndarray]) -> tuple[tuple[str, bool], ...]:
    """Return the names of all lobes, and whether a material of these has them."""
    return tuple((lobe.name, any(r[:, 1 + k].any() for r in rows)) for k, lobe in enumerate(LOBES))


def varies_by_object(shape: Any) -> bool:
    """Return whether a shape is of quadrics whose materials differ, or vary in another way."""
    return hasattr(shape, "quadrics") and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.SpatiallyVarying)


def _of_objects(shape: Any) -> np.ndarray | str:
    faces = shape.quadrics().first_faces
    if faces[-1] >= MOST_FACES:
        return VARYING
    points = dr.zeros(mi.SurfaceInteraction3f, len(faces))
    points.shape, points.prim_index = mi.ShapePtr(shape), mi.UInt32(faces.astype(np.uint32))
    return shape.bsdf().rows(points)


class MaterialTable:
    """The parameters of the materials, as rows of ``material_rows``: looked up, they make ``Lobes``."""

    def __init__(self, shapes: Sequence[mi.Shape], materials: Sequence[np.ndarray]) -> None:
        self.fresnel = shapes[0].bsdf().fresnel
        counts = [len(m) for m in materials]
        rows: Any = np.concatenate(materials)
        # For each shape: the row of its numbers, or, where objects of a shape differ, their first row and how
        # many rows lie between two faces of the stand-ins
        self.rows: mi.Float | None = None
        if max(counts) == 1:
            self.by_shape = ByShape(mi.Vector4f, shapes, rows, [1] * 4)
            return
        places = [
            (first, 1 / shape.quadrics().first_faces[1] if count > 1 else 0)
            for shape, first, count in zip(shapes, np.cumsum([0, *counts[:-1]]), counts, strict=True)
        ]
        self.by_shape, self.rows = ByShape(mi.Vector2f, shapes, places, [0, 0]), aligned(rows)

    def lobes(self, si: mi.SurfaceInteraction3f) -> Lobes:
        """Return the lobes at a surface point."""
        # One mask for all lights, or they would be looked up for each
        numbers, *colors = (self._part(si, mi.Bool(True), part) for part in range(1 + len(LOBES)))
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        given = dict(zip(TABLED, numbers, strict=False))
        for lobe, color in zip(LOBES, colors, strict=True):
            given[lobe.reflectance] = mi.UnpolarizedSpectrum(list(color)[:channels])
        return Lobes(self.fresnel, given, si.wi)

    def _part(self, si: mi.SurfaceInteraction3f, found: mi.Bool, part: int) -> mi.Vector4f:
        """Return four numbers: those of the BSDF, or a reflectance."""
        if self.rows is None:
            return self.by_shape(si, found, part)
        first, per_face = self.by_shape(si, found)
        row = mi.UInt32(first) + mi.UInt32((mi.Float(si.prim_index) + 0.5) * per_face)
        return dr.gather(mi.Vector4f, self.rows, (1 + len(LOBES)) * row + part)
