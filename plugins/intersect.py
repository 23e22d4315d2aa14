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


# ------------------------------------ Quadrics of revolution ------------------------------------------
#
# A quadric is intersected in its unit frame, to which a ``Frame`` maps world space: a cone has its apex at 0
# and its base disc of radius 1 at z = 1, a cylinder of radius 1 lies between z = 0 and z = 1, a sphere of
# radius 1 around 0. The map is affine, so it changes neither t nor what is hit, and sizes, aspect ratios and
# shears are gone before anything is squared.
#
# The solid is convex: a line is inside it for one interval. It is cut out of the interval inside the infinite
# quadric by the slab between the caps, so no ray slips through between two surfaces, at a rim or an apex.

LATERAL, BASE, TOP = 0, 1, 2
"""Parts of a surface: the curved side, the disc at z = 1, the disc at z = 0 (of a cylinder)."""

# Divisors are kept this far from zero; quotients of unit-frame numbers (< 1e6) stay finite in float32
_TINY = 1e-30


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


def intersect_cone(o, d, frame: Frame, *, capped: bool = True):
    """Return the first hit at t > 0 of a ray with a cone: lateral surface and, if ``capped``, base disc.

    Seen from inside, the far side is met. With p the point of the line nearest to the apex, u its unit
    direction and ⟨a, b⟩ = a.x b.x + a.y b.y − a.z b.z, the lateral surface is at the roots of ⟨u,u⟩ s² +
    2⟨p,u⟩ s + ⟨p,p⟩. Their discriminant is written as m.x² + m.y² − m.z² with the line's moment m = p × u
    (Lagrange's identity), so that it is accurate relative to |p|², and p · u = 0 makes ⟨p,u⟩ = −2 p.z u.z.
    """
    p, u, t_of = _line(o, d, frame)
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
    first, second = _roots(a, half_b, c, discriminant)
    # Steeper than the side: the line is inside each half of the double cone once, up to or from infinity.
    # Shallower: both roots are on the half on whose side of the apex p is
    steep = a <= 0
    down = u.z > 0
    near = dr.select(steep, dr.select(down, second, -dr.inf), first)
    far = dr.select(steep, dr.select(down, dr.inf, first), second)
    inside = steep | ((discriminant >= 0) & (p.z > 0))
    # The slab has one side only, z <= 1; the apex is the other
    to_base = (1 - p.z) / off_zero(u.z)
    level = u.z == 0
    enter_base = dr.select(level | down, -dr.inf, to_base)
    leave_base = dr.select(level | (u.z < 0), dr.inf, to_base)
    inside = inside & dr.select(level, p.z <= 1, True)
    near_part = dr.select(enter_base > near, BASE, LATERAL)
    far_part = dr.select(leave_base < far, BASE, LATERAL)
    near = dr.maximum(near, enter_base)
    far = dr.minimum(far, leave_base)
    return _first_boundary(t_of, inside, near, near_part, far, far_part, capped)


def intersect_cylinder(o, d, frame: Frame, *, capped: bool = True):
    """Return the first hit at t > 0 of a ray with a cylinder: lateral surface and, if ``capped``, two discs.

    As ``intersect_cone``, for the form a.x b.x + a.y b.y: the discriminant is ρ² − (p × u).z², ρ² = u.x² +
    u.y².
    """
    p, u, t_of = _line(o, d, frame)
    rho = dr.sqrt(dr.square(u.x) + dr.square(u.y))
    r = dr.sqrt(dr.square(p.x) + dr.square(p.y))
    moment = dr.abs(p.x * u.y - p.y * u.x)
    discriminant = (rho - moment) * (rho + moment)
    first, second = _roots(dr.square(rho), p.x * u.x + p.y * u.y, (r - 1) * (r + 1), discriminant)
    along = rho == 0
    near = dr.select(along, -dr.inf, first)
    far = dr.select(along, dr.inf, second)
    inside = dr.select(along, r <= 1, discriminant >= 0)
    level = u.z == 0
    inside = inside & dr.select(level, (p.z >= 0) & (p.z <= 1), True)
    to_top = -p.z / off_zero(u.z)
    to_base = (1 - p.z) / off_zero(u.z)
    down = u.z > 0
    enter = dr.select(level, -dr.inf, dr.minimum(to_top, to_base))
    leave = dr.select(level, dr.inf, dr.maximum(to_top, to_base))
    near_part = dr.select(enter > near, dr.select(down, TOP, BASE), LATERAL)
    far_part = dr.select(leave < far, dr.select(down, BASE, TOP), LATERAL)
    near = dr.maximum(near, enter)
    far = dr.minimum(far, leave)
    return _first_boundary(t_of, inside, near, near_part, far, far_part, capped)


def _line(o, d, frame: Frame):
    """Return a ray's line in the unit frame: p, u of s ↦ p + s u with |u| = 1, p · u = 0; and t of s."""
    o = frame.point(o)
    d = frame.vector(d)
    length = dr.norm(d)
    u = d / length
    along = dr.dot(o, u)
    p = type(d)(o) - u * along
    rest = dr.dot(p, u)  # from far away, the rounding of the first step is not small against the shape

    def t_of(s):
        return (s - (along + rest)) / length

    return p - u * rest, u, t_of


def off_zero(x, least=_TINY):
    """Return ``x``, or ``least`` with the same sign where it is smaller."""
    return dr.select(dr.abs(x) >= least, x, dr.select(x < 0, -least, least))


def _roots(a, half_b, c, discriminant):
    """Return the roots of a s² + 2 half_b s + c in ascending order; where a vanishes, one of them is huge.

    Source: the cancellation-free form, e.g. Press et al., Numerical Recipes, §5.6.
    """
    root = dr.sqrt(dr.maximum(discriminant, 0))
    q = dr.select(half_b >= 0, -half_b - root, root - half_b)
    one = q / dr.select(a == 0, -_TINY, a)
    other = c / off_zero(q)
    return dr.minimum(one, other), dr.maximum(one, other)


def _first_boundary(t_of, inside, near, near_part, far, far_part, capped: bool):
    """Return the first end at t > 0 of the interval [near, far] of s, and what is hit there."""
    inside = inside & (near <= far)
    near_t = t_of(near)
    far_t = t_of(far)
    if not capped:
        near_t = dr.select(near_part == LATERAL, near_t, -dr.inf)
        far_t = dr.select(far_part == LATERAL, far_t, -dr.inf)
    from_outside = near_t > 0
    t = dr.select(from_outside, near_t, far_t)
    part = dr.select(from_outside, near_part, far_part)
    return dr.select(inside & (t > 0), t, dr.inf), part
