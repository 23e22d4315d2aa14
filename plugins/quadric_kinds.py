"""The kinds of quadrics that ``mrt_whitted`` traces exactly, as pure functions, and their table.

Everything works in float32 and float64, on scalars, Dr.Jit arrays and lists of columns alike (see
``intersect``). The numbers of a quadric are those of its points, as many as ``points``, and a radius.
``parts`` are those of its surface, ``ends`` the shapes at both ends of its axis.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import drjit as dr
import drjit.scalar
import numpy as np

from .intersect import BASE, LATERAL, TOP, Frame, intersect_cone, intersect_cylinder, intersect_sphere

# The shapes at the ends of a quadric, by the squares of their semi-axes in the unit frame
POINT = (0, 0, 0)
DISC = (1, 1, 0)
BALL = (1, 1, 1)

# Vertices [n, 8] in the unit frame: place, gradient that becomes the normal, and texture coordinates; faces
# [m, 3], counter-clockwise seen from outside in a right-handed frame
UnitMesh = tuple[np.ndarray, np.ndarray]


class Sphere:
    """A sphere of radius 1 around 0."""

    points = 1
    parts = (LATERAL,)
    ends = (BALL, BALL)
    closed = True

    def frame(self, center, radius) -> Frame:
        """Return the unit frame of a sphere."""
        inverse = 1 / radius
        zero = 0 * inverse
        make = type(center)
        x = make([inverse, zero, zero])
        y = make([zero, inverse, zero])
        z = make([zero, zero, inverse])
        return Frame(center, x, y, z)

    def intersect(self, o, d, frame: Frame):
        """Return t > 0 of the first hit in units of |d|, inf for a miss, and the part that is hit."""
        o = frame.point(o)
        center = type(o)([0.0, 0.0, 0.0])
        return intersect_sphere(o, frame.vector(d), center, 1.0), LATERAL

    def surface(self, p, part, frame: Frame):
        """Put a point near the sphere onto it, along the normal.

        Returns the point, the outward unit normal and the texture coordinates:
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

    def derivatives(self, q, part):
        """Return derivatives by u and v of a surface point ``q``, both in the unit frame."""
        r = dr.sqrt(dr.square(q.x) + dr.square(q.y))
        x, y = _azimuth(q, r)
        make = type(q)
        around = make([-2 * dr.pi * q.y, 2 * dr.pi * q.x, 0 * q.x])
        along = make([q.z * x, q.z * y, -r])
        return around, along * dr.pi

    def mesh(self, segments: int = 0) -> UnitMesh:
        """Return an octahedron, whatever ``segments``."""
        points = np.repeat(np.eye(3), 2, axis=0)  # each axis, forwards and backwards
        points[1::2] = 0 - points[1::2]
        faces = []
        for octant in itertools.product((0, 1), (2, 3), (4, 5)):
            mirrored = sum(octant) % 2 == 1  # along an odd number of axes
            faces.append(octant[::-1] if mirrored else octant)
        return np.hstack([points, points, np.zeros((6, 2))]), np.array(faces)


