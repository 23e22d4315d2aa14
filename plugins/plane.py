"""``mrt_plane``: an infinite plane, with a finite stand-in for stock integrators."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .mesh_api import keep_apart, write_buffers
from .parameters import ParameterError, number, vector


class MrtPlane(mi.Mesh):
    r"""The plane of all points P with normal · P + distance = 0, lit on the side its normal points to.

    ``mrt_whitted`` intersects the plane itself, analytically and without bound. To every other integrator the
    shape is a square mesh of side ``extent`` around the foot of the origin: large squares lose precision in
    float32 (the intersection error grows with the side), so it should be as small as the picture allows.

    ============ ======== ========= ==============================================================
    name         type     default   unit or range
    ============ ======== ========= ==============================================================
    ``normal``   vector   required  not the null vector; normalised on construction
    ``distance`` float    0         n · P + distance = 0 with the *normalised* n, scene units
    ``extent``   float    100       > 0, side of the square seen by stock integrators, scene units
    ============ ======== ========= ==============================================================

    uv are the coordinates along two tangents, in scene units, zero at the foot of the origin.

    .. code-block:: python

        {'type': 'mrt_plane', 'normal': [0, 1, 0], 'distance': 0.2, 'bsdf': {'type': 'mrt_bsdf'}}

    .. code-block:: xml

        <shape type="mrt_plane">
            <vector name="normal" x="0" y="1" z="0"/>
            <float name="distance" value="0.2"/>
            <bsdf type="mrt_bsdf"/>
        </shape>

    Nearest stock plugin: ``rectangle`` with a ``to_world``; here the plane's own equation places it, so
    ``to_world`` is refused.
    """

    def __init__(self, props: mi.Properties) -> None:
        if "to_world" in props:
            raise ParameterError(
                'mrt_plane: "to_world" is not accepted; give "normal" and "distance" in world space'
            )
        normal = np.array(vector(props, "normal", nonzero=True))
        self.unit_normal = normal / np.linalg.norm(normal)  # [3], float64
        self.distance = number(props, "distance", 0.0)
        extent = number(props, "extent", 100.0, above=0)
        # A right-handed frame with the normal. Crossing with the axis that it has least of keeps planes that
        # are across an axis so
        s = np.cross(np.eye(3)[np.argmin(np.abs(self.unit_normal))], self.unit_normal)
        s /= np.linalg.norm(s)
        self.tangents = np.array([s, np.cross(self.unit_normal, s)])  # [2, 3]
        mi.Mesh.__init__(self, "mrt_plane", 4, 2, props, has_vertex_texcoords=True)
        corners = 0.5 * extent * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # [4, 2]
        positions = corners @ self.tangents - self.distance * self.unit_normal  # [4, 3]
        write_buffers(
            self,
            vertex_positions=positions.astype(np.float32).ravel(),
            vertex_texcoords=corners.astype(np.float32).ravel(),
            faces=np.array([0, 1, 2, 0, 2, 3], dtype=np.uint32),
        )
        keep_apart(self, "mrt_plane")

    def to_string(self) -> str:
        return f"MrtPlane[normal={self.unit_normal.tolist()}, distance={self.distance:g}]"
