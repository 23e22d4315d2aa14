"""``mrt_mesh``: triangles from arrays, so that a scene dict can hold a model without a file."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .mesh_api import Placement, write_buffers
from .parameters import ParameterError, bitmap

# Arrays of the vertices, and their channels in the bitmap: as many as are used, or more
_CHANNELS = {"positions": (3,), "texcoords": (2, 3), "normals": (3,)}


class MrtMesh(mi.Mesh):
    r"""Triangles given as arrays, which a dict carries as bitmaps of one row.

    ============= =========== ========== ==============================================================
    name          type        default    unit or range
    ============= =========== ========== ==============================================================
    ``positions`` ``Bitmap``  required   float32 [1, N, 3], scene units
    ``faces``     ``Bitmap``  required   uint32 [1, M, 3], corners counter-clockwise seen from outside
    ``texcoords`` ``Bitmap``             float32 [1, N, 2 or 3]; two are used
    ``normals``   ``Bitmap``             float32 [1, N, 3], of smooth triangles; without, they are flat
    ``to_world``  transform   identity   any invertible affine transform
    ============= =========== ========== ==============================================================

    .. code-block:: python

        {'type': 'mrt_mesh', 'positions': mi.Bitmap(points[np.newaxis]),
         'faces': mi.Bitmap(faces[np.newaxis])}

    There is no XML form; write the mesh to a PLY file and use the nearest stock plugin, ``ply``, there.
    """

    def __init__(self, props: mi.Properties) -> None:
        faces = _array(props, "faces", 3)
        arrays = {
            name: _array(props, name, *channels)[:, : channels[0]]
            for name, channels in _CHANNELS.items()
            if name in props or name == "positions"
        }
        smooth = "normals" in arrays
        if smooth and props.get("face_normals", False):
            raise ParameterError('mrt_mesh: give "normals" or "face_normals", not both')
        if (faces % 1).any():
            raise ParameterError('mrt_mesh: "faces" holds a number that is not whole')
        count = len(arrays["positions"])
        wrong = faces[(faces < 0) | (faces >= count)]
        if len(wrong):
            raise ParameterError(f'mrt_mesh: "faces" holds {wrong[0]}, but there are {count} positions')
        for name, array in arrays.items():
            if len(array) != count:
                raise ParameterError(f'mrt_mesh: "{name}" has {len(array)} entries for {count} positions')
        if "to_world" in props:
            placement = Placement(props)
            arrays["positions"] = placement.points(arrays["positions"].astype(np.float64))
            faces = faces[:, ::-1] if placement.mirrors else faces
            if smooth:
                arrays["normals"] = arrays["normals"] @ placement.inverse
        if smooth:
            lengths = np.linalg.norm(arrays["normals"], axis=1, keepdims=True)
            arrays["normals"] = arrays["normals"] / np.where(lengths == 0, 1, lengths)
        buffers = {"has_vertex_normals": smooth, "has_vertex_texcoords": "texcoords" in arrays}
        mi.Mesh.__init__(self, "mrt_mesh", count, len(faces), props, **buffers)
        flat = {f"vertex_{name}": array.astype(np.float32).ravel() for name, array in arrays.items()}
        write_buffers(self, **flat, faces=faces.astype(np.uint32).ravel())

    def to_string(self) -> str:
        return f"MrtMesh[positions={self.vertex_count()}, faces={self.face_count()}]"


def _array(props: mi.Properties, name: str, *widths: int) -> np.ndarray:
    array = bitmap(props, name, "of one row; write mi.Bitmap(array[np.newaxis])")
    if array.ndim != 3 or array.shape[0] != 1 or array.shape[2] not in widths:
        wanted = " or ".join(f"[1, N, {width}]" for width in widths)
        raise ParameterError(f'mrt_mesh: "{name}" has the shape {array.shape}, but must have {wanted}')
    if not np.isfinite(array).all():
        raise ParameterError(f'mrt_mesh: "{name}" holds a number that is not finite')
    return array[0]
