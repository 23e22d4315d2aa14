"""Ray intersections with analytic surfaces, as pure functions over points and directions.

Shared by the float32 plugins and the float64 reference: everything works on scalars and on Dr.Jit arrays of any
precision. A ray is ``o + t d``; distances are in units of |d|. A miss has ``t = inf``.
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
