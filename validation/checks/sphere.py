"""The sphere of directions cut into cells, small where samples are dense: for chi-square and quadrature.

A direction has a hemisphere, r = √(1 − |z|) and an azimuth. Near the normal r keeps all digits of x and y,
which the cosine loses; dω = 2 r dr dφ. A cell is a square of a quadtree in (r, φ), named by its level and the
Morton code at which it starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mrt_mitsuba.validation.checks.probe import Lanes

Array = np.ndarray
DEPTH = 17  # the finest cell is a hundred times what float32 rounding moves a direction by
SIDE = 6
POINTS = SIDE**2  # at which a cell is integrated
HEMISPHERE = 4**DEPTH  # codes of each
_MASKS = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)


def encode(wo: Array) -> Array:
    """Return the Morton codes of directions [N, 3]."""
    x, y, z = wo.T.astype(np.float64)
    r = np.sqrt((x * x + y * y) / (1 + np.abs(z)))
    turn = np.arctan2(y, x) / (2 * np.pi) + 0.5
    a, b = (np.clip(u * 2**DEPTH, 0, 2**DEPTH - 1).astype(np.int64) for u in (r, turn))
    for shift, mask in _MASKS:
        a, b = (a | (a << shift)) & mask, (b | (b << shift)) & mask
    return (z < 0) * HEMISPHERE + (a | (b << 1))


def _corner(start: Array) -> tuple[Array, Array]:
    """Return r and turn, in [0, 1), of the corners of cells."""
    a, b = start & 0x5555555555555555, (start >> 1) & 0x5555555555555555
    for (shift, _), (_, mask) in zip(_MASKS[::-1], (*_MASKS[-2::-1], (32, 0xFFFFFFFF)), strict=True):
        a, b = (a | (a >> shift)) & mask, (b | (b >> shift)) & mask
    return a / 2**DEPTH, b / 2**DEPTH


@dataclass(frozen=True)
class Cells(Lanes):
    """Cells that cover the sphere, in the order of their codes."""

    start: Array  # int64 [C]
    level: Array  # int64 [C]

    @staticmethod
    def around(codes: Array, most: int, coarsest: int = 4) -> Cells:
        """Return cells of which none holds more than ``most`` of the directions, unless it is the finest."""
        codes, starts, levels = np.sort(codes), [], []
        start, level = np.arange(2 * 4**coarsest) * 4 ** (DEPTH - coarsest), coarsest
        while len(start):
            ends = np.searchsorted(codes, start + 4 ** (DEPTH - level))
            full = (ends - np.searchsorted(codes, start) > most) & (level < DEPTH)
            starts.append(start[~full])
            levels.append(np.full((~full).sum(), level))
            level += 1
            start = _quarters(start[full], level) if full.any() else start[:0]
        return Cells(np.concatenate(starts), np.concatenate(levels)).sorted()

    def sorted(self) -> Cells:
        return self.only(np.argsort(self.start))

    def find(self, codes: Array) -> Array:
        """Return the index of the cell in which each direction lies."""
        return np.searchsorted(self.start, codes, side="right") - 1

    def quartered(self) -> Cells:
        """Return four cells for each, one after the other."""
        level = np.repeat(self.level + 1, 4)
        return Cells(_quarters(self.start, level.reshape(-1, 4)[:, :1]), level)

    def at(self, i: Array, j: Array) -> tuple[Array, Array]:
        """Return directions [C, P, 3] at places of each cell, from 0 to 1, and r there."""
        r0, turn0 = (x[:, None] for x in _corner(self.start % HEMISPHERE))
        width = (0.5**self.level)[:, None]
        r, turn = r0 + width * i, turn0 + width * j
        z = np.where(self.start >= HEMISPHERE, -1, 1)[:, None] * (1 - r * r)
        sin, phi = r * np.sqrt(2 - r * r), 2 * np.pi * (turn - 0.5)
        return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], axis=-1).astype(np.float32), r

    @property
    def middles(self) -> Array:
        """The directions of their middles. [C, 3]"""
        return self.at(np.array([0.5]), np.array([0.5]))[0][:, 0]

    def points(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return random directions in each cell, one in each part [C, POINTS, 3], and dω [C, POINTS]."""
        i, j = np.divmod(np.arange(POINTS), SIDE)
        shift = rng.random((2, len(self.start), POINTS))
        wo, r = self.at((i + shift[0]) / SIDE, (j + shift[1]) / SIDE)
        return wo, 4 * np.pi * r * ((0.5**self.level)[:, None] / SIDE) ** 2

    @property
    def solid_angle(self) -> Array:
        r, _ = _corner(self.start % HEMISPHERE)
        width = 0.5**self.level
        return 2 * np.pi * width * ((r + width) ** 2 - r**2)

    def bounds(self, index: int) -> tuple[float, float, float, float, int]:
        """Return r and φ from … to, and the sign of z, of one cell."""
        cell = self.only(np.array([index]))
        r, turn = (float(x[0]) for x in _corner(cell.start % HEMISPHERE))
        width = 0.5 ** int(cell.level[0])
        phi = 2 * np.pi * (turn - 0.5)
        return r, r + width, phi, phi + 2 * np.pi * width, -1 if cell.start[0] >= HEMISPHERE else 1


