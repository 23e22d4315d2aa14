"""``mrt_cone``: a cone, exact where it matters and a mesh where it must be."""

from __future__ import annotations

import mitsuba as mi

from . import plugin


class MrtCone(plugin("axial_mesh").AxialMesh):  # type: ignore[misc]
    r"""A full right circular cone: lateral surface and base disc.

    ``mrt_whitted`` intersects the quadric and the disc themselves. To every other integrator the shape is a
    mesh of ``segments`` sides with smooth normals, inscribed in the cone; its distance error falls with
    segments⁻². Under them, thousands of segments need ``'embree_use_robust_intersections': True`` next to the
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

    kind, ends = "cone", ("apex", "base_center")


mi.register_shape("mrt_cone", MrtCone)
