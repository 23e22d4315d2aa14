"""The kinds of quadrics that ``mrt_whitted`` traces exactly, as pure functions: a row of ``KINDS`` each.

Everything works in float32 and float64, on scalars, Dr.Jit arrays and lists of columns alike (see
``intersect``). The numbers of a quadric are those of its points, as many as ``points``, and a radius.

A quadric is intersected in its unit frame, to which a ``Frame`` maps world space: a solid of revolution lies
between z = 0 and z = 1, where its radius is 1; a sphere of radius 1 around 0. The map is affine, so it
changes neither t nor what is hit, and sizes, aspect ratios and shears are gone before anything is squared.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from .intersect import TINY, Frame, intersect_sphere, off_zero

LATERAL, BASE, TOP = 0, 1, 2
"""Parts of a surface: the curved side, the disc at z = 1, the disc at z = 0 (of a cylinder)."""

# Ellipsoids around both ends of the axis, by the squares of their semi-axes in the unit frame
POINT = (0, 0, 0)
DISC = (1, 1, 0)
BALL = (1, 1, 1)

# Vertices [n, 8] in the unit frame: place, gradient that becomes the normal, and texture coordinates; faces
# [m, 3], counter-clockwise seen from outside in a right-handed frame
UnitMesh = tuple[np.ndarray, np.ndarray]

MAX_RINGS = 256  # of the mesh of a curved side


class Sphere:
    """A sphere of radius 1 around 0."""

    points = 1
    hull = (BALL, BALL)
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

        Returns the point, the outward unit normal, the texture coordinates u = azimuth / 2π in [0, 1) and
        v = angle to +z over π, as in Mitsuba's ``sphere``, and the derivatives by both in the unit frame.
        """
        q = frame.point(p)
        make = type(q)
        r = dr.norm(q)
        gradient = q * (1 / r)
        g = frame.gradient(gradient)
        inverse = 1 / dr.norm(g)
        n = g * inverse
        v = dr.acos(dr.clip(gradient.z, -1, 1)) / dr.pi
        across, x, y = _polar(q)
        around = make([-2 * dr.pi * q.y, 2 * dr.pi * q.x, 0 * q.x])
        along = make([q.z * x, q.z * y, -across]) * dr.pi
        return p - n * ((r - 1) * inverse), n, _turn(q), v, around, along

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
    """A convex solid of revolution along z from 0 to 1: a side, and a disc at each end that is no apex.

    Texture coordinates: u = azimuth / 2π in [0, 1), v = 1 - z on the side, the unit square around a disc.
    """

    #: the interval [near, far] of s in which a line p + s u is inside the endless quadric, and whether there
    #: is one; |u| = 1, p · u = 0
    interval: Callable
    #: of distance r from the axis and z: a function that is 0 on the side and < 0 inside, and its derivatives
    side: Callable
    outline: Callable  # z and radius, from an end of the side (0) to the other (1)
    hull: tuple[tuple[float, ...], ...]  # ellipsoids at both ends in whose convex hull it is
    curved: bool = False  # the outline is no straight line
    closed: bool = True  # with discs

    points = 2

    @property
    def apex(self) -> bool:
        """Whether the side ends in a point at z = 0."""
        return self.outline(0.0)[1] == 0

    @property
    def parts(self) -> tuple[int, ...]:
        """The parts of the surface of a closed one."""
        return (LATERAL, BASE) if self.apex else (LATERAL, BASE, TOP)

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

    def intersect(self, o, d, frame: Frame):
        """Return t > 0 of the first hit in units of |d|, inf for a miss, and the part that is hit.

        Seen from inside, the far side is met. The solid is convex: a line is inside it for one interval. It
        is cut out of that inside the endless quadric by the slab between the discs, so no ray slips through
        between two surfaces, at a rim or an apex.
        """
        p, u, t_of = _line(frame.point(o), frame.vector(d))
        near, far, inside = self.interval(p, u)
        down = u.z > 0
        to_base = (1 - p.z) / off_zero(u.z)
        # At an apex, the side is the end
        to_top = dr.select(down, -dr.inf, dr.inf) if self.apex else -p.z / off_zero(u.z)
        level = u.z == 0
        inside = inside & dr.select(level, (p.z >= 0) & (p.z <= 1), True)
        enter = dr.select(level, -dr.inf, dr.minimum(to_top, to_base))
        leave = dr.select(level, dr.inf, dr.maximum(to_top, to_base))
        near_part = dr.select(enter > near, dr.select(down, TOP, BASE), LATERAL)
        far_part = dr.select(leave < far, dr.select(down, BASE, TOP), LATERAL)
        near = dr.maximum(near, enter)
        far = dr.minimum(far, leave)
        inside = inside & (near <= far)
        near_t = t_of(near)
        far_t = t_of(far)
        if not self.closed:
            near_t = dr.select(near_part == LATERAL, near_t, -dr.inf)
            far_t = dr.select(far_part == LATERAL, far_t, -dr.inf)
        from_outside = near_t > 0
        t = dr.select(from_outside, near_t, far_t)
        part = dr.select(from_outside, near_part, far_part)
        return dr.select(inside & (t > 0), t, dr.inf), part

    def surface(self, p, part, frame: Frame):
        """Put a point near the given part onto it by a Newton step along the normal.

        ``frame``: to the quadric's own coordinates. Returns (point, outward unit normal, u, v), and the
        derivatives by u and v in the unit frame. At the apex of a cone the normal is that of one of the
        generatrices.
        """
        q = frame.point(p)
        make = type(q)
        r, x, y = _polar(q)
        side = part == LATERAL
        on_base = part == BASE
        off_side, by_r, by_z = self.side(r, q.z)
        off_disc = dr.select(on_base, q.z - 1, -q.z)
        up = dr.select(side, by_z, dr.select(on_base, 1, -1))
        g = frame.gradient(make([dr.select(side, by_r * x, 0), dr.select(side, by_r * y, 0), up]))
        inverse = 1 / dr.norm(g)
        n = g * inverse
        distance = dr.select(side, off_side, off_disc) * inverse
        u = dr.select(side, _turn(q), 0.5 + 0.5 * q.x)
        v = dr.select(side, 1 - q.z, 0.5 + 0.5 * q.y)
        narrowing = by_z / off_zero(by_r)  # of the radius, by v
        around = make([dr.select(side, -2 * dr.pi * q.y, 2), dr.select(side, 2 * dr.pi * q.x, 0), 0 * q.x])
        along = [dr.select(side, narrowing * x, 0), dr.select(side, narrowing * y, 2), dr.select(side, -1, 0)]
        return p - n * distance, n, u, dr.clip(v, 0, 1), around, make(along)

    def mesh(self, segments: int) -> UnitMesh:
        """Return the bands of the side, and the discs of a closed one."""
        steps = min(segments // 2, MAX_RINGS) if self.curved else 1
        z, radius = self.outline(np.linspace(0, 1, steps + 1)[:, None])  # [rings, 1]
        _, by_r, by_z = self.side(radius, z)
        vertices, faces = _bands(segments, z, radius, by_r, by_z)
        for end in self.parts[1:] if self.closed else ():
            up = 1 if end == BASE else -1
            disc, fan = _bands(segments, max(up, 0), np.array([[1], [0]]), 0, up)
            disc[:, 6:] = 0.5 + 0.5 * disc[:, :2]
            fan = np.minimum(fan, segments + 1)[:, ::up]  # all around one centre
            faces = np.concatenate([faces, fan + len(vertices)])
            vertices = np.concatenate([vertices, disc[: segments + 2]])
        return vertices, faces


def _bands(segments: int, z, radius: np.ndarray, by_r, by_z) -> UnitMesh:
    """Return rings around the axis, joined by triangles; ``radius`` and what is not the same: [rings, 1]."""
    # In a point, each triangle has a vertex and a normal of its own
    turn = (np.arange(segments + 1) - 0.5 * (radius == 0)) / segments
    x = np.cos(2 * np.pi * turn)
    y = np.sin(2 * np.pi * turn)
    columns = radius * x, radius * y, z, by_r * x, by_r * y, by_z, turn, 1 - z
    vertices = np.stack(np.broadcast_arrays(*columns), axis=-1)
    k = np.arange(turn.size).reshape(turn.shape)
    lower = np.stack([k[:-1, :-1], k[:-1, 1:], k[1:, :-1]], axis=-1)
    upper = np.stack([k[1:, :-1], k[:-1, 1:], k[1:, 1:]], axis=-1)
    is_point = radius[:, 0] == 0
    faces = np.concatenate([lower[~is_point[:-1]], upper[~is_point[1:]]])
    return vertices.reshape(-1, 8), faces.reshape(-1, 3)


def inside_cone(p, u):
    """Return the interval of a line inside x² + y² = z², z >= 0, as ``Axial.interval``.

    With ⟨a, b⟩ = a.x b.x + a.y b.y − a.z b.z, the surface is at the roots of ⟨u,u⟩ s² + 2⟨p,u⟩ s + ⟨p,p⟩.
    Their discriminant is written as m.x² + m.y² − m.z² with the line's moment m = p × u (Lagrange's
    identity), so that it is accurate relative to |p|², and p · u = 0 makes ⟨p,u⟩ = −2 p.z u.z.
    """
    rho = dr.sqrt(dr.square(u.x) + dr.square(u.y))
    r = dr.sqrt(dr.square(p.x) + dr.square(p.y))
    a = (rho - dr.abs(u.z)) * (rho + dr.abs(u.z))
    half_b = -2 * p.z * u.z
    c = (r - dr.abs(p.z)) * (r + dr.abs(p.z))
    m_x = p.y * u.z - p.z * u.y
    m_y = p.z * u.x - p.x * u.z
    m_z = dr.abs(p.x * u.y - p.y * u.x)
    m_xy = dr.sqrt(dr.square(m_x) + dr.square(m_y))
    discriminant = (m_xy - m_z) * (m_xy + m_z)
    first, second = roots(a, half_b, c, discriminant)
    # Steeper than the side: the line is inside each half of the double cone once, up to or from infinity.
    # Shallower: both roots are on the half on whose side of the apex p is
    steep = a <= 0
    down = u.z > 0
    near = dr.select(steep, dr.select(down, second, -dr.inf), first)
    far = dr.select(steep, dr.select(down, dr.inf, first), second)
    return near, far, steep | ((discriminant >= 0) & (p.z > 0))


def inside_cylinder(p, u):
    """Return the interval of a line inside x² + y² = 1, as ``Axial.interval``.

    As ``inside_cone``, for the form a.x b.x + a.y b.y: the discriminant is ρ² − (p × u).z², ρ² = u.x² + u.y².
    """
    rho = dr.sqrt(dr.square(u.x) + dr.square(u.y))
    r = dr.sqrt(dr.square(p.x) + dr.square(p.y))
    moment = dr.abs(p.x * u.y - p.y * u.x)
    discriminant = (rho - moment) * (rho + moment)
    first, second = roots(dr.square(rho), p.x * u.x + p.y * u.y, (r - 1) * (r + 1), discriminant)
    along = rho == 0
    near = dr.select(along, -dr.inf, first)
    far = dr.select(along, dr.inf, second)
    return near, far, dr.select(along, r <= 1, discriminant >= 0)


def roots(a, half_b, c, discriminant):
    """Return the roots of a s² + 2 half_b s + c in ascending order. Where a vanishes it counts as just
    below 0, and one of them is huge.

    Source: the cancellation-free form, e.g. Press et al., Numerical Recipes, §5.6.
    """
    root = dr.sqrt(dr.maximum(discriminant, 0))
    q = dr.select(half_b >= 0, -half_b - root, root - half_b)
    one = q / dr.select(a == 0, -TINY, a)
    other = c / off_zero(q)
    return dr.minimum(one, other), dr.maximum(one, other)


_CONE = Axial(
    interval=inside_cone,
    side=lambda r, z: (r - z, 1, -1),
    outline=lambda s: (s, s),
    hull=(POINT, DISC),
)
_CYLINDER = Axial(
    interval=inside_cylinder,
    side=lambda r, z: (r - 1, 1, 0),
    outline=lambda s: (s, s**0),
    hull=(DISC, DISC),
)

KINDS: dict[str, Any] = {
    "sphere": Sphere(),
    "cone": _CONE,
    "open cone": replace(_CONE, closed=False),
    "cylinder": _CYLINDER,
    "open cylinder": replace(_CYLINDER, closed=False),
}
CLOSED = tuple(name for name, kind in KINDS.items() if kind.closed)  #: those that a group may hold


def _polar(q):
    """Return the distance of ``q`` from the axis, cosine and sine of its azimuth; on the axis, those of 0."""
    r = dr.sqrt(dr.square(q.x) + dr.square(q.y))
    on_axis = r == 0
    inverse = 1 / dr.select(on_axis, 1, r)
    return r, dr.select(on_axis, 1, q.x * inverse), q.y * inverse


def _turn(q):
    """Return the azimuth of ``q`` over 2π, in [0, 1)."""
    azimuth = dr.atan2(q.y, q.x) / (2 * dr.pi)
    return dr.select(azimuth < 0, azimuth + 1, azimuth)


def _line(o, d):
    """Return p and u of the ray's line p + s u, |u| = 1 and p · u = 0, and the function that maps s to t."""
    length = dr.norm(d)
    u = d / length
    along = dr.dot(o, u)
    p = type(d)(o) - u * along
    rest = dr.dot(p, u)  # from far away, the rounding of the first step is not small against the shape

    def t_of(s):
        return (s - (along + rest)) / length

    return p - u * rest, u, t_of
