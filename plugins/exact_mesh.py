"""The base class of shapes that are a mesh to Mitsuba and exact quadrics to ``mrt_whitted``."""

from __future__ import annotations

import mitsuba as mi

from .intersect import Frame
from .quadric_kinds import QuadricTable


class ExactMesh(mi.Mesh):
    """A mesh that stands for quadrics.

    Derive from ``plugin("exact_mesh").ExactMesh``: an import would bind the class of one variant.
    """

    def quadrics(self) -> QuadricTable:
        """Return the quadrics that ``mrt_whitted`` intersects in place of the mesh."""
        raise NotImplementedError

    def moving_frame(self) -> Frame | None:
        """Return the unit frame of a single quadric with its derivatives; None where none are wanted."""
        return None
