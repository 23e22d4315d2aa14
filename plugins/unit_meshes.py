"""Meshes that stand for quadrics, in the quadrics' unit frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class UnitMesh:
    """Vertices in the unit frame (see ``intersect``), with the gradient that becomes the normal of each."""

    points: np.ndarray  # float64 [N, 3]
    gradients: np.ndarray  # float64 [N, 3]
    uvs: np.ndarray  # float64 [N, 2]
    faces: np.ndarray  # uint32 [M, 3], counter-clockwise seen from outside in a right-handed frame
    stretch: np.ndarray | float = 0.0  # [N], what z grows by for each unit of the frame's extent

    def placed(self, extent: float | np.ndarray = 1.0) -> np.ndarray:
        """Return the points [..., N, 3] in a frame of this extent, or in each of some [n, 1]."""
        if not np.any(self.stretch):
            return self.points
        return self.points + np.multiply.outer(self.stretch * np.asarray(extent), [0.0, 0.0, 1.0])


def unit_sphere_mesh(segments: int = 0) -> UnitMesh:
    """Return an octahedron, whatever ``segments``."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    octants = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    turned = [(sum(octant) % 2) == 1 for octant in octants]  # an odd number of mirrored axes
    faces = [octant[::-1] if turn else octant for octant, turn in zip(octants, turned, strict=True)]
    return UnitMesh(points, points, np.zeros((6, 2)), np.array(faces, np.uint32))


def unit_cone_mesh(segments: int, *, capped: bool = True) -> UnitMesh:
    """Return a fan from the apex, which has a vertex and a normal for each triangle, and the base disc."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    middle = 0.5 * (azimuth[1:] + azimuth[:-1])
    zero = np.zeros(segments)
    rim = _ring(azimuth, 1.0, slope=-1.0, v=0.0)
    apex = UnitMesh(
        np.zeros((segments, 3)),
        np.stack([np.cos(middle), np.sin(middle), zero - 1], axis=1),
        np.stack([middle / (2 * np.pi), zero + 1], axis=1),
        np.empty((0, 3), np.uint32),
    )
    i = np.arange(segments, dtype=np.uint32)
    side = _join([rim, apex], np.stack([i, i + segments + 1, i + 1], axis=1))
    return _join([side, _disc(segments, 1.0)]) if capped else side


def unit_cylinder_mesh(segments: int, *, capped: bool = True) -> UnitMesh:
    """Return a strip of quads split in two, and two discs."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    top, base = _ring(azimuth, 0.0, slope=0.0, v=1.0), _ring(azimuth, 1.0, slope=0.0, v=0.0)
    i = np.arange(segments, dtype=np.uint32)
    k = i + segments + 1
    quads = [np.stack([i, i + 1, k], axis=1), np.stack([i + 1, k + 1, k], axis=1)]
    side = _join([top, base], np.concatenate(quads))
    return _join([side, _disc(segments, 0.0), _disc(segments, 1.0)]) if capped else side


def unit_capsule_mesh(segments: int) -> UnitMesh:
    """Return two half spheres of radius 1 around z = 0 and z = extent, and the tube between their rims."""
    azimuth = 2 * np.pi * np.arange(segments + 1) / segments
    angles = np.linspace(0, np.pi / 2, max(segments // 4, 2) + 1)
    heights = np.concatenate([-np.cos(angles), np.cos(angles[::-1])])
    radii = np.concatenate([np.sin(angles), np.sin(angles[::-1])])
    v = np.concatenate([np.linspace(1, 0.75, len(angles)), np.linspace(0.25, 0, len(angles))])
    rings = [_ring(azimuth, z, radius=r, slope=z, v=t) for z, r, t in zip(heights, radii, v, strict=True)]
    i = np.arange(segments, dtype=np.uint32)
    k = i + segments + 1
    lower, upper = np.stack([i, i + 1, k], axis=1), np.stack([i + 1, k + 1, k], axis=1)
    last = len(rings) - 2
    # The triangles with two corners in a pole are left out
    faces = [f + np.uint32(n * (segments + 1)) for n in range(last + 1)
             for f, pole in ((lower, 0), (upper, last)) if n != pole]  # fmt: skip
    stretch = np.repeat([0.0, 1.0], len(angles) * (segments + 1))
    return replace(_join(rings, np.concatenate(faces)), stretch=stretch)


def _ring(azimuth: np.ndarray, z: float, *, slope: float, v: float, radius: float = 1.0) -> UnitMesh:
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    points = np.stack([x, y, np.full_like(x, z)], axis=1)
    gradients = np.stack([x, y, np.full_like(x, slope)], axis=1)
    uvs = np.stack([azimuth / (2 * np.pi), np.full_like(x, v)], axis=1)
    return UnitMesh(points, gradients, uvs, np.empty((0, 3), np.uint32))


def _disc(segments: int, z: float) -> UnitMesh:
    """Return a fan around the centre, facing away from z = 1/2."""
    rim = _ring(2 * np.pi * np.arange(segments) / segments, z, slope=0, v=0)
    points = np.concatenate([rim.points, [[0, 0, z]]])
    i = np.arange(segments, dtype=np.uint32)
    faces = np.stack([i, (i + 1) % segments, np.full_like(i, segments)], axis=1)
    gradients = np.tile([0, 0, 1.0 if z > 0.5 else -1.0], (segments + 1, 1))
    return UnitMesh(points, gradients, 0.5 + 0.5 * points[:, :2], faces if z > 0.5 else faces[:, ::-1])


def _join(parts: Sequence[UnitMesh], more_faces: np.ndarray | None = None) -> UnitMesh:
    """Return one mesh of several; ``more_faces`` index the joined vertices."""
    first = np.cumsum([0] + [len(p.points) for p in parts])
    faces = [p.faces + np.uint32(start) for p, start in zip(parts, first, strict=False)]
    return UnitMesh(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.gradients for p in parts]),
        np.concatenate([p.uvs for p in parts]),
        np.concatenate(faces + ([] if more_faces is None else [more_faces])).astype(np.uint32),
    )
