"""How Mitsuba makes meshes, in one place: version 3.10 changes all of it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import Frame
from .parameters import ParameterError
from .variants import is_jit


def keep_apart(mesh: Any, name: str, faces: int) -> None:
    """Keep Mitsuba from merging the mesh with others of its BSDF: it leaves those with attributes alone."""
    mesh.add_attribute(f"face_{name}", 1, [0.0] * faces)


def write_buffers(mesh: Any, **buffers: Any) -> None:
    """Give a mesh its ``faces``, ``vertex_positions``, ... as flat arrays."""
    if is_jit():
        # Scenes are loaded by several threads. The update evaluates the material of the mesh, too, which may
        # come from another one; Dr.Jit must know of such a handover
        dr.detail.new_scope(dr.backend_v(mi.Float))
    parameters = mi.traverse(mesh)
    for name, values in buffers.items():
        parameters[name] = values
    parameters.update()


def triangles(mesh: Any) -> np.ndarray:
    """Return the corners of a mesh's triangles, float64 [M, 3, 3]."""
    parameters = mi.traverse(mesh)
    points, faces = (np.array(parameters[name]) for name in ("vertex_positions", "faces"))
    return points.astype(np.float64).reshape(-1, 3)[faces.reshape(-1, 3)]


class Placement:
    """The effect of ``to_world`` on frames. Raises ``ParameterError`` for one that flattens space."""

    def __init__(self, props: mi.Properties) -> None:
        matrix = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, np.float64)
        self.linear, self.offset = matrix[:3, :3], matrix[:3, 3].tolist()
        if not np.isfinite(matrix).all() or abs(np.linalg.det(self.linear)) == 0:
            raise ParameterError(
                f'{props.plugin_name()}: "to_world" is not invertible; remove its zero scale'
            )
        self.mirrors = bool(np.linalg.det(self.linear) < 0)
        self.inverse = np.linalg.inv(self.linear).tolist()
        self.linear = self.linear.tolist()

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return the places of points [n, 3]."""
        return points @ np.transpose(self.linear) + np.array(self.offset)

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame of the moved shape; works for vectors of any type."""

        def row(v: Any) -> Any:
            return type(v)([sum(v[i] * self.inverse[i][j] for i in range(3)) for j in range(3)])

        o = frame.origin
        rows = zip(self.linear, self.offset, strict=True)
        origin = [sum(m * c for m, c in zip(line, o, strict=True)) + shift for line, shift in rows]
        return Frame(type(o)(origin), row(frame.x), row(frame.y), row(frame.z))
