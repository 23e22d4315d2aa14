"""Meshes that stand for quadrics, in the quadrics' unit frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class UnitMesh:
    """Vertices in the unit frame (see ``intersect``), with the gradient that becomes the normal of each."""

    points: np.ndarray  # float64 [N, 3]
    gradients: np.ndarray  # float64 [N, 3]
    uvs: np.ndarray  # float64 [N, 2]
    faces: np.ndarray  # uint32 [M, 3], counter-clockwise seen from outside in a right-handed frame


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


def _ring(azimuth: np.ndarray, z: float, *, slope: float, v: float) -> UnitMesh:
    x, y = np.cos(azimuth), np.sin(azimuth)
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
