"""``mrt_cylinder``: a closed cylinder, exact where it matters and a mesh where it must be."""

from __future__ import annotations

import mitsuba as mi

from . import plugin


class MrtCylinder(plugin("axial_mesh").AxialMesh):  # type: ignore[misc]
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

    kind, ends = "cylinder", ("p0", "p1")


mi.register_shape("mrt_cylinder", MrtCylinder)
