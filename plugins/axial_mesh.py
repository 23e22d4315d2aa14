"""Shapes of revolution between two points: a mesh to Mitsuba, an exact quadric to ``mrt_whitted``."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import Frame
from .mesh_api import construct, keep_apart, write_buffers
from .parameters import ParameterError, flag, number, segments, vector
from .placement import Placement
from .protocols import QuadricShape
from .quadric_kinds import KINDS, QuadricTable
from .variants import first, is_jit, updatable


class AxialMesh(mi.Mesh):
    """The base class of ``mrt_cone`` and ``mrt_cylinder`` (Mitsuba's classes take no mix-in).

    Parameters: the two points ``ends``, ``radius``, ``segments``, ``capped`` and ``to_world``.
    """

    kind: str  # without discs, "open " precedes it
    ends: tuple[str, str]  # names of the points
    parameters: Mapping[str, Any] = MappingProxyType({})  # none while the mesh is being filled

    def __init__(self, props: mi.Properties) -> None:
        plugin = props.plugin_name()
        ends = [vector(props, name) for name in self.ends]
        radius = number(props, "radius", 1.0, above=0)
        if np.array_equal(*np.asarray(ends, np.float32)):
            both = " and ".join(f'"{name}"' for name in self.ends)
            raise ParameterError(f"{plugin}: {both} are both {ends[0]}, but must be two points")
        self.capped = flag(props, "capped", True)
        self.kind = self.kind if self.capped else f"open {self.kind}"
        self.placement = Placement(props)
        self.unit = KINDS[self.kind].mesh(segments(props, 256))
        self.exact_frame = self._frame_of(vector64(ends[0]), vector64(ends[1]), radius)
        sizes = len(self.unit.points), len(self.unit.faces)
        construct(self, plugin, sizes, props, normals=True, texcoords=True)
        uvs = self.unit.uvs.astype(np.float32).ravel()
        write_buffers(self, vertex_texcoords=uvs, **self.quadrics().stand_in(self.unit))
        self.parameters = {
            **dict(zip(self.ends, map(mi.Point3f, ends), strict=True)),
            "radius": updatable(radius),
        }
        keep_apart(self, plugin, sizes[1])

    def _frame_of(self, p0: Any, p1: Any, radius: Any) -> Frame:
        return self.placement(KINDS[self.kind].frame(p0, p1, radius))

    def frame(self) -> Frame:
        """Return the shape's unit frame in world space, in double precision (see ``intersect``)."""
        return self.exact_frame

    def quadrics(self) -> QuadricTable:
        """Return what ``mrt_whitted`` intersects in place of the mesh."""
        return QuadricTable.of_one(self.kind, self.exact_frame, flipped=self.has_flipped_normals())

    def moving_frame(self) -> Frame | None:
        """Return the unit frame with its derivatives, None where none are wanted."""
        values = list(self.parameters.values())
        return self._frame_of(*values) if dr.grad_enabled(values) else None

    def traverse(self, callback: Any) -> None:
        mi.Mesh.traverse(self, callback)
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name, value in self.parameters.items():
            callback.put(name, value, flags)

    def parameters_changed(self, keys: Any = ()) -> None:
        if not set(self.parameters).isdisjoint(keys):
            p0, p1, radius = self.parameters.values()
            self.exact_frame = self._frame_of(vector64(p0), vector64(p1), first(radius))
            if is_jit():
                self._follow(self._frame_of(p0, p1, radius))
            else:
                write_buffers(self, **self.quadrics().stand_in(self.unit))
        mi.Mesh.parameters_changed(self, keys)

    def _follow(self, frame: Frame) -> None:
        """Write positions and normals anew, differentiably with respect to what ``frame`` is made of."""
        frame = Frame(*map(mi.Vector3f, vars(frame).values()))
        points, gradients = (mi.Vector3f(x.T) for x in (self.unit.points, self.unit.gradients))
        positions = dr.ravel(frame.origin + frame.to_world(points))
        normals = dr.ravel(dr.normalize(frame.gradient(gradients)))
        write_buffers(self, vertex_positions=positions, vertex_normals=normals)

    def to_string(self) -> str:
        points = ", ".join(f"{name}={list(vector64(self.parameters[name]))}" for name in self.ends)
        radius = first(self.parameters["radius"])
        return f"{type(self).__name__}[{points}, radius={radius:g}, capped={self.capped}]"


def vector64(v: Any) -> Any:
    """Return three numbers, or a point or vector of one entry, in double precision."""
    return dr.scalar.Array3f64([first(c) for c in v])


QuadricShape.register(AxialMesh)
