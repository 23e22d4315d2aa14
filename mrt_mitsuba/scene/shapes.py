"""Low-poly models made by formula, for the scenes that the report made with modelling software.

Vertices are not shared between faces of different direction where texture coordinates need it; triangles are
flat whatever is shared. Faces run counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mrt_mitsuba.scene.model import Material, Mesh, Vector

# The picture on the block of scene 8, as block_picture() makes it
BLOCK_PICTURE = Path(__file__).parent / "assets" / "block.png"


def mesh(vertices: np.ndarray, faces: np.ndarray, material: Material, uvs: np.ndarray | None = None) -> Mesh:
    """Return a mesh of arrays of any number type."""
    texcoords = None if uvs is None else np.asarray(uvs, np.float32)
    return Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.uint32), material, texcoords)


def grid_faces(rows: int, columns: int, *, closed: bool = False) -> np.ndarray:
    """Return two triangles for each cell of points in row-major order; ``closed`` joins opposite edges."""
    i, j = np.meshgrid(np.arange(rows - (not closed)), np.arange(columns - (not closed)), indexing="ij")
    down, right = (i + 1) % rows, (j + 1) % columns
    a, b, c, d = (r * columns + s for r, s in ((i, j), (down, j), (down, right), (i, right)))
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)


def torus(
    center: Vector, radius: float, tube: float, material: Material, *, rings: int = 48, sides: int = 16
) -> Mesh:
    """Return an upright ring with its axis along z; ``tube`` is the radius of its tube."""
    around, across = np.meshgrid(
        2 * np.pi * np.arange(rings) / rings, 2 * np.pi * np.arange(sides) / sides, indexing="ij"
    )
    r = radius + tube * np.cos(across)
    points = np.stack([r * np.cos(around), r * np.sin(around), tube * np.sin(across)], -1).reshape(-1, 3)
    return mesh(points + np.array(center), grid_faces(rings, sides, closed=True), material)


def block(center: Vector, size: Vector, material: Material, *, turn: float = 0.0) -> Mesh:
    """Return a box, turned by ``turn`` degrees about y, with the texture upright on each side."""
    corners, faces, uvs = [], [], []
    # Seen from outside: right and up along the side
    sides = [
        ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
        ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
        ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ]
    for k, (out, right, up) in enumerate(np.array(sides, float)):
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            corners.append(out + x * right + y * up)
            uvs.append(((x + 1) / 2, (1 - y) / 2))  # v = 0 is the first row of a picture, its top
        faces += [(4 * k, 4 * k + 1, 4 * k + 2), (4 * k, 4 * k + 2, 4 * k + 3)]
    points = np.array(corners) * np.array(size) / 2
    return mesh(_turned(points, turn) + np.array(center), np.array(faces), material, np.array(uvs))


def tent(
    center: Vector, width: float, height: float, length: float, material: Material, *, turn: float = 0.0
) -> Mesh:
    """Return a ridge tent on the ground: a prism along x, turned about y."""
    half = np.array([length / 2, 0, 0])
    section = np.array([[0, 0, width / 2], [0, height, 0], [0, 0, -width / 2]])
    points = np.concatenate([section - half, section + half])
    faces = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (2, 1, 4), (2, 4, 5), (0, 2, 5), (0, 5, 3)]
    return mesh(_turned(points, turn) + np.array(center), np.array(faces), material)


def rock(center: Vector, radius: float, material: Material, *, seed: int) -> Mesh:
    """Return an icosahedron with its corners moved in and out, flattened."""
    golden = (1 + 5**0.5) / 2
    points: list[tuple[float, float, float]] = [(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points += [(y, z, x) for x, y, z in points] + [(z, x, y) for x, y, z in points]
    corners = np.array(points) / np.hypot(1, golden)
    faces = []
    edge = 2 / np.hypot(1, golden)
    for a in range(12):
        for b in range(a + 1, 12):
            for c in range(b + 1, 12):
                sides = [np.linalg.norm(corners[p] - corners[q]) for p, q in ((a, b), (b, c), (c, a))]
                if np.allclose(sides, edge):
                    outwards = np.linalg.det(corners[[a, b, c]]) > 0
                    faces.append((a, b, c) if outwards else (a, c, b))
    shape = corners * radius * np.random.default_rng(seed).uniform(0.75, 1.15, (12, 1)) * [1, 0.7, 1]
    return mesh(shape + np.array(center), np.array(faces), material)


def pines(
    places: Sequence[Vector], height: float, green: Material, brown: Material, *, sides: int = 7
) -> tuple[Mesh, Mesh]:
    """Return fir trees of three pyramids each, of about ``height``, and their trunks."""
    crown, trunk = [], []
    for k, place in enumerate(places):
        size = height * (0.8 + 0.4 * ((k * 0.618034) % 1))
        trunk.append(_pyramid(place, 0.05 * size, 0.5 * size, 4))
        for low, wide, tall in ((0.2, 0.26, 0.45), (0.42, 0.2, 0.38), (0.62, 0.14, 0.38)):
            base = (place[0], place[1] + low * size, place[2])
            crown.append(_pyramid(base, wide * size, tall * size, sides))
    return _joined(crown, green), _joined(trunk, brown)


def terrain(
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    extent: float,
    cells: int,
    materials: Sequence[tuple[float, Material]],
) -> tuple[Mesh, ...]:
    """Return ground over [−extent, extent]² of ``2 cells²`` triangles, y = height(x, z).

    ``materials``: upper limits of a triangle's mean height, ascending, and what is below each; the last takes
    the rest.
    """
    line = np.linspace(-extent, extent, cells + 1)
    z, x = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x, height(x, z), z], -1).reshape(-1, 3)
    faces = grid_faces(cells + 1, cells + 1)
    level = points[faces].mean(axis=1)[:, 1]
    kind = np.minimum(np.searchsorted([limit for limit, _ in materials], level), len(materials) - 1)
    pieces = []
    for k, (_, material) in enumerate(materials):
        used, index = np.unique(faces[kind == k], return_inverse=True)
        if len(used):
            pieces.append(mesh(points[used], index.reshape(-1, 3), material))
    return tuple(pieces)


def block_picture(size: int = 64) -> np.ndarray:
    """Return the picture of scene 8, uint8 [size, size, 3]: framed planks with an arrow that points up."""
    y, x = np.mgrid[0:size, 0:size] / (size - 1)
    plank = np.floor(x * 4)
    grain = 0.5 + 0.5 * np.sin(40 * (y + 0.07 * np.sin(9 * y + 3 * plank) + plank))
    color = np.array([0.72, 0.5, 0.28]) * (0.75 + 0.12 * (plank % 2) + 0.13 * grain)[..., None]
    color[np.abs(x * 4 - np.round(x * 4)) < 0.05] *= 0.45
    arrow = (np.abs(x - 0.5) < 0.06) & (y > 0.35) & (y < 0.78)
    arrow |= (np.abs(x - 0.5) < (y - 0.2) * 0.9) & (y < 0.42)
    color[arrow] = (0.15, 0.25, 0.5)
    frame = np.minimum.reduce([x, y, 1 - x, 1 - y]) < 0.08
    color[frame] = np.array([0.45, 0.28, 0.14])
    return (255 * np.clip(color, 0, 1)).astype(np.uint8)


def _turned(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def _pyramid(base: Vector, radius: float, height: float, sides: int) -> tuple[np.ndarray, np.ndarray]:
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([radius * np.cos(angle), np.zeros(sides), radius * np.sin(angle)], -1)
    points = np.concatenate([ring, [[0, height, 0], [0, 0, 0]]]) + np.array(base)
    i = np.arange(sides)
    following = (i + 1) % sides
    tip, foot = np.full(sides, sides), np.full(sides, sides + 1)
    return points, np.concatenate([np.stack([i, tip, following], -1), np.stack([i, following, foot], -1)])


def _joined(parts: Sequence[tuple[np.ndarray, np.ndarray]], material: Material) -> Mesh:
    first = np.cumsum([0] + [len(points) for points, _ in parts])
    faces = [index + start for (_, index), start in zip(parts, first, strict=False)]
    return mesh(np.concatenate([points for points, _ in parts]), np.concatenate(faces), material)
