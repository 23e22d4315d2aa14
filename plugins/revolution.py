"""Meshes of cone and cylinder in their unit frames, and their way into a Mitsuba mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .adapter import write_buffers
from .intersect import Frame
from .parameters import ParameterError, integer
from .variants import first

# From some thousand sides on the triangles are slivers, between which rays slip through; more help nobody
MOST_SEGMENTS = 65536


@dataclass(frozen=True)
class UnitMesh:
    """Vertices in the unit frame (see ``intersect``), with the gradient that becomes the normal of each."""

    points: np.ndarray  # float64 [N, 3]
    gradients: np.ndarray  # float64 [N, 3]
    uvs: np.ndarray  # float64 [N, 2]
    faces: np.ndarray  # uint32 [M, 3], counter-clockwise seen from outside in a right-handed frame


@dataclass(frozen=True)
class QuadricTable:
    """Objects of one kind, by their unit frames: what ``mrt_whitted`` needs to know of a shape."""

    kind: str  # a key of quadrics.KINDS
    origins: np.ndarray  # float64 [n, 3]
    rows: np.ndarray  # float64 [n, 3, 3]
    first_faces: np.ndarray  # int [n], of the stand-in of each, for textures that are looked up by face


def table_of(kind: str, capped: bool, frame: Frame) -> QuadricTable:
    """The table of a shape that is one object."""
    rows = np.array([[list(frame.x), list(frame.y), list(frame.z)]])
    return QuadricTable(
        kind if capped else f"open {kind}", np.array([list(frame.origin)]), rows, np.zeros(1, int)
    )


def unit_sphere_mesh() -> UnitMesh:
    """An octahedron."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    octants = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    turned = [(sum(octant) % 2) == 1 for octant in octants]  # an odd number of mirrored axes
    faces = [octant[::-1] if turn else octant for octant, turn in zip(octants, turned, strict=True)]
    return UnitMesh(points, points, np.zeros((6, 2)), np.array(faces, np.uint32))


def side_count(props: mi.Properties, default: int) -> int:
    """The parameter ``segments``: sides of a mesh."""
    return integer(props, "segments", default, least=3, most=MOST_SEGMENTS)


def unit_cone_mesh(segments: int, capped: bool) -> UnitMesh:
    """A fan from the apex, which has a vertex and a normal for each triangle, and the base disc."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    middle = 0.5 * (azimuth[1:] + azimuth[:-1])
    zero = np.zeros(segments)
    rim = _ring(azimuth, 1.0, slope=-1.0, v=0.0)
    apex = UnitMesh(
        np.zeros((segments, 3)),
        np.stack([np.cos(middle), np.sin(middle), zero - 1], axis=1),
        np.stack([middle / (2 * np.pi), zero + 1], axis=1),
        np.empty((0, 3), np.uint32),
    )
    i = np.arange(segments, dtype=np.uint32)
    side = _join([rim, apex], np.stack([i, i + segments + 1, i + 1], axis=1))
    return _join([side, _disc(segments, 1.0)]) if capped else side


def unit_cylinder_mesh(segments: int, capped: bool) -> UnitMesh:
    """A strip of quads split in two, and two discs."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    top, base = _ring(azimuth, 0.0, slope=0.0, v=1.0), _ring(azimuth, 1.0, slope=0.0, v=0.0)
    i = np.arange(segments, dtype=np.uint32)
    k = i + segments + 1
    quads = [np.stack([i, i + 1, k], axis=1), np.stack([i + 1, k + 1, k], axis=1)]
    side = _join([top, base], np.concatenate(quads))
    return _join([side, _disc(segments, 0.0), _disc(segments, 1.0)]) if capped else side


def _ring(azimuth: np.ndarray, z: float, *, slope: float, v: float) -> UnitMesh:
    x, y = np.cos(azimuth), np.sin(azimuth)
    points = np.stack([x, y, np.full_like(x, z)], axis=1)
    gradients = np.stack([x, y, np.full_like(x, slope)], axis=1)
    uvs = np.stack([azimuth / (2 * np.pi), np.full_like(x, v)], axis=1)
    return UnitMesh(points, gradients, uvs, np.empty((0, 3), np.uint32))


