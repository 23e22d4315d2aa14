"""``mrt_capsule``: a tube with round ends, exact where it matters and a mesh where it must be."""

from __future__ import annotations

import mitsuba as mi

from .axial_mesh import axial_mesh


class MrtCapsule(axial_mesh("capsule", "p0", "p1")):  # type: ignore[misc]
    r"""All points within ``radius`` of the segment from ``p0`` to ``p1``.

    ``mrt_whitted`` intersects the tube and the two half spheres themselves. To every other integrator the
    shape is a mesh of ``segments`` sides with smooth normals, inscribed in the capsule, as ``mrt_cone`` is.

    ============ ========= ========== ==============================================================
    name         type      default    unit or range
    ============ ========= ========== ==============================================================
    ``p0``       point     required   centre of one end, scene units
    ``p1``       point     required   that of the other; where both are one, use a ``sphere``
    ``radius``   float     1          > 0, scene units
    ``segments`` integer   256        3 to 65536, sides of the mesh
    ``to_world`` transform identity   any invertible affine transform; under a skew one it is elliptic
    ============ ========= ========== ==============================================================

    ``p0``, ``p1`` and ``radius`` are differentiable scene parameters: the vertices follow them. u is the
    azimuth over 2π; v is 1 at the tip beyond ``p0``, 3/4 and 1/4 at the rims of the tube, 0 at the other tip.

    .. code-block:: python

        {'type': 'mrt_capsule', 'p0': [0, 0, 0], 'p1': [0, 1, 0], 'radius': 0.2}

    .. code-block:: xml

        <shape type="mrt_capsule">
            <point name="p0" x="0" y="0" z="0"/>
            <point name="p1" x="0" y="1" z="0"/>
            <float name="radius" value="0.2"/>
        </shape>

    Nearest stock plugin: ``linearcurve``, whose segments have round ends.
    """


mi.register_shape("mrt_capsule", MrtCapsule)