def _quarters(start: Array, level: Array | int) -> Array:
    step = 4 ** (DEPTH - np.asarray(level))
    return (np.reshape(start, (-1, 1)) + np.arange(4) * step).ravel()


@dataclass(frozen=True)
class Integrals:
    """Integrals over cells, and the variances of these estimates: both [C, K] of K integrands."""

    cells: Cells
    mean: Array
    variance: Array


def integrate(
    function: Callable[[Array], Array],
    cells: Cells,
    rng: np.random.Generator,
    codes: Array,
    weights: Array,
    samples: int,
) -> Integrals:
    """Integrate ``function(directions [N, 3]) -> [N, K]`` over cells; those known too badly are cut further.

    ``codes`` and ``weights`` of ``samples`` samples say what the first integrand gives where; the integrals
    are made as certain as so many samples would be.
    """
    done: list[Integrals] = []
    order = np.argsort(codes)
    codes, below = codes[order], np.concatenate([[0], np.cumsum(weights[order])]) / samples
    for attempt in range(8):
        ends = cells.start, cells.start + 4 ** (DEPTH - cells.level)
        hint = np.diff([below[np.searchsorted(codes, end)] for end in ends], axis=0)[0]
        wo, omega = cells.points(rng)
        values = function(wo.reshape(-1, 3))
        values = (
            np.where(np.isfinite(values), values, 0).reshape(*omega.shape, -1) * omega[..., None] * POINTS
        )
        mean, variance = values.mean(axis=1), values.var(axis=1) / (POINTS - 1)
        share = np.abs(mean) / (np.abs(mean).sum(axis=0) + 1e-12)
        spread = variance / (np.abs(mean).sum(axis=0) + 1e-12) ** 2
        # half of what chance does to the count of the samples, or one sample, is known well enough
        bad = (spread > 0.25 * share / samples + 1 / samples**2).any(axis=1)
        bad |= (hint * samples > 1.5) & (mean[:, 0] < 0.2 * hint)
        bad &= cells.level < DEPTH
        if attempt == 7 or not bad.any():
            done.append(Integrals(cells, mean, variance))
            break
        done.append(Integrals(cells.only(~bad), mean[~bad], variance[~bad]))
        cells = cells.only(bad).quartered()
    rows = [(d.cells.start, d.cells.level, d.mean, d.variance) for d in done]
    start, level, mean, variance = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(start)
    return Integrals(Cells(start[order], level[order]), mean[order], variance[order])


def chi_square(
    found: Integrals, codes: Array, count: int, known: float = 0.0
) -> tuple[list[tuple[float, int]], tuple]:
    """Compare the counts of samples with those that integrals expect.

    Return χ² and its degrees of freedom in six ways to group cells, so that faults of any width show:
    neighbours that expect 25 samples or more, a 128th and a 16th of all, and slices along x, y and z of a
    16th; and the cell that is most off. ``known``: to how much the density is known, relative.
    """
    seen = np.bincount(found.cells.find(codes), minlength=len(found.cells.start))
    expected, variance = count * found.mean[:, 0], count**2 * found.variance[:, 0]
    neighbours, tests = np.arange(len(seen)), []
    slices = [np.argsort(axis) for axis in found.cells.middles.T]
    for parts, order in (
        (count / 25, neighbours),
        (128, neighbours),
        *((16, o) for o in (neighbours, *slices)),
    ):
        group = np.floor(np.cumsum(expected[order]) / max(count / parts, 25)).astype(int)
        group = np.minimum(group, max(group[-1] - 1, 0))
        seen_in, expected_in, variance_in = (np.bincount(group, x[order]) for x in (seen, expected, variance))
        used = (seen_in > 0) | (expected_in > 1e-6)
        variance_in += expected_in + (known * expected_in) ** 2
        pull = (seen_in - expected_in)[used] ** 2 / np.maximum(variance_in, 1e-6)[used]
        tests.append((float(pull.sum()), max(len(pull), 1)))
    cell = int(np.argmax(np.abs(seen - expected) / np.sqrt(expected + variance + 1)))
    return tests, found.cells.bounds(cell)
