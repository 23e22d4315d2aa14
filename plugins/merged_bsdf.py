"""Many ``mrt_bsdf`` evaluated as one, whose parameters are those of the shape, or of the object of a group,
that was hit.

Mitsuba calls each BSDF of a scene in turn, and the Python code of each runs to record the call: 1 ms for an
instance, at every render. This one is recorded once, for any number of materials. It is not an ``mi.BSDF``:
Dr.Jit would record its calls in the kernels of every scene, and only Python calls it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .kernel_plan import SCALAR_VARIANT, VARYING, MaterialRows
from .lobes import LOBES, Lobes, Pair
from .lookup import ByShape, aligned
from .protocols import MergeableBSDF, QuadricShape
from .variants import is_jit

# Objects of a group are told apart by the faces of their stand-ins, up to so many in float32
MOST_FACES = 2**20


def material_rows(shapes: Sequence[mi.Shape]) -> list[MaterialRows] | str:
    """Return the materials of the shapes, or why they have no place in one table."""
    bsdfs = {id(b): b for b in (s.bsdf() for s in shapes)}
    mergeable = bool(bsdfs) and all(isinstance(b, MergeableBSDF) for b in bsdfs.values())
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
    rows, known = list[MaterialRows](), dict[int, MaterialRows | str]()
    for shape in shapes:
        found = _of_objects(shape) if varies_by_object(shape) else known.get(id(shape.bsdf()))
        if found is None:
            found = known[id(shape.bsdf())] = shape.bsdf().rows()
        if isinstance(found, str):
            return found
        rows.append(found)
    return rows


def varies_by_object(shape: Any) -> bool:
    """Return whether a shape is of quadrics whose materials differ, or vary in another way."""
    exact = isinstance(shape, QuadricShape)
    return exact and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.SpatiallyVarying)


def _of_objects(shape: Any) -> MaterialRows | str:
    faces = shape.quadrics().first_faces
    if faces[-1] >= MOST_FACES:
        return VARYING
    points = dr.zeros(mi.SurfaceInteraction3f, len(faces))
    points.shape, points.prim_index = mi.ShapePtr(shape), mi.UInt32(faces.astype(np.uint32))
    return shape.bsdf().rows(points)


class MergedBSDF:
    """A table of the parameters of the materials, and the lobes that they make."""

    def __init__(self, shapes: Sequence[mi.Shape], materials: Sequence[MaterialRows]) -> None:
        self.fresnel = shapes[0].bsdf().fresnel
        columns = zip(*((m.numbers, m.diffuse, m.specular) for m in materials), strict=True)
        counts = [len(m.numbers) for m in materials]
        rows: Any = np.zeros((sum(counts), 3, 4))
        for part, column in enumerate(columns):
            values = np.concatenate(column)
            rows[:, part, : values.shape[1]] = values
        if max(counts) == 1:
            self.table: Any = ByShape(mi.Vector4f, shapes, rows, [1] * 4)
        else:
            places = [
                (first, 1 / shape.quadrics().first_faces[1] if count > 1 else 0)
                for shape, first, count in zip(shapes, np.cumsum([0, *counts[:-1]]), counts, strict=True)
            ]
            by_shape = ByShape(mi.Vector2f, shapes, places, [0, 0])
            self.table = _ByObject(by_shape, rows)

    def lobes(self, si: mi.SurfaceInteraction3f) -> Lobes:
        """Return the lobes at a surface point."""
        return Lobes(self.fresnel, self._row(si), si.wi)

    def _row(self, si: mi.SurfaceInteraction3f) -> dict[str, Any]:
        # One mask for all lights, or they would be looked up for each
        everywhere = mi.Bool(True)
        numbers, *colors = (self.table(si, everywhere, part) for part in range(1 + len(LOBES)))
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        return {
            **dict(zip(("alpha", "int_ior", "ext_ior"), numbers, strict=False)),
            **{
                x.reflectance: mi.UnpolarizedSpectrum(list(c)[:channels])
                for x, c in zip(LOBES, colors, strict=True)
            },
        }

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
        return self._row(si)["int_ior"]


class _ByObject:
    """Rows of three parts for the objects of some shapes, looked up for the one that was hit."""

    def __init__(self, places: ByShape, rows: np.ndarray) -> None:
        self.places, self.rows = places, aligned(rows)  # first row of each shape, objects per face

    def __call__(self, si: mi.SurfaceInteraction3f, found: mi.Bool, part: int) -> mi.Vector4f:
        first, per_face = self.places(si, found)
        row = mi.UInt32(first) + mi.UInt32((mi.Float(si.prim_index) + 0.5) * per_face)
        return dr.gather(mi.Vector4f, self.rows, 3 * row + part)
