"""The effect of ``to_world`` on the frames and points of shapes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from .intersect import Frame
from .parameters import ParameterError


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
        origin = [
            sum(m * c for m, c in zip(self.linear[i], o, strict=True)) + self.offset[i] for i in range(3)
        ]
        return Frame(type(o)(origin), row(frame.x), row(frame.y), row(frame.z))