@dataclass(frozen=True)
class Axial:
    """A solid of revolution along z from 0 to 1, with a radius of 1 at z = 1: a side, and discs at its ends.

    Its side is straight: its radius grows by ``slope``, 0 or 1, and the hull of both ``ends`` bounds it. A
    kind with another profile overrides ``surface`` and ``derivatives``, and has ends whose hull contains it.

    Texture coordinates: u = azimuth / 2π in [0, 1), v = 1 - z on the side, the unit square around a disc.
    """

    first_hit: Callable  # of a ray in world space, as ``intersect_cone`` gives it
    side: Callable[[int], UnitMesh]  # the mesh of the side, from the number of segments
    slope: int  # how much the radius of the side grows from z = 0 to z = 1
    parts: tuple[int, ...]
    ends: tuple[tuple[int, ...], tuple[int, ...]]
    closed: bool = True  # with discs

    points = 2

    def intersect(self, o, d, frame: Frame):
        """Return t > 0 of the first hit in units of |d|, inf for a miss, and the part that is hit."""
        return self.first_hit(o, d, frame, capped=self.closed)

    def mesh(self, segments: int) -> UnitMesh:
        """Return the side, and the discs of a closed one."""
        ends = enumerate(self.ends) if self.closed else ()
        return _join(self.side(segments), *(_disc(segments, z) for z, end in ends if end == DISC))

    def frame(self, p0, p1, radius) -> Frame:
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
        s = make([1 + sign * n.x * n.x * a, sign * b, -sign * n.x])
        t = make([b, sign + n.y * n.y * a, -n.y])
        return Frame(p0, s / radius, t / radius, axis / length2)

    def surface(self, p, part, frame: Frame):
        """Put a point near the given part onto it by a Newton step along the normal.

        ``frame``: to the quadric's own coordinates. Returns (point, outward unit normal, u, v). At an apex
        the normal is that of one of the generatrices.
        """
        q = frame.point(p)
        r = dr.sqrt(dr.square(q.x) + dr.square(q.y))
        x, y = _azimuth(q, r)
        side = part == LATERAL
        on_base = part == BASE
        # The distance to the part, linear along its gradient
        off_disc = dr.select(on_base, q.z - 1, -q.z)
        off_side = r - q.z if self.slope else r - 1
        up = dr.select(side, -self.slope, dr.select(on_base, 1, -1))
        gradient = type(q)([dr.select(side, x, 0), dr.select(side, y, 0), up])
        g = frame.gradient(gradient)
        inverse = 1 / dr.norm(g)
        n = g * inverse
        u = dr.select(side, _turn(q), 0.5 + 0.5 * q.x)
        v = dr.select(side, 1 - q.z, 0.5 + 0.5 * q.y)
        distance = dr.select(side, off_side, off_disc) * inverse
        return p - n * distance, n, u, dr.clip(v, 0, 1)

    def derivatives(self, q, part):
        """Return derivatives by u and v of a surface point ``q``, both in the unit frame."""
        side = part == LATERAL
        zero = 0 * q.x
        r = dr.sqrt(dr.square(q.x) + dr.square(q.y))
        x, y = _azimuth(q, r)
        around = -2 * dr.pi * q.y, 2 * dr.pi * q.x, zero
        along = -self.slope * x, -self.slope * y, -1 + zero
        by_u = [dr.select(side, a, b) for a, b in zip(around, (2 + zero, zero, zero), strict=True)]
        by_v = [dr.select(side, a, b) for a, b in zip(along, (zero, 2 + zero, zero), strict=True)]
        return type(q)(by_u), type(q)(by_v)


def fan(segments: int) -> UnitMesh:
    """Return the side of a cone: a vertex and a normal at the apex for each triangle."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    between = 0.5 * (azimuth[1:] + azimuth[:-1])
    i = np.arange(segments)
    faces = np.stack([i, i + segments + 1, i + 1], axis=1)
    return np.concatenate([_ring(azimuth, 1, slope=1), _ring(between, 0, slope=1)]), faces


def strip(segments: int) -> UnitMesh:
    """Return the side of a cylinder: quads, each split in two."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    i = np.arange(segments)
    k = i + segments + 1
    lower = np.stack([i, i + 1, k], axis=1)
    upper = np.stack([i + 1, k + 1, k], axis=1)
    return np.concatenate([_ring(azimuth, 0), _ring(azimuth, 1)]), np.concatenate([lower, upper])


_CONE = Axial(intersect_cone, fan, slope=1, parts=(LATERAL, BASE), ends=(POINT, DISC))
_CYLINDER = Axial(intersect_cylinder, strip, slope=0, parts=(LATERAL, BASE, TOP), ends=(DISC, DISC))

KINDS: dict[str, Any] = {
    "sphere": Sphere(),
    "cone": _CONE,
    "open cone": replace(_CONE, closed=False),
    "cylinder": _CYLINDER,
    "open cylinder": replace(_CYLINDER, closed=False),
}
CLOSED = tuple(name for name, kind in KINDS.items() if kind.closed)  #: those that a group may hold


def _azimuth(q, r):
    """Return cosine and sine of the azimuth of ``q`` at distance r from the axis; on the axis, those of 0."""
    on_axis = r == 0
    inverse = 1 / dr.select(on_axis, 1, r)
    return dr.select(on_axis, 1, q.x * inverse), q.y * inverse


def _turn(q):
    """Return the azimuth of ``q`` over 2π, in [0, 1)."""
    azimuth = dr.atan2(q.y, q.x) / (2 * dr.pi)
    return dr.select(azimuth < 0, azimuth + 1, azimuth)


def _ring(azimuth: np.ndarray, z: int, *, slope: int = 0) -> np.ndarray:
    """Return vertices around the axis, on a side whose radius is 1 at z = 1 and grows by ``slope``."""
    x = np.cos(azimuth)
    y = np.sin(azimuth)
    one = np.ones_like(azimuth)
    radius = 1 - slope * (1 - z)
    u = azimuth / (2 * np.pi)
    return np.stack([radius * x, radius * y, z * one, x, y, -slope * one, u, (1 - z) * one], axis=1)


