"""The one table of the quadrics that ``mrt_whitted`` traces exactly, in float32 and by numpy alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from .columns import Columns, column
from .intersect import (
    Frame,
    SurfaceHit,
    SurfacePoint,
    cone_derivatives,
    cone_frame,
    cone_surface,
    cylinder_derivatives,
    cylinder_frame,
    cylinder_surface,
    intersect_cone,
    intersect_cylinder,
    intersect_unit_sphere,
    sphere_derivatives,
    sphere_frame,
    sphere_surface,
)
from .unit_meshes import UnitMesh, unit_cone_mesh, unit_cylinder_mesh, unit_sphere_mesh

POINT, DISC, BALL = (0, 0, 0), (1, 1, 0), (1, 1, 1)
"""What the ends of a quadric are, by the squared semi-axes of their unit frame that span them."""


@dataclass(frozen=True)
class QuadricKind:
    """A kind of quadric: the convex hull, or its curved side, of what is at the two ends of an axis."""

    points: int  #: that place it; a radius follows
    frame: Callable[..., Frame]  #: its unit frame, of these points and the radius
    intersect: Callable[[Any, Any, Frame], SurfaceHit]
    surface: Callable[[Any, Any, Frame], SurfacePoint]  #: puts a point onto it
    ends: tuple[tuple[int, int, int], tuple[int, int, int]]  #: of its axis: point, disc or ball
    derivatives: Callable[[Any, Any, Frame], tuple[Any, Any]]  #: of a surface point, by u and v
    mesh: Callable[[int], UnitMesh]  #: what other integrators see, of so many sides
    open_twin: str | None = None  #: name of the kind without its discs
    closed: bool = True

    @property
    def width(self) -> int:
        """Return how many numbers an object is made of."""
        return 3 * self.points + 1


_CONE = partial(
    QuadricKind, 2, cone_frame, surface=cone_surface, ends=(POINT, DISC), derivatives=cone_derivatives
)
_CYLINDER = partial(
    QuadricKind,
    2,
    cylinder_frame,
    surface=cylinder_surface,
    ends=(DISC, DISC),
    derivatives=cylinder_derivatives,
)

KINDS: dict[str, QuadricKind] = {
    "sphere": QuadricKind(
        1,
        sphere_frame,
        intersect_unit_sphere,
        sphere_surface,
        (BALL, BALL),
        sphere_derivatives,
        unit_sphere_mesh,
    ),
    "cone": _CONE(intersect_cone, mesh=unit_cone_mesh, open_twin="open cone"),
    "open cone": _CONE(
        partial(intersect_cone, capped=False), mesh=partial(unit_cone_mesh, capped=False), closed=False
    ),
    "cylinder": _CYLINDER(intersect_cylinder, mesh=unit_cylinder_mesh, open_twin="open cylinder"),
    "open cylinder": _CYLINDER(
        partial(intersect_cylinder, capped=False),
        mesh=partial(unit_cylinder_mesh, capped=False),
        closed=False,
    ),
}


@dataclass(frozen=True)
class QuadricTable:
    """Objects of one kind, by their unit frames."""

    kind: str  # a key of KINDS
    origins: np.ndarray  # float64 [n, 3]
    rows: np.ndarray  # float64 [n, 3, 3]
    first_faces: np.ndarray  # int [n], of the stand-in of each, for textures that are looked up by face
    flipped: bool = False  # do the normals point inwards

    @classmethod
    def of_one(cls, kind: str, frame: Frame, *, flipped: bool = False) -> QuadricTable:
        """Return the table of a shape that is one object."""
        rows = np.array([[list(frame.x), list(frame.y), list(frame.z)]])
        return cls(kind, np.array([list(frame.origin)]), rows, np.zeros(1, int), flipped)

    @classmethod
    def of_numbers(
        cls, kind: str, numbers: np.ndarray, faces: int, place: Callable[[Frame], Frame], *, flipped: bool
    ) -> QuadricTable:
        """Return the table of objects given by ``numbers`` [n, width], moved by ``place``.

        ``faces``: number of those of the stand-in of each.
        """
        points = [Columns.of(numbers[:, 3 * k : 3 * k + 3]) for k in range(KINDS[kind].points)]
        frame = place(KINDS[kind].frame(*points, column(numbers[:, -1])))
        rows = np.stack([row.array() for row in (frame.x, frame.y, frame.z)], axis=1)
        return cls(kind, frame.origin.array(), rows, faces * np.arange(len(numbers)), flipped)

    def hulls(self) -> np.ndarray:
        """Return the ellipsoids [n, 2, 3, 4] whose convex hull each is: three semi-axes, centre."""
        columns = np.linalg.inv(self.rows)
        axis = columns[:, :, 2] * (KINDS[self.kind].points - 1)
        semi_axes = [columns * np.array(end) for end in KINDS[self.kind].ends]
        centers = np.stack([self.origins, self.origins + axis], axis=1)
        return np.concatenate([np.stack(semi_axes, axis=1), centers[..., None]], axis=3)

    def boxes(self) -> np.ndarray:
        """Return the bounding boxes [n, 2, 3]."""
        hulls = self.hulls()
        half, centers = np.sqrt((hulls[..., :3] ** 2).sum(axis=3)), hulls[..., 3]
        return np.stack([(centers - half).min(axis=1), (centers + half).max(axis=1)], axis=1)
