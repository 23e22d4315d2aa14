"""Ray intersections with analytic surfaces, as pure functions over points and directions.

Shared by the float32 plugins and the float64 reference: everything works on scalars and on Dr.Jit arrays of
any precision. A ray is ``o + t d``; distances are in units of |d|. A miss has ``t = inf``. Vectors may also
be lists of components with + and -, which is why a vector stands left of a scalar in products, and is never
selected as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr


def intersect_plane(o, d, normal, distance):
    """Return the distance t > 0 at which the ray meets the plane ``normal · P + distance = 0``; inf for none.

    The normal need not be a unit vector, only the ratio is used. Parallel rays miss.
    """
    height = dr.dot(normal, o) + distance
    slope = dr.dot(normal, d)
    towards = height * slope < 0
    return dr.select(towards, -height / dr.select(towards, slope, 1), dr.inf)


def intersect_sphere(o, d, center, radius):
    """Return the distance t > 0 at which the ray meets the sphere around ``center``; inf for none.

    Both roots without cancellation: the discriminant from the distance s of the line to the centre, as
    (r − s)(r + s), instead of b² − ac; the root that b ∓ √… would lose from the product of the roots, c/q;
    and c = |f|² − r² from its factors, so that an origin on the surface stays there.
    Source: Haines, Günther and Akenine-Möller, "Precision Improvements for Ray/Sphere Intersection", Ray
    Tracing Gems, 2019, ch. 7.
    """
    f = o - center
    a = dr.squared_norm(d)
    b = -dr.dot(f, d)
    s = dr.norm(f + d * (b / a))
    discriminant = (radius - s) * (radius + s)
    meets = discriminant >= 0
    root = dr.sqrt(a * dr.select(meets, discriminant, 0))
    ahead = b >= 0
    q = b + dr.select(ahead, root, -root)
    distance = dr.norm(f)
    c = (distance - radius) * (distance + radius)
    small = c / dr.select(q == 0, 1, q)
    large = q / a
    near = dr.select(ahead, small, large)
    far = dr.select(ahead, large, small)
    t = dr.select(near > 0, near, far)
    return dr.select(meets & (t > 0), t, dr.inf)


@dataclass
class Frame:
    """An affine map from world space to the unit frame of a shape: local = rows · (world − origin)."""

    origin: Any  # point
    x: Any  # rows of the matrix, vectors
    y: Any
    z: Any

    def point(self, p):
        """Return a world-space point in the unit frame."""
        return self.vector(p - self.origin)

    def vector(self, v):
        """Return a world-space vector in the unit frame."""
        return type(v)([dr.dot(self.x, v), dr.dot(self.y, v), dr.dot(self.z, v)])

    def to_world(self, v):
        """Return the world-space vector whose unit-frame components are ``v``: by the inverse matrix."""
        # Its columns are cross products of the rows
        column_x = _cross(self.y, self.z)
        column_y = _cross(self.z, self.x)
        column_z = _cross(self.x, self.y)
        inverse_volume = 1 / dr.dot(self.x, column_x)
        return (column_x * v.x + column_y * v.y + column_z * v.z) * inverse_volume

    def gradient(self, g):
        """Return the world-space gradient of a function, given that in the unit frame: by the transpose."""
        return self.x * g.x + self.y * g.y + self.z * g.z


def _cross(a, b):
    x = a.y * b.z - a.z * b.y
    y = a.z * b.x - a.x * b.z
    z = a.x * b.y - a.y * b.x
    return type(a)([x, y, z])


# Divisors are kept this far from zero; quotients of unit-frame numbers (< 1e6) stay finite in float32
TINY = 1e-30


def off_zero(x, least=TINY):
    """Return ``x``, or ``least`` with the same sign where it is smaller."""
    return dr.select(dr.abs(x) >= least, x, dr.select(x < 0, -least, least))
