"""Ray intersections with analytic surfaces, as pure functions over points and directions.

Shared by the float32 plugins and the float64 reference: everything works on scalars and on Dr.Jit arrays of any
precision. A ray is ``o + t d``; distances are in units of |d|. A miss has ``t = inf``. Vectors may also be lists of
components with + and -, which is why a vector stands left of a scalar in products, and is never selected as a whole.
"""
from __future__ import annotations

import drjit as dr


def intersect_plane(o, d, normal, distance):
    """Distance t > 0 at which the ray meets the plane ``normal · P + distance = 0``; inf for none.

    The normal need not be a unit vector, only the ratio is used. Parallel rays miss.
    """
    height = dr.dot(normal, o) + distance
    slope = dr.dot(normal, d)
    towards = height * slope < 0
    return dr.select(towards, -height / dr.select(towards, slope, 1), dr.inf)


def intersect_sphere(o, d, center, radius):
    """Distance t > 0 at which the ray meets the sphere of ``radius`` > 0 around ``center``; inf for none.

    Both roots without cancellation: the discriminant from the distance s of the line to the centre, as
    (r − s)(r + s), instead of b² − ac; the root that b ∓ √… would lose from the product of the roots, c/q; and
    c = |f|² − r² from its factors, so that an origin on the surface stays there.
    Source: Haines, Günther and Akenine-Möller, "Precision Improvements for Ray/Sphere Intersection", Ray Tracing
    Gems, 2019, ch. 7.
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
    small, large = c / dr.select(q == 0, 1, q), q / a
    near, far = dr.select(ahead, small, large), dr.select(ahead, large, small)
    t = dr.select(near > 0, near, far)
    return dr.select(meets & (t > 0), t, dr.inf)
