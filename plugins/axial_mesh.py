"""Shapes of revolution between two points: a mesh to Mitsuba, an exact quadric to ``mrt_whitted``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import Frame
from .mesh_api import construct, keep_apart, write_buffers
from .parameters import ParameterError, flag, integer, number, vector
from .protocols import QuadricShape
from .quadric_kinds import KINDS, QuadricTable
from .variants import first, is_jit, updatable

# From some thousand sides on the triangles are slivers, between which rays slip through; more would not help
MOST_SEGMENTS = 65536


def axial_mesh(kind: str, end0: str, end1: str) -> type[mi.Mesh]:
    """Return the base class of ``mrt_KIND``, for the current variant (Mitsuba's classes take no mix-in).

    Its parameters are the two points by these names, ``radius``, ``segments``, ``capped`` and ``to_world``.
    """
    plugin, names = f"mrt_{kind}", (end0, end1, "radius")

    class AxialMesh(mi.Mesh):
        def __init__(self, props: mi.Properties) -> None:
            ends = vector(props, end0), vector(props, end1)
            radius = number(props, "radius", 1.0, above=0)
            _check_axis(plugin, end0, ends[0], end1, ends[1])
            self.capped = flag(props, "capped", True)
            self.kind = kind if self.capped else f"open {kind}"
            self.placement = Placement(props)
            self.unit = KINDS[self.kind].mesh(side_count(props, 256))
            self.exact_frame = self._frame_of(vector64(ends[0]), vector64(ends[1]), radius)
            sizes = len(self.unit.points), len(self.unit.faces)
            construct(self, plugin, sizes, props, normals=True, texcoords=True)
            uvs = self.unit.uvs.astype(np.float32).ravel()
            write_buffers(self, vertex_texcoords=uvs, **self.quadrics().stand_in(self.unit))
            self.parameters = dict(zip(names, (*map(mi.Point3f, ends), updatable(radius)), strict=True))
            keep_apart(self, plugin, sizes[1])

        def _frame_of(self, p0: Any, p1: Any, radius: Any) -> Frame:
            return self.placement(KINDS[kind].frame(p0, p1, radius))

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
            for name, value in getattr(self, "parameters", {}).items():  # none while the mesh is being filled
                callback.put(name, value, flags)

        def parameters_changed(self, keys: Any = ()) -> None:
            if not set(names).isdisjoint(keys):
                p0, p1, radius = (self.parameters[name] for name in names)
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
            positions, normals = (
                frame.origin + frame.to_world(points),
                dr.normalize(frame.gradient(gradients)),
            )
            write_buffers(self, vertex_positions=dr.ravel(positions), vertex_normals=dr.ravel(normals))

        def to_string(self) -> str:
            points = ", ".join(f"{name}={list(vector64(self.parameters[name]))}" for name in names[:2])
            radius = first(self.parameters["radius"])
            return f"{type(self).__name__}[{points}, radius={radius:g}, capped={self.capped}]"

    QuadricShape.register(AxialMesh)
    return AxialMesh


def side_count(props: mi.Properties, default: int) -> int:
    """Return the parameter ``segments``: sides of a mesh."""
    return integer(props, "segments", default, least=3, most=MOST_SEGMENTS)


class Placement:
    """The effect of ``to_world`` on frames. Raises ``ParameterError`` for one that flattens space."""

    def __init__(self, props: mi.Properties) -> None:
        matrix = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, np.float64)
        self.linear, self.offset = matrix[:3, :3], matrix[:3, 3].tolist()
        if not np.isfinite(matrix).all() or abs(np.linalg.det(self.linear)) == 0:
            raise ParameterError(
                f'{props.plugin_name()}: "to_world" is not invertible; remove its zero scale'
            )
        self.mirrors = bool(np.linalg.det(self.linear) < 0)
        self.inverse = np.linalg.inv(self.linear).tolist()
        self.linear = self.linear.tolist()

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return the places of points [n, 3]."""
        return points @ np.transpose(self.linear) + np.array(self.offset)

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame of the moved shape; works for vectors of any type."""

        def row(v: Any) -> Any:
            return type(v)([sum(v[i] * self.inverse[i][j] for i in range(3)) for j in range(3)])

        o = frame.origin
        origin = [
            sum(m * c for m, c in zip(self.linear[i], o, strict=True)) + self.offset[i] for i in range(3)
        ]
        return Frame(type(o)(origin), row(frame.x), row(frame.y), row(frame.z))


def vector64(v: Any) -> Any:
    """Return three numbers, or a point or vector of one entry, in double precision."""
    return dr.scalar.Array3f64([first(c) for c in v])


def _check_axis(plugin: str, end0: str, p0: Sequence[float], end1: str, p1: Sequence[float]) -> None:
    """Refuse an axis of no length."""
    if np.array_equal(np.asarray(p0, np.float32), np.asarray(p1, np.float32)):
        raise ParameterError(f'{plugin}: "{end0}" and "{end1}" are both {list(p0)}, but must be two points')
