"""``mrt_cylinder``: a closed cylinder, exact where it matters and a mesh where it must be."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from .adapter import construct, keep_apart
from .intersect import Frame, cylinder_frame
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
    unit_cylinder_mesh,
    vector64,
)
from .variants import first, is_jit, updatable


class MrtCylinder(mi.Mesh):
    r"""A right circular cylinder with its two discs.

    ``mrt_whitted`` intersects the quadric and the discs themselves. To every other integrator the shape is a
    mesh of ``segments`` sides with smooth normals, inscribed in the cylinder, as ``mrt_cone`` is.

    ============ ========= ========== ==============================================================
    name         type      default    unit or range
    ============ ========= ========== ==============================================================
    ``p0``       point     required   one end of the axis, scene units
    ``p1``       point     required   the other end, scene units
    ``radius``   float     1          > 0, scene units
    ``capped``   boolean   true       with discs; without, the tube is open and lit on its outside only
    ``segments`` integer   256        3 to 65536, sides of the mesh
    ``to_world`` transform identity   any invertible affine transform; under a skew one it is elliptic
    ============ ========= ========== ==============================================================

    ``p0``, ``p1`` and ``radius`` are differentiable scene parameters: the vertices follow them. Side: u is
    the azimuth over 2π, v = 1 at ``p0`` and 0 at ``p1``. Discs: the unit square around each.

    .. code-block:: python

        {'type': 'mrt_cylinder', 'p0': [0, 0, 0], 'p1': [0, 1, 0], 'radius': 0.2}

    .. code-block:: xml

        <shape type="mrt_cylinder">
            <point name="p0" x="0" y="0" z="0"/>
            <point name="p1" x="0" y="1" z="0"/>
            <float name="radius" value="0.2"/>
        </shape>

    Nearest stock plugin: ``cylinder``, which is open.
    """

    quadric = "cylinder"  # what ``mrt_whitted`` intersects in place of the mesh

    def __init__(self, props: mi.Properties) -> None:
        p0, p1 = vector(props, "p0"), vector(props, "p1")
        radius = number(props, "radius", 1.0, above=0)
        check_axis("mrt_cylinder", "p0", p0, "p1", p1)
        self.capped = flag(props, "capped", True)
        self.placement = Placement(props)
        self.unit = unit_cylinder_mesh(side_count(props, 256), self.capped)
        self.exact_frame = self.placement(cylinder_frame(vector64(p0), vector64(p1), radius))
        sizes = len(self.unit.points), len(self.unit.faces)
        construct(self, "mrt_cylinder", sizes, props, normals=True, texcoords=True)
        fill(self, self.unit, self.exact_frame)
        self.p0, self.p1, self.radius = mi.Point3f(p0), mi.Point3f(p1), updatable(radius)
        keep_apart(self, "mrt_cylinder", sizes[1])

    def frame(self) -> Frame:
        """The shape's unit frame in world space, in double precision (see ``intersect``)."""
        return self.exact_frame

    def quadrics(self) -> QuadricTable:
        """What ``mrt_whitted`` intersects in place of the mesh."""
        return table_of(self.quadric, self.capped, self.exact_frame)

    def traverse(self, callback: Any) -> None:
        mi.Mesh.traverse(self, callback)
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name in ("p0", "p1", "radius"):
            if hasattr(self, name):  # not while the mesh is being filled
                callback.put(name, getattr(self, name), flags)

    def parameters_changed(self, keys: Any = ()) -> None:
        if not {"p0", "p1", "radius"}.isdisjoint(keys):
            ends = vector64(self.p0), vector64(self.p1)
            self.exact_frame = self.placement(cylinder_frame(*ends, first(self.radius)))
            if is_jit():
                refill(self, self.unit, self.placement(cylinder_frame(self.p0, self.p1, self.radius)))
            else:
                fill(self, self.unit, self.exact_frame)
        mi.Mesh.parameters_changed(self, keys)

    def to_string(self) -> str:
        ends = f"p0={list(vector64(self.p0))}, p1={list(vector64(self.p1))}"
        return f"MrtCylinder[{ends}, radius={first(self.radius):g}, capped={self.capped}]"


QuadricShape.register(MrtCylinder)
mi.register_shape("mrt_cylinder", MrtCylinder)
