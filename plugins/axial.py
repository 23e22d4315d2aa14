"""``mrt_cone`` and ``mrt_cylinder``: a mesh to Mitsuba, an exact quadric to ``mrt_whitted``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import Frame
from .mesh_api import Placement, keep_apart, write_buffers
from .parameters import ParameterError, flag, number, segments, vector
from .quadric_kinds import KINDS
from .quadric_table import QuadricTable
from .variants import first, is_jit, updatable


class AxialMesh(mi.Mesh):
    """The base class of ``mrt_cone`` and ``mrt_cylinder`` (Mitsuba's classes take no mix-in).

    Parameters: the two points ``ends``, ``radius``, ``segments``, ``capped`` and ``to_world``.
    """

    kind: str  # without discs, "open " precedes it
    ends: tuple[str, str]  # names of the points
    parameters: dict[str, Any]

    def __init__(self, props: mi.Properties) -> None:
        name = props.plugin_name()
        ends = [vector(props, name) for name in self.ends]
        radius = number(props, "radius", 1.0, above=0)
        if np.array_equal(*np.asarray(ends, np.float32)):
            both = " and ".join(f'"{name}"' for name in self.ends)
            raise ParameterError(f"{name}: {both} are both {ends[0]}, but must be two points")
        self.capped = flag(props, "capped", True)
        self.kind = self.kind if self.capped else f"open {self.kind}"
        if props.get("face_normals", False):
            raise ParameterError(f'{name}: "face_normals" is not accepted; its side is round')
        self.placement = Placement(props)
        self.unit = KINDS[self.kind].mesh(segments(props, 256))
        self._place(*ends, [radius])
        parameters = dict(zip(self.ends, map(mi.Point3f, ends), strict=True))
        self.parameters = {**parameters, "radius": updatable(radius)}
        vertices, faces = self.unit
        buffers = {"has_vertex_normals": True, "has_vertex_texcoords": True}
        mi.Mesh.__init__(self, name, len(vertices), len(faces), props, **buffers)
        uvs = vertices[:, 6:].astype(np.float32).ravel()
        write_buffers(self, vertex_texcoords=uvs, **self.table.proxy_mesh())
        keep_apart(self, name)

    def _place(self, *parameters: Sequence) -> None:
        """Make the table of the exact quadric, in double precision, from both ends and [radius]."""
        numbers = np.array([[first(x) for values in parameters for x in values]])
        self.table = QuadricTable(self.kind, numbers, self.placement, self.unit)

    def _frame(self) -> Frame:
        """Return the unit frame in Mitsuba's numbers, with derivatives by the parameters."""
        return self.placement(KINDS[self.kind].frame(*self.parameters.values()))

    def moving_frame(self) -> Frame | None:
        """Return the unit frame with its derivatives; None where none are wanted."""
        return self._frame() if dr.grad_enabled(self.parameters) else None

    def snapshot_state(self) -> tuple[object, list]:
        """Return what a snapshot compares instead of all attributes: an object that each change of the
        parameters makes anew, and arrays.
        """
        return self.table, [*self.parameters.values(), self.vertex_positions_buffer(), self.faces_buffer()]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        mi.Mesh.traverse(self, callback)
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name, value in self.parameters.items():
            callback.put(name, value, flags)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        if not set(self.parameters).isdisjoint(keys):
            dr.make_opaque(self.parameters)  # data of kernels: new values need no new one
            self._place(*self.parameters.values())
            if is_jit():
                self._follow(self._frame())
            else:
                write_buffers(self, **self.table.proxy_mesh())
        mi.Mesh.parameters_changed(self, keys)

    def _follow(self, frame: Frame) -> None:
        """Write positions and normals anew, with derivatives by the parameters of ``frame``."""
        vertices, _ = self.unit
        points = mi.Vector3f(vertices[:, :3].T)
        gradients = mi.Vector3f(vertices[:, 3:6].T)
        positions = dr.ravel(frame.origin + frame.to_world(points))
        normals = dr.ravel(dr.normalize(frame.gradient(gradients)))
        write_buffers(self, vertex_positions=positions, vertex_normals=normals)

    def to_string(self) -> str:
        parameters = ", ".join(f"{name}={value}" for name, value in self.parameters.items())
        return f"{type(self).__name__}[{parameters}, capped={self.capped}]"


class MrtCone(AxialMesh):
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

    kind = "cone"
    ends = ("apex", "base_center")


class MrtCylinder(AxialMesh):
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

    kind = "cylinder"
    ends = ("p0", "p1")
