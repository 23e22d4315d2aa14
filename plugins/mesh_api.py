"""Making meshes with Mitsuba, in one place: version 3.10 changes all of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .intersect import Frame
from .parameters import ParameterError, transform
from .variants import is_jit


def keep_apart(mesh: mi.Mesh, name: str) -> None:
    """Keep Mitsuba from merging the mesh with others of its BSDF: it leaves those with attributes alone."""
    mesh.add_attribute(f"face_{name}", 1, [0.0] * mesh.face_count())


def write_buffers(mesh: mi.Mesh, **buffers: np.ndarray | mi.Float) -> None:
    """Give a mesh its ``faces``, ``vertex_positions``, ... as flat arrays."""
    if is_jit():
        # Scenes are loaded by several threads. The update evaluates the material of the mesh, too, which may
        # come from another one; Dr.Jit must know of such a handover
        dr.detail.new_scope(dr.backend_v(mi.Float))
    mi.traverse(mesh).update(buffers)


def triangles(mesh: mi.Mesh) -> np.ndarray:
    """Return the corners of a mesh's triangles, float64 [M, 3, 3]."""
    parameters = mi.traverse(mesh)
    points = np.array(parameters["vertex_positions"], np.float64).reshape(-1, 3)
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    return points[faces]


class Placement:
    """The effect of ``to_world`` on frames. Raises ``ParameterError`` for one that flattens space."""

    def __init__(self, props: mi.Properties) -> None:
        matrix = transform(props, "to_world")
        linear = matrix[:3, :3]
        determinant = np.linalg.det(linear) if np.isfinite(matrix).all() else 0
        if determinant == 0:
            raise ParameterError(
                f'{props.plugin_name()}: "to_world" is not invertible; remove its zero scale'
            )
        self.mirrors = bool(determinant < 0)
        self.matrix = matrix[:3]  # [3, 4]
        self.inverse = np.linalg.inv(linear)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return the places of points [n, 3]."""
        return points @ self.matrix[:, :3].T + self.matrix[:, 3]

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame of the moved shape; works for vectors of any type."""

        def times(matrix, v, numbers):
            rows = matrix.tolist()
            return type(v)([sum(c * m for c, m in zip(numbers, row, strict=True)) for row in rows])

        o = frame.origin
        axes = (times(self.inverse.T, v, v) for v in (frame.x, frame.y, frame.z))
        return Frame(times(self.matrix, o, [*o, 1]), *axes)