def _disc(segments: int, z: int) -> UnitMesh:
    """Return a fan around the centre, facing away from z = 1/2."""
    i = np.arange(segments)
    rim = _ring(2 * np.pi * i / segments, z)
    center = [0, 0, z, 0, 0, 0, 0, 0]
    vertices = np.concatenate([rim, [center]])
    vertices[:, 3:6] = 0, 0, 1 if z == 1 else -1
    vertices[:, 6:] = 0.5 + 0.5 * vertices[:, :2]
    faces = np.stack([i, (i + 1) % segments, np.full_like(i, segments)], axis=1)
    return vertices, faces if z == 1 else faces[:, ::-1]


def _join(*parts: UnitMesh) -> UnitMesh:
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


class QuadricTable:
    """Objects of one kind, by their unit frames, and the mesh that stands for each."""

    def __init__(
        self,
        kind: str,
        numbers: np.ndarray,
        place: Callable[[Frame], Frame],
        unit: UnitMesh,
        *,
        flipped: bool,
    ) -> None:
        """Read the ``numbers`` of the objects, float64 [n, width], and move each by ``place``.

        ``unit``: the stand-in in the unit frame. ``flipped``: the normals point inwards.
        """
        points = [Columns.of(numbers[:, 3 * k : 3 * k + 3]) for k in range(KINDS[kind].points)]
        frame = place(KINDS[kind].frame(*points, column(numbers[:, -1])))
        self.kind = kind
        self.unit = unit
        self.flipped = flipped
        self.origins = frame.origin.array()  # float64 [n, 3]
        self.rows = np.stack([row.array() for row in (frame.x, frame.y, frame.z)], axis=1)  # [n, 3, 3]
        #: the first face of each stand-in, int [n], for textures that are looked up by face
        self.first_faces = len(unit[1]) * np.arange(len(numbers))

    def boxes(self) -> np.ndarray:
        """Return the bounding boxes [n, 2, 3]: of ellipsoids at both ends."""
        columns = np.linalg.inv(self.rows)
        kind = KINDS[self.kind]
        half = np.stack([np.sqrt((columns**2 * end).sum(axis=2)) for end in kind.ends], axis=1)
        axis = columns[:, :, 2] * (kind.points - 1)
        centers = np.stack([self.origins, self.origins + axis], axis=1)  # [n, end, 3]
        low = (centers - half).min(axis=1)
        high = (centers + half).max(axis=1)
        return np.stack([low, high], axis=1)

    def numbers(self, kinds: list[str]) -> np.ndarray:
        """Return the numbers that a kernel for such kinds reads of each object, [n, 4, 4]: four at a time.

        A row and a coordinate of the origin, three times; kind, size of coordinates, 0, side of the normal.
        """
        numbers = np.zeros((len(self.rows), 4, 4))
        numbers[:, :3, :3] = self.rows
        numbers[:, :3, 3] = self.origins
        numbers[:, 3, 0] = kinds.index(self.kind)
        numbers[:, 3, 1] = np.abs(self.boxes()).max(axis=(1, 2))
        numbers[:, 3, 3] = -1 if self.flipped else 1
        return numbers

    def proxy_mesh(self) -> dict[str, np.ndarray]:
        """Return the buffers of a mesh of all objects; frames may be left-handed."""
        columns = np.linalg.inv(self.rows).transpose(0, 2, 1)
        vertices, faces = self.unit
        positions = vertices[:, :3] @ columns + self.origins[:, None]
        normals = vertices[:, 3:6] @ self.rows
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        faces = faces if np.linalg.det(self.rows[0]) > 0 else faces[:, ::-1]
        first = len(vertices) * np.arange(len(self.rows))
        every = faces[None] + first[:, None, None]  # [n, faces, 3]
        return {
            "faces": every.astype(np.uint32).ravel(),
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

    def __add__(self, other) -> Columns:
        return Columns(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other) -> Columns:
        return Columns(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor) -> Columns:
        return Columns(a * factor for a in self)

    def __truediv__(self, divisor) -> Columns:
        return self * (1 / divisor)


def column(values: np.ndarray):
    """Return one column of float64 numbers."""
    return drjit.scalar.ArrayXf64(np.ascontiguousarray(values, np.float64))