def _disc(segments: int, z: float) -> UnitMesh:
    """A fan around the centre, facing away from z = 1/2."""
    rim = _ring(2 * np.pi * np.arange(segments) / segments, z, slope=0, v=0)
    points = np.concatenate([rim.points, [[0, 0, z]]])
    i = np.arange(segments, dtype=np.uint32)
    faces = np.stack([i, (i + 1) % segments, np.full_like(i, segments)], axis=1)
    gradients = np.tile([0, 0, 1.0 if z > 0.5 else -1.0], (segments + 1, 1))
    return UnitMesh(points, gradients, 0.5 + 0.5 * points[:, :2], faces if z > 0.5 else faces[:, ::-1])


def _join(parts: Sequence[UnitMesh], more_faces: np.ndarray | None = None) -> UnitMesh:
    """One mesh of several; ``more_faces`` index the joined vertices."""
    first = np.cumsum([0] + [len(p.points) for p in parts])
    faces = [p.faces + np.uint32(start) for p, start in zip(parts, first, strict=False)]
    return UnitMesh(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.gradients for p in parts]),
        np.concatenate([p.uvs for p in parts]),
        np.concatenate(faces + ([] if more_faces is None else [more_faces])).astype(np.uint32),
    )


def fill(mesh: Any, unit: UnitMesh, frame: Frame) -> None:
    """Write a new mesh: positions and normals as ``frame`` places them, texture coordinates, faces."""
    rows = np.array([list(frame.x), list(frame.y), list(frame.z)], np.float64)
    flipped = np.linalg.det(rows) < 0
    positions = unit.points @ np.linalg.inv(rows).T + np.array(list(frame.origin))
    normals = unit.gradients @ rows
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    write_buffers(
        mesh,
        faces=(unit.faces[:, ::-1] if flipped else unit.faces).ravel(),
        vertex_texcoords=unit.uvs.astype(np.float32).ravel(),
        vertex_positions=positions.astype(np.float32).ravel(),
        vertex_normals=normals.astype(np.float32).ravel(),
    )


def refill(mesh: Any, unit: UnitMesh, frame: Frame) -> None:
    """Write positions and normals anew, differentiably with respect to what ``frame`` was made of."""
    rows = [mi.Vector3f(r) for r in (frame.x, frame.y, frame.z)]
    # The columns of the inverse matrix are cross products of its rows
    volume = dr.dot(rows[0], dr.cross(rows[1], rows[2]))
    columns = [dr.cross(rows[k - 2], rows[k - 1]) / volume for k in range(3)]
    position, normal = mi.Point3f(frame.origin), mi.Vector3f(0)
    for k in range(3):
        position += columns[k] * mi.Float(unit.points[:, k])
        normal += rows[k] * mi.Float(unit.gradients[:, k])
    write_buffers(mesh, vertex_positions=dr.ravel(position), vertex_normals=dr.ravel(dr.normalize(normal)))


class Placement:
    """What ``to_world`` does to frames. Raises ``ParameterError`` for one that flattens space."""

    def __init__(self, props: mi.Properties) -> None:
        matrix = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, np.float64)
        self.linear, self.offset = matrix[:3, :3], matrix[:3, 3].tolist()
        if not np.isfinite(matrix).all() or abs(np.linalg.det(self.linear)) == 0:
            raise ParameterError(
                f'{props.plugin_name()}: "to_world" is not invertible; remove its zero scale'
            )
        self.inverse = np.linalg.inv(self.linear).tolist()
        self.linear = self.linear.tolist()

    def __call__(self, frame: Frame) -> Frame:
        """The frame of the moved shape; works for vectors of any type."""

        def row(v: Any) -> Any:
            return type(v)([sum(v[i] * self.inverse[i][j] for i in range(3)) for j in range(3)])

        o = frame.origin
        origin = [
            sum(m * c for m, c in zip(self.linear[i], o, strict=True)) + self.offset[i] for i in range(3)
        ]
        return Frame(type(o)(origin), row(frame.x), row(frame.y), row(frame.z))


def vector64(v: Any) -> Any:
    """Three numbers, or a point or vector of one entry, in double precision."""
    return dr.scalar.Array3f64([first(c) for c in v])


def check_axis(plugin: str, end0: str, p0: Sequence[float], end1: str, p1: Sequence[float]) -> None:
    """Refuse an axis of no length."""
    if np.array_equal(np.asarray(p0, np.float32), np.asarray(p1, np.float32)):
        raise ParameterError(f'{plugin}: "{end0}" and "{end1}" are both {list(p0)}, but must be two points')
