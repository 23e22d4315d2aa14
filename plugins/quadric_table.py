"""Objects of one kind of quadric in double precision: their frames, boxes and stand-ins."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter

import drjit.scalar
import numpy as np

from .intersect import Frame
from .quadric_kinds import KINDS, UnitMesh


class QuadricTable:
    """Objects of one kind, by their unit frames, and the mesh that stands for each."""

    def __init__(
        self, kind: str, numbers: np.ndarray, place: Callable[[Frame], Frame], unit: UnitMesh
    ) -> None:
        """Read the ``numbers`` of the objects, float64 [n, width], and move each by ``place``.

        ``unit``: the stand-in in the unit frame.
        """
        *columns, radii = map(column, numbers.T)
        points = [Columns(columns[k : k + 3]) for k in range(0, len(columns), 3)]
        frame = place(KINDS[kind].frame(*points, radii))
        self.kind = kind
        self.unit = unit
        self.origins = np.stack(frame.origin, axis=1)  # float64 [n, 3]
        rows = [np.stack(row, axis=1) for row in (frame.x, frame.y, frame.z)]
        self.rows = np.stack(rows, axis=1)  # [n, 3, 3]
        #: the first face of each stand-in, int [n], for textures that are looked up by face
        self.first_faces = len(unit[1]) * np.arange(len(numbers))

    def boxes(self) -> np.ndarray:
        """Return the bounding boxes [n, 2, 3]: of ellipsoids at both ends."""
        columns = np.linalg.inv(self.rows)
        kind = KINDS[self.kind]
        half = np.stack([np.sqrt((columns**2 * end).sum(axis=2)) for end in kind.hull], axis=1)
        axis = columns[:, :, 2] * (kind.points - 1)
        centers = np.stack([self.origins, self.origins + axis], axis=1)  # [n, end, 3]
        low = (centers - half).min(axis=1)
        high = (centers + half).max(axis=1)
        return np.stack([low, high], axis=1)

    def proxy_mesh(self) -> dict[str, np.ndarray]:
        """Return the buffers of a mesh of all objects; frames may be left-handed."""
        columns = np.linalg.inv(self.rows).transpose(0, 2, 1)
        vertices, faces = self.unit
        positions = vertices[:, :3] @ columns + self.origins[:, None]
        normals = vertices[:, 3:6] @ self.rows
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        faces = faces if np.linalg.det(self.rows[0]) > 0 else faces[:, ::-1]
        first = len(vertices) * np.arange(len(self.rows))
        every = faces[None] + first[:, None, None]  # [n, faces, 3]
        return {
            "faces": every.astype(np.uint32).ravel(),
            "vertex_positions": positions.astype(np.float32).ravel(),
            "vertex_normals": normals.astype(np.float32).ravel(),
        }


class Columns(list):
    """Three columns, which Dr.Jit's ``dot``, ``norm`` and ``normalize`` take for a vector."""

    x, y, z = (property(itemgetter(k)) for k in range(3))

    def __sub__(self, other) -> Columns:
        return Columns(a - b for a, b in zip(self, other, strict=True))

    def __truediv__(self, divisor) -> Columns:
        inverse = 1 / divisor
        return Columns(a * inverse for a in self)


def column(values: np.ndarray):
    """Return one column of float64 numbers."""
    return drjit.scalar.ArrayXf64(np.ascontiguousarray(values, np.float64))
