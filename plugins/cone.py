"""``mrt_cone``: a cone, exact where it matters and a mesh where it must be."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from .adapter import construct, keep_apart
from .intersect import Frame, cone_frame
from .parameters import flag, number, vector
from .protocols import QuadricShape
from .revolution import (
    Placement,
    QuadricTable,
    check_axis,
    fill,
    refill,
    side_count,
    table_of,
    unit_cone_mesh,
    vector64,
)
from .variants import first, is_jit, updatable


class MrtCone(mi.Mesh):
    r"""A full right circular cone: lateral surface and base disc.

    ``mrt_whitted`` intersects the quadric and the disc themselves. To every other integrator the shape is a
    mesh of ``segments`` sides with smooth normals, inscribed in the cone; its distance error falls with
    segments⁻². Under them, thousands of segments need ``'embree_use_robust_intersections': True`` beside the
    scene's ``'type'`` (in XML, a ``boolean`` of this name): without it, Embree lets rays through between
    slivers (about 1e-8 of them per segment). It has no effect on the exact surface.

    =============== ========= ========== ==============================================================
    name            type      default    unit or range
    =============== ========= ========== ==============================================================
    ``apex``        point     required   scene units
    ``base_center`` point     required   scene units, not the apex
    ``radius``      float     1          > 0, of the base disc, scene units
    ``capped``      boolean   true       with the base disc; without, open and lit on its outside only
    ``segments``    integer   256        3 to 65536, sides of the mesh
    ``to_world``    transform identity   any invertible affine transform; a skew one makes it elliptic
    =============== ========= ========== ==============================================================

    ``apex``, ``base_center`` and ``radius`` are differentiable scene parameters: the vertices follow them.
    Side: u is the azimuth over 2π, v = 0 at the base and 1 at the apex. Base: the unit square around the
    disc.

    .. code-block:: python

        {'type': 'mrt_cone', 'apex': [0, 1.5, 0], 'base_center': [0, 0.5, 0], 'radius': 0.6}

    .. code-block:: xml

        <shape type="mrt_cone">
            <point name="apex" x="0" y="1.5" z="0"/>
            <point name="base_center" x="0" y="0.5" z="0"/>
            <float name="radius" value="0.6"/>
        </shape>

    Nearest stock plugin: ``linearcurve``, whose segments of varying radius have round ends.
    """

    quadric = "cone"  # what ``mrt_whitted`` intersects in place of the mesh

    def __init__(self, props: mi.Properties) -> None:
        apex, base_center = vector(props, "apex"), vector(props, "base_center")
        radius = number(props, "radius", 1.0, above=0)
        check_axis("mrt_cone", "apex", apex, "base_center", base_center)
        self.capped = flag(props, "capped", True)
        self.placement = Placement(props)
        self.unit = unit_cone_mesh(side_count(props, 256), self.capped)
        self.exact_frame = self.placement(cone_frame(vector64(apex), vector64(base_center), radius))
        sizes = len(self.unit.points), len(self.unit.faces)
        construct(self, "mrt_cone", sizes, props, normals=True, texcoords=True)
        fill(self, self.unit, self.exact_frame)
        self.apex, self.base_center = mi.Point3f(apex), mi.Point3f(base_center)
        self.radius = updatable(radius)
        keep_apart(self, "mrt_cone", sizes[1])

    def frame(self) -> Frame:
        """The shape's unit frame in world space, in double precision (see ``intersect``)."""
        return self.exact_frame

    def quadrics(self) -> QuadricTable:
        """What ``mrt_whitted`` intersects in place of the mesh."""
        return table_of(self.quadric, self.capped, self.exact_frame)

    def traverse(self, callback: Any) -> None:
        mi.Mesh.traverse(self, callback)
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name in ("apex", "base_center", "radius"):
            if hasattr(self, name):  # not while the mesh is being filled
                callback.put(name, getattr(self, name), flags)

    def parameters_changed(self, keys: Any = ()) -> None:
        if not {"apex", "base_center", "radius"}.isdisjoint(keys):
            ends = vector64(self.apex), vector64(self.base_center)
            self.exact_frame = self.placement(cone_frame(*ends, first(self.radius)))
            if is_jit():
                refill(self, self.unit, self.placement(cone_frame(self.apex, self.base_center, self.radius)))
            else:
                fill(self, self.unit, self.exact_frame)
        mi.Mesh.parameters_changed(self, keys)

    def to_string(self) -> str:
        ends = f"apex={list(vector64(self.apex))}, base_center={list(vector64(self.base_center))}"
        return f"MrtCone[{ends}, radius={first(self.radius):g}, capped={self.capped}]"


QuadricShape.register(MrtCone)
mi.register_shape("mrt_cone", MrtCone)
