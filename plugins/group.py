"""``mrt_group``: thousands of spheres, cones or cylinders in one shape."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .mesh_api import Placement, keep_apart, write_buffers
from .parameters import ParameterError, bitmap, choice, segments
from .quadric_kinds import CLOSED, KINDS
from .quadric_table import QuadricTable


class MrtGroup(mi.Mesh):
    r"""Many spheres, cones or cylinders as one shape, with per-object values for textures.

    Mitsuba takes about 0.1 ms for a native shape, 1 ms for one in Python, and traces the methods of each BSDF
    that is written in Python; a group of 10⁵ objects costs as much as one shape and one BSDF. ``mrt_whitted``
    intersects the exact objects. To other integrators each is a coarse mesh of ``segments`` sides.

    =============== ========== ========== ==============================================================
    name            type       default    unit or range
    =============== ========== ========== ==============================================================
    ``kind``        string     sphere     ``sphere`` or ``cone``, ...: of a plugin, its name without ``mrt_``
    ``numbers``     ``Bitmap`` required   float32 [n, 4] for spheres: centre, radius; [n, 7] for others: both
                                          points as the plugin of the kind names them, radius
    ``face_NAME``   ``Bitmap``            float32 [n, 1 or 3], values of the objects that a ``mesh_attribute``
                                          texture of this name looks up
    ``to_world``    transform  identity   any invertible affine transform of all objects
    ``segments``    integer    8          3 to 65536, sides of the stand-in; that of a
                                          sphere is an octahedron
    =============== ========== ========== ==============================================================

    .. code-block:: python

        {'type': 'mrt_group', 'kind': 'sphere', 'numbers': mi.Bitmap(numbers),
         'face_kd': mi.Bitmap(colors),
         'bsdf': {'type': 'mrt_bsdf',
                  'diffuse_reflectance': {'type': 'mesh_attribute', 'name': 'face_kd'}}}

    There is no XML form. Nearest stock plugin: ``ellipsoids``.
    """

    def __init__(self, props: mi.Properties) -> None:
        kind = choice(props, "kind", CLOSED)
        numbers = _table(props, "numbers", 3 * KINDS[kind].points + 1).astype(np.float64)
        _check(numbers)
        attributes = {name: _table(props, name) for name in props if name.startswith("face_")}
        unit = KINDS[kind].mesh(segments(props, 8))
        self.table = QuadricTable(kind, numbers, Placement(props), unit)
        vertices, faces = map(len, unit)
        sizes = len(numbers) * vertices, len(numbers) * faces
        mi.Mesh.__init__(self, "mrt_group", *sizes, props, has_vertex_normals=True)
        write_buffers(self, **self.table.proxy_mesh())
        for name, values in attributes.items():
            if len(values) != len(numbers):
                raise ParameterError(f'mrt_group: "{name}" has {len(values)} rows for {len(numbers)} objects')
            self.add_attribute(name, values.shape[1], np.repeat(values, faces, axis=0).ravel())
        keep_apart(self, "mrt_group")

    def moving_frame(self) -> None:
        """Return None: a group has no differentiable parameters."""
        return

    def to_string(self) -> str:
        return f"MrtGroup[kind={self.table.kind}, objects={len(self.table.rows)}]"


def _table(props: mi.Properties, name: str, width: int | None = None) -> np.ndarray:
    """Return a bitmap parameter as float32 [n, width]."""
    table = bitmap(props, name, "of an array [n, values]")
    table = table.reshape(len(table), -1).astype(np.float32)
    if width is not None and table.shape[1] != width:
        given = table.shape[1]
        raise ParameterError(f'mrt_group: "{name}" has {given} numbers for an object, but must have {width}')
    return table


def _check(numbers: np.ndarray) -> None:
    ends = numbers[:, :-1].reshape(len(numbers), -1, 3)
    faults = {
        "not finite": ~np.isfinite(numbers).all(axis=1),
        "a radius that is not > 0": ~(numbers[:, -1] > 0),
        "an axis of no length": (ends[:, 0] == ends[:, -1]).all(axis=1) & (ends.shape[1] > 1),
    }
    for fault, wrong in faults.items():
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ParameterError(f'mrt_group: row {row} of "numbers" is {fault}: {numbers[row].tolist()}')
