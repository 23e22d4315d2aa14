"""The kinds of quadrics that ``mrt_whitted`` traces exactly, a class of pure functions each, and their table.

Everything works in float32 and float64, on scalars, Dr.Jit arrays and lists of columns alike (see
``intersect``). ``points`` place a quadric, followed by a radius: ``width`` numbers. ``parts`` are of its
surface, ``ends`` what is at both ends of its axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import drjit as dr
import drjit.scalar
import numpy as np

from .intersect import BASE, LATERAL, TOP, Frame, intersect_cone, intersect_cylinder, intersect_sphere

POINT, DISC, BALL = (0, 0, 0), (1, 1, 0), (1, 1, 1)
"""What the ends of a quadric are, by the squared semi-axes of their unit frame that span them."""

Hit = tuple[Any, Any]  # t in units of |d|, inf for a miss, and the part of the surface
SurfacePoint = tuple[Any, Any, Any, Any]  # on the surface; the outward unit normal; texture coordinates u, v

# Vertices [n, 8] in the unit frame: place, gradient that becomes the normal, and texture coordinates; faces
# [m, 3], counter-clockwise seen from outside in a right-handed frame
UnitMesh = tuple[np.ndarray, np.ndarray]


class Sphere:
    """A sphere of radius 1 around 0."""

    points, width = 1, 4
    parts, ends, closed = (LATERAL,), (BALL, BALL), True

    def frame(self, center: Any, radius: Any) -> Frame:
        """Return the unit frame of a sphere."""
        inverse = 1 / radius
        zero, make = 0 * inverse, type(center)
        rows = [inverse, zero, zero], [zero, inverse, zero], [zero, zero, inverse]
        return Frame(center, *map(make, rows))

    def intersect(self, o: Any, d: Any, frame: Frame) -> Hit:
        """Return the first hit at t > 0."""
        o = frame.point(o)
        return intersect_sphere(o, frame.vector(d), type(o)([0.0, 0.0, 0.0]), 1.0), LATERAL

    def surface(self, p: Any, part: Any, frame: Frame) -> SurfacePoint:
        """Put a point near the sphere onto it, along the normal.

        u = azimuth / 2π in [0, 1), v = angle to +z over π, as in Mitsuba's ``sphere``.
        """
        q = frame.point(p)
        r = dr.norm(q)
        at_center = r == 0
        gradient = q * (1 / dr.select(at_center, 1, r))
        g = frame.gradient(gradient)
        inverse = 1 / dr.select(at_center, 1, dr.norm(g))
        n = g * inverse
        v = dr.acos(dr.clip(gradient.z, -1, 1)) / dr.pi
        return p - n * ((r - 1) * inverse), n, _turn(q), v

    def derivatives(self, q: Any, part: Any) -> tuple[Any, Any]:
        """Return derivatives by u and v of a surface point ``q``, both in the unit frame."""
        r = dr.sqrt(dr.square(q.x) + dr.square(q.y))
        x, y = _azimuth(q, r)
        around = type(q)([-2 * dr.pi * q.y, 2 * dr.pi * q.x, 0 * q.x])
        return around, type(q)([q.z * x, q.z * y, -r]) * dr.pi

    def mesh(self, segments: int = 0) -> UnitMesh:
        """Return an octahedron, whatever ``segments``."""
        points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
        octants = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
        turned = [(sum(octant) % 2) == 1 for octant in octants]  # an odd number of mirrored axes
        faces = [octant[::-1] if turn else octant for octant, turn in zip(octants, turned, strict=True)]
        return np.hstack([points, points, np.zeros((6, 2))]), np.array(faces)


class Axial:
    """A solid of revolution along z from 0 to 1: a side, and a disc of radius 1 at each end that is one.

    ``slope``: what the radius of the side grows by from one end to the other. Without ``capped`` it is open.
    Texture coordinates: u = azimuth / 2π in [0, 1), v = 1 - z on the side, the unit square around a disc.
    """

    points, width, slope = 2, 7, 0
    parts: tuple[int, ...] = (LATERAL, BASE)
    ends = (DISC, DISC)

    def __init__(self, *, capped: bool = True) -> None:
        self.closed = capped

    def frame(self, p0: Any, p1: Any, radius: Any) -> Frame:
        """Return the frame whose z runs from p0 to p1; seen against it, u grows counter-clockwise.

        Source of the tangents: Duff et al., "Building an Orthonormal Basis, Revisited", 2017.
        """
        axis = p1 - p0
        length2 = dr.squared_norm(axis)
        n = axis / -dr.sqrt(length2)
        make = type(n)
        sign = dr.select(n.z >= 0, 1, -1)
        a = -1 / (sign + n.z)
        b = n.x * n.y * a
        s, t = make([1 + sign * n.x * n.x * a, sign * b, -sign * n.x]), make([b, sign + n.y * n.y * a, -n.y])
        return Frame(p0, s / radius, t / radius, axis / length2)

    def surface(self, p: Any, part: Any, frame: Frame) -> SurfacePoint:
        """Put a point near the given part onto it by a Newton step along the normal.

        At an apex the normal is that of one of the generatrices.
        """
        q = frame.point(p)
        r = dr.sqrt(dr.square(q.x) + dr.square(q.y))
        x, y = _azimuth(q, r)
        side = part == LATERAL
        on_base = True if TOP not in self.parts else part == BASE
        # The distance to the part, linear along its gradient
        off_disc = q.z - 1 if on_base is True else dr.select(on_base, q.z - 1, -q.z)
        off_side = r - q.z if self.slope else r - 1
        up = dr.select(side, -self.slope, dr.select(on_base, 1, -1))
        g = frame.gradient(type(q)([dr.select(side, x, 0), dr.select(side, y, 0), up]))
        inverse = 1 / dr.norm(g)
        n = g * inverse
        u = dr.select(side, _turn(q), 0.5 + 0.5 * q.x)
        v = dr.clip(dr.select(side, 1 - q.z, 0.5 + 0.5 * q.y), 0, 1)
        return p - n * (dr.select(side, off_side, off_disc) * inverse), n, u, v

    def derivatives(self, q: Any, part: Any) -> tuple[Any, Any]:
        """Return derivatives by u and v of a surface point ``q``, both in the unit frame."""
        side, zero = part == LATERAL, 0 * q.x
        x, y = _azimuth(q, dr.sqrt(dr.square(q.x) + dr.square(q.y)))
        around = -2 * dr.pi * q.y, 2 * dr.pi * q.x, zero
        along = -self.slope * x, -self.slope * y, -1 + zero
        by_u = [dr.select(side, a, b) for a, b in zip(around, (2 + zero, zero, zero), strict=True)]
        by_v = [dr.select(side, a, b) for a, b in zip(along, (zero, 2 + zero, zero), strict=True)]
        return type(q)(by_u), type(q)(by_v)


class Cone(Axial):
    """The apex at 0, the base disc at z = 1."""

    slope, ends = 1, (POINT, DISC)

    def intersect(self, o: Any, d: Any, frame: Frame) -> Hit:
        """Return the first hit at t > 0."""
        return intersect_cone(o, d, frame, capped=self.closed)

    def mesh(self, segments: int) -> UnitMesh:
        """Return a fan from the apex, with a vertex and a normal there for each triangle, and the base."""
        azimuth, i = 2 * np.pi * np.arange(segments + 1) / segments, np.arange(segments)
        apex = _ring(0.5 * (azimuth[1:] + azimuth[:-1]), 0.0, slope=-1.0, v=1.0, radius=0.0)
        faces = np.stack([i, i + segments + 1, i + 1], axis=1)
        side = np.concatenate([_ring(azimuth, 1.0, slope=-1.0, v=0.0), apex]), faces
        return _join(side, _disc(segments, 1.0)) if self.closed else side


class Cylinder(Axial):
    """Radius 1 from z = 0 to z = 1."""

    parts = (LATERAL, BASE, TOP)

    def intersect(self, o: Any, d: Any, frame: Frame) -> Hit:
        """Return the first hit at t > 0."""
        return intersect_cylinder(o, d, frame, capped=self.closed)

    def mesh(self, segments: int) -> UnitMesh:
        """Return a strip of quads split in two, and two discs."""
        azimuth, i = 2 * np.pi * np.arange(segments + 1) / segments, np.arange(segments)
        k = i + segments + 1
        rings = [_ring(azimuth, z, slope=0.0, v=1.0 - z) for z in (0.0, 1.0)]
        faces = np.concatenate([np.stack([i, i + 1, k], 1), np.stack([i + 1, k + 1, k], 1)])
        side = np.concatenate(rings), faces
        return _join(side, _disc(segments, 0.0), _disc(segments, 1.0)) if self.closed else side


KINDS: dict[str, Any] = {
    "sphere": Sphere(),
    "cone": Cone(),
    "open cone": Cone(capped=False),
    "cylinder": Cylinder(),
    "open cylinder": Cylinder(capped=False),
}


def _azimuth(q: Any, r: Any) -> tuple[Any, Any]:
    """Return cosine and sine of the azimuth of ``q`` at distance r from the axis; on the axis, those of 0."""
    on_axis = r == 0
    inverse = 1 / dr.select(on_axis, 1, r)
    return dr.select(on_axis, 1, q.x * inverse), q.y * inverse


def _turn(q: Any) -> Any:
    """Return the azimuth of ``q`` over 2π, in [0, 1)."""
    azimuth = dr.atan2(q.y, q.x) / (2 * dr.pi)
    return dr.select(azimuth < 0, azimuth + 1, azimuth)


def _ring(azimuth: np.ndarray, z: float, *, slope: float, v: float, radius: float = 1.0) -> np.ndarray:
    """Return vertices around the axis."""
    x, y, one = np.cos(azimuth), np.sin(azimuth), np.ones_like(azimuth)
    around = azimuth / (2 * np.pi)
    return np.stack([radius * x, radius * y, z * one, x, y, slope * one, around, v * one], axis=1)


def _disc(segments: int, z: float) -> UnitMesh:
    """Return a fan around the centre, facing away from z = 1/2."""
    rim = _ring(2 * np.pi * np.arange(segments) / segments, z, slope=0, v=0)
    vertices = np.concatenate([rim, [[0, 0, z, 0, 0, 0, 0, 0]]])
    vertices[:, 3:6], vertices[:, 6:] = (0, 0, 1 if z > 0.5 else -1), 0.5 + 0.5 * vertices[:, :2]
    i = np.arange(segments)
    faces = np.stack([i, (i + 1) % segments, np.full_like(i, segments)], axis=1)
    return vertices, faces if z > 0.5 else faces[:, ::-1]


def _join(*parts: UnitMesh) -> UnitMesh:
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


@dataclass(frozen=True)
class QuadricTable:
    """Objects of one kind, by their unit frames."""

    kind: str  # a key of KINDS
    origins: np.ndarray  # float64 [n, 3]
    rows: np.ndarray  # float64 [n, 3, 3]
    first_faces: np.ndarray  # int [n], of the stand-in of each, for textures that are looked up by face
    flipped: bool = False  # do the normals point inwards

    @classmethod
    def of_one(cls, kind: str, frame: Frame, *, flipped: bool = False) -> QuadricTable:
        """Return the table of a shape that is one object."""
        rows = np.array([[list(frame.x), list(frame.y), list(frame.z)]])
        return cls(kind, np.array([list(frame.origin)]), rows, np.zeros(1, int), flipped)

    @classmethod
    def of_numbers(
        cls, kind: str, numbers: np.ndarray, faces: int, place: Callable[[Frame], Frame], *, flipped: bool
    ) -> QuadricTable:
        """Return the table of objects given by ``numbers`` [n, width], moved by ``place``.

        ``faces``: number of those of the stand-in of each.
        """
        points = [Columns.of(numbers[:, 3 * k : 3 * k + 3]) for k in range(KINDS[kind].points)]
        frame = place(KINDS[kind].frame(*points, column(numbers[:, -1])))
        rows = np.stack([row.array() for row in (frame.x, frame.y, frame.z)], axis=1)
        return cls(kind, frame.origin.array(), rows, faces * np.arange(len(numbers)), flipped)

    def boxes(self) -> np.ndarray:
        """Return the bounding boxes [n, 2, 3]: of ellipsoids at both ends."""
        columns, kind = np.linalg.inv(self.rows), KINDS[self.kind]
        half = np.stack([np.sqrt((columns**2 * end).sum(axis=2)) for end in kind.ends], axis=1)
        axis = columns[:, :, 2] * (kind.points - 1)
        centers = np.stack([self.origins, self.origins + axis], axis=1)  # [n, end, 3]
        return np.stack([(centers - half).min(axis=1), (centers + half).max(axis=1)], axis=1)

    def numbers(self, kinds: list[str]) -> np.ndarray:
        """Return what a kernel for such kinds reads of each object, [n, 4, 4]: four numbers at a time.

        A row and a coordinate of the origin, three times; kind, size of coordinates, 0, side of the normal.
        """
        numbers = np.zeros((len(self.rows), 4, 4))
        numbers[:, :3, :3], numbers[:, :3, 3] = self.rows, self.origins
        numbers[:, 3, 0], numbers[:, 3, 1] = kinds.index(self.kind), np.abs(self.boxes()).max(axis=(1, 2))
        numbers[:, 3, 3] = -1 if self.flipped else 1
        return numbers

    def stand_in(self, unit: UnitMesh) -> dict[str, np.ndarray]:
        """Return the buffers of a mesh of all objects, each of them ``unit``; frames may be left-handed."""
        columns = np.linalg.inv(self.rows).transpose(0, 2, 1)
        vertices, faces = unit
        positions = vertices[:, :3] @ columns + self.origins[:, None]
        normals = vertices[:, 3:6] @ self.rows
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        faces = faces if np.linalg.det(self.rows[0]) > 0 else faces[:, ::-1]
        first = len(vertices) * np.arange(len(self.rows))
        return {
            "faces": (faces[None] + first[:, None, None]).astype(np.uint32).ravel(),
            "vertex_positions": positions.astype(np.float32).ravel(),
            "vertex_normals": normals.astype(np.float32).ravel(),
        }


class Columns(list):
    """Three columns, which Dr.Jit's ``dot``, ``norm`` and ``normalize`` take for a vector."""

    x, y, z = (property(itemgetter(k)) for k in range(3))

    @classmethod
    def of(cls, array: np.ndarray) -> Columns:
        """Return the float64 columns of an array [n, 3]."""
        return cls(column(array[:, k]) for k in range(3))

    def array(self) -> np.ndarray:
        """Return the array [n, 3] of the columns."""
        return np.stack([np.array(c) for c in self], axis=1)

    def __add__(self, other: Sequence[Any]) -> Columns:
        return Columns(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Sequence[Any]) -> Columns:
        return Columns(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor: Any) -> Columns:
        return Columns(a * factor for a in self)

    def __truediv__(self, divisor: Any) -> Columns:
        return self * (1 / divisor)


def column(values: np.ndarray) -> Any:
    """Return one column of float64 numbers."""
    return drjit.scalar.ArrayXf64(np.ascontiguousarray(values, np.float64))
